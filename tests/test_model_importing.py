"""Other people's body models: the published formula, and every way in which such a file can be wrong."""
import pickle
from functools import cache

import numpy as np
import pytest
from conformance_bodies import skinned_worm
from published_bodies import as_smplx, as_star, published_vertices, synthetic_smpl
from scipy.sparse import csc_array

from model.export.correctives import write_body_npz
from model.files import load_model
from model.importing import NAMES, import_model
from model.learning.scape import judge_model
from model.rig import joint_places, make_rig


@cache
def smpl():
    return synthetic_smpl().arrays


MAKERS = {"smpl": smpl, "star": lambda: as_star(smpl()), "smplx": lambda: as_smplx(smpl())}


@pytest.fixture(scope="module", params=list(MAKERS))
def both(request, tmp_path_factory):
    """The arrays of a file and the model imported from it."""
    arrays, path = MAKERS[request.param](), tmp_path_factory.mktemp(request.param) / "theirs.npz"
    np.savez(path, **arrays)
    import_model(path).save(path.with_name("ours.npz"))
    return arrays, load_model(path.with_name("ours.npz"))


def drawn(model, count, seed=0):
    rng = np.random.default_rng(seed)
    J = len(model.skeleton.parents)
    return (rng.normal(0, 0.5, (count, J, 3)), rng.normal(0, 1.5, (count, model.n_betas)),
            rng.normal(0, 1, (count, 3)))


def test_vertices_are_those_of_the_published_formula(both):
    arrays, model = both
    for pose, betas, trans in zip(*drawn(model, 2), strict=True):
        wanted = published_vertices(arrays, pose, betas, trans)
        for found in (model.vertices(pose, betas, trans), model.subject(betas).vertices(pose, trans),
                      model.points(np.arange(0, len(wanted), 7)).operator(betas).evaluate(pose, trans)):
            np.testing.assert_allclose(found, wanted[::7] if len(found) < len(wanted) else wanted, rtol=0, atol=1e-9)
        np.testing.assert_allclose(model.joint_regressor @ model.vertices(0 * pose, betas, trans) - trans,
                                   arrays["J_regressor"] @ (model.vertices(0 * pose, betas)), rtol=0, atol=1e-9)


def test_parts_have_the_names_of_the_family_and_poses_are_those_of_people(both):
    _, model = both
    J = len(model.skeleton.parents)
    assert model.skeleton.names == NAMES[J] and model.info["family"] in ("smpl", "star", "smplx")
    sd = np.sqrt(np.diag(model.pose_covariance)).reshape(-1, 3).max(axis=1)
    sd = dict(zip(model.skeleton.names, sd, strict=True))
    assert sd["upper_arm_left"] > 0.3 and sd["thigh_right"] > 0.3 and sd["pelvis"] == 0 and sd["toes_left"] == 0.05
    if J == 55:
        np.testing.assert_array_equal(model.pose_mean[25:40].ravel(), smplx_hand())
        assert sd["index2_left"] == 0.05


def test_joints_that_rest_in_poses_of_nobody_are_no_doubt(both):
    assert judge_model(both[1]).verdict == judge_model(load_model("people-fingers")).verdict == "good"


def smplx_hand():
    return as_smplx(smpl())["hands_meanl"]


def test_our_own_export_comes_back(tmp_path):
    worm = skinned_worm(True)
    arrays = write_body_npz(tmp_path / "body.npz", worm)
    back = import_model(tmp_path / "body.npz")
    assert back.skeleton.names == worm.skeleton.names and back.n_betas == 3
    pose, betas = np.random.default_rng(0).normal(0, 0.4, (4, 3)), np.array([1.0, -0.5, 2.0])
    again = write_body_npz(tmp_path / "again.npz", back)
    np.testing.assert_allclose(again["posedirs"], arrays["posedirs"], rtol=0, atol=1e-7)
    joints = back.operator(betas).joints(back.joint_regressor)
    np.testing.assert_allclose(joints.evaluate(pose), joint_places(make_rig(back, betas).skeleton, pose), atol=1e-9)
    np.testing.assert_allclose(back.vertices(pose, betas), published_vertices(arrays, pose, betas, np.zeros(3)),
                               rtol=0, atol=1e-6)


def changed(**new):
    def change(a):
        for name, make in new.items():
            a[name] = make(a[name])
            if a[name] is None:
                del a[name]
    return change


def sparse_parts(a):
    dense = csc_array(a.pop("J_regressor"))
    a |= {"J_regressor_data": dense.data, "J_regressor_indices": dense.indices, "J_regressor_indptr": dense.indptr}


def put(array, place, value):
    out = array.astype(np.int64) if array.dtype.kind in "iu" else array.copy()
    out[place] = value
    return out


@pytest.mark.parametrize("change, word", [
    (changed(weights=lambda w: None), "it lacks 'weights'"),
    (changed(J_regressor=lambda w: None), "it lacks 'J_regressor'"),
    (changed(v_template=lambda v: v[:, :2]), r"v_template: expected numbers of shape \(any, 3\)"),
    (changed(shapedirs=lambda v: v[:-1]), "shapedirs: expected numbers of shape"),
    (changed(posedirs=lambda v: v[..., :200]), r"posedirs: expected 207 columns \(rotations\) or 93"),
    (changed(J_regressor=lambda v: v[:20]), "J_regressor: expected numbers of shape"),
    (changed(J_regressor=lambda v: 2 * v), "J_regressor: expected rows that sum to 1"),
    (changed(weights=lambda v: 1.1 * v), "weights: expected rows of at least 0 that sum to 1"),
    (changed(weights=lambda v: put(v, (3, 4), np.nan)), "weights: expected finite numbers"),
    (changed(f=lambda v: put(v, (0, 0), 10**6)), "f: expected"),
    (changed(kintree_table=lambda v: v[0]), r"kintree_table: expected whole numbers of shape \(2, J\)"),
    (changed(kintree_table=lambda v: put(v, (0, 3), 9)), "joint 3 has parent 9, expected a joint listed before it"),
    (changed(kintree_table=lambda v: v[:, ::-1]), "expected joints 0..23 in order"),
    (changed(kintree_table=lambda v: v[:, :23]), "weights: expected numbers of shape"),
    (changed(v_template=lambda v: v.astype(object)), "v_template: .*Python objects.*convert it once"),
])
def test_bad_files_are_told_in_one_line(tmp_path, change, word):
    arrays = dict(smpl())
    change(arrays)
    np.savez(tmp_path / "theirs.npz", **arrays)
    with pytest.raises(ValueError, match=word) as told:
        import_model(tmp_path / "theirs.npz")
    assert "theirs.npz" in str(told.value) and "\n" not in str(told.value)


def test_pickles_and_other_files_are_refused(tmp_path):
    (tmp_path / "theirs.pkl").write_bytes(pickle.dumps({"v_template": [0]}))
    (tmp_path / "theirs.npz").write_bytes(b"ply\nformat ascii 1.0\n")
    skinned_worm(False).save(tmp_path / "ours.npz")
    for name, word in (("theirs.pkl", r"a pickle can run any program.*convert it once.*np\.savez\('theirs\.npz'"),
                       ("theirs.npz", "expected a body model as .npz"), ("ours.npz", "a model of ours already"),
                       ("none.npz", "no such file")):
        with pytest.raises(ValueError, match=word):
            import_model(tmp_path / name)


@pytest.mark.parametrize("change", [sparse_parts, changed(kintree_table=lambda v: put(v, (0, 0), -1))])
def test_other_forms_of_the_same_are_read(tmp_path, change):
    arrays = dict(smpl())
    change(arrays)
    np.savez(tmp_path / "theirs.npz", **arrays)
    found = import_model(tmp_path / "theirs.npz")
    np.testing.assert_allclose(found.skeleton.joints, smpl()["J_regressor"] @ smpl()["v_template"], atol=1e-12)


def test_half_precision_is_read_and_told(tmp_path):
    np.savez(tmp_path / "theirs.npz", **{**smpl(), "v_template": smpl()["v_template"].astype(np.float16)})
    found = import_model(tmp_path / "theirs.npz")
    assert "v_template is float16" in found.info["notes"]
    np.testing.assert_allclose(found.rest, smpl()["v_template"], atol=1e-3)
