"""Hair and clothes are found on a scan, told in words, and the body is sought inside them."""
from dataclasses import replace

import numpy as np
import pytest

from completion.partial.completion import (
    Completion,
    complete,
    load_completion,
    tell_worn,
    widen_errors,
)
from completion.partial.masks import read_mask
from model import find_tapes, load_built_in_model, measure
from model.fitting.bodies import as_body
from model.fitting.hems import find_limbs, has_cuffs
from model.fitting.inside import reach_farther
from model.fitting.not_skin import (
    NotSkin,
    find_backs,
    find_not_skin,
)
from model.fitting.scan import prepare_scan
from model.fitting.scan_fit import scan_fit
from model.fitting.settings import ScanFitConfig
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import Judgement
from scanprep.skeleton.roles import part_kind

MODEL = load_built_in_model()
BODY, NAMES = MODEL.template, MODEL.skeleton.names
PART = MODEL.skeleton.part_of_vertex(BODY)
KINDS = np.array([part_kind(name) for name in NAMES])


def covered(*names: str, by: float) -> Mesh:
    """The body at rest with some of its parts, by name or kind, covered that thick, metres."""
    on = np.isin(PART, [p for p, name in enumerate(NAMES) if name in names or KINDS[p] in names])
    return BODY.with_vertices(BODY.vertices + by * on[:, None] * BODY.vertex_normals)


def found(scan: Mesh, crude: float | None = None):
    person = as_body(MODEL)
    person.left_out_error = crude
    return find_not_skin(BODY, person, prepare_scan(scan), len(scan.vertices))


@pytest.mark.parametrize(("parts", "by", "told"), [
    (("head",), 0.03, ("hair on head",)), (("head", "chest"), 0.03, ("hair on chest and head",)),
    (("pelvis", "thigh", "shin"), 0.04, ("clothes on pelvis, thighs and shins",)),
    (("shin_left",), 0.03, ("clothes on left shin",)), (("thigh_left",), 0.04, ("clothes on left thigh",)),
    (("abdomen",), 0.03, ("hair or clothes on abdomen",)),
    (("head", "thigh"), 0.03, ("hair on head", "clothes on pelvis and thighs"))])
def test_what_is_far_out_is_told_by_its_place(parts, by, told):
    worn = found(covered(*parts, by=by))
    assert set(worn.places) == set(told)
    # it is where it was put, but for the rings around
    share = BODY.vertex_areas @ (worn.vertices & np.isin(PART, [NAMES.index(n) for n in NAMES if n in parts or
                                                                part_kind(n) in parts]))
    assert share > 0.75 * BODY.vertex_areas @ worn.vertices
    # points of a scan in the body's own vertices are those vertices, and what is beside them
    assert worn.points[worn.vertices].mean() > 0.95 and worn.points.mean() < worn.vertices.mean() + 0.1


@pytest.mark.parametrize(("parts", "by"), [((), 0.0), (("head", "thigh", "shin", "chest", "abdomen"), 0.010),
                                           (("hand",), 0.04), (("foot",), 0.02)])
def test_skin_is_not_told(parts, by):
    """A naked body, a heavier one, mittens and shoes."""
    assert found(covered(*parts, by=by)) is None


@pytest.mark.parametrize(("parts", "told"), [
    (("thigh",), ("clothes on pelvis and thighs",)), (("upper_arm",), ("clothes on abdomen, chest and upper arms",)),
    (("thigh_left",), None), (("upper_arm_right",), None), (("chest", "abdomen"), None)])
def test_clothes_that_are_close_are_told_by_their_hems(parts, told):
    """8 mm around both thighs or upper arms, which end at knees or elbows; on one side it is a bandage."""
    worn = found(covered(*parts, by=0.008))
    assert (worn and worn.places) == told
    if told:
        assert worn.sewn[np.isin(KINDS[PART], parts)].mean() > 0.9 and not worn.sewn[KINDS[PART] == "hand"].any()


def test_boots_begin_with_a_step_outward():
    """They hide shins, and what is above them is skin; the same step at the thighs is none of theirs."""
    foot, knee = (BODY.vertices[KINDS[PART] == "shin", 2].min() + z for z in (0.0, 0.40))
    boots = np.clip((0.5 * (foot + knee) - BODY.vertices[:, 2]) / 0.01, 0, 1) * 0.012
    scan = BODY.with_vertices(BODY.vertices + boots[:, None] * BODY.vertex_normals)
    faces, _, points = points_on(scan)
    dense = np.hstack([points, scan.face_normals[faces]])
    worn = find_not_skin(BODY, as_body(MODEL), prepare_scan(dense), len(dense))
    assert worn.places == ("clothes on shins",) and not worn.sewn.any()


@pytest.mark.parametrize(("thick", "told"), [(0.013, True), (0.006, False)])
def test_cuffs_are_edges_at_both_wrists_however_askew(thick, told):
    arms = find_limbs(BODY, MODEL.skeleton, KINDS, "hand")
    faces, bary, _ = points_on(BODY)
    # how far outside the sleeves each point is; their cuffs cross triangles
    outside = [np.einsum("nk,nk->n", bary, (limb.along + 0.4 * limb.across[:, 0] - limb.length)[BODY.faces[faces]])
               for limb in arms]
    left, right = (np.where(one < 0, thick, 0.0) for one in outside)
    assert has_cuffs(BODY, MODEL.skeleton, KINDS, faces, bary, np.fmax(left, right)) == told
    # one sleeve is a bandage
    assert not has_cuffs(BODY, MODEL.skeleton, KINDS, faces, bary, left)


def test_errors_are_wider_under_suits():
    tight = np.full(len(BODY.vertices), 0.002)
    done = widen_errors(replace(completion_of_a_model(), expected_error=tight), MODEL.skeleton, 0.01)
    bare = np.isin(KINDS[PART], ["head", "hand", "foot"])
    assert (done.expected_error[bare] == 0.002).all() and (done.expected_error[~bare] > 0.012).all()
    assert done.confidence[bare].min() > 0.99 and done.confidence[~bare].max() < 0.7
    # 4 to 5 cm of a waist
    tapes = find_tapes(BODY, MODEL.info["landmarks"])
    waist = measure(BODY, tapes, expected_error=done.expected_error, only=["waist_girth"]).errors["waist_girth"]
    assert 0.03 < waist < 0.06


def test_a_pregnant_womans_belly_is_no_bag():
    """25 mm farther out than the body inside, over 20 cm; a bag there is 100 mm thick."""
    middle = BODY.vertices[(KINDS[PART] == "abdomen") & (BODY.vertex_normals[:, 1] < -0.9)].mean(axis=0)
    bulge = np.exp(-(np.linalg.norm(BODY.vertices - middle, axis=1) / 0.10) ** 4)[:, None] * BODY.vertex_normals
    assert found(BODY.with_vertices(BODY.vertices + 0.025 * bulge)) is None
    assert found(BODY.with_vertices(BODY.vertices + 0.10 * bulge)) is not None


def points_on(scan: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """30,000 points, as rings of some millimetres need some each: faces (n,), weights (n, 3) and points (n, 3)."""
    rng = np.random.default_rng(0)
    faces = rng.choice(len(scan.faces), 30_000, p=scan.face_areas / scan.face_areas.sum())
    bary = rng.dirichlet(np.ones(3), len(faces))
    return faces, bary, np.einsum("nk,nkd->nd", bary, scan.corners[faces])


def test_clothes_reach_as_far_as_bare_parts_tell():
    """A loose overall of which only the legs were found: head, hands and feet show that the trunk is thinner."""
    trunk = ("chest", "abdomen", "pelvis", "upper_arm", "forearm", "thigh", "shin")
    scan = prepare_scan(covered(*trunk, by=0.04))
    fit = scan_fit(as_body(MODEL), scan, np.zeros(0, dtype=int), np.zeros((0, 3)), ScanFitConfig())
    legs = np.isin(KINDS[PART], ["thigh", "shin"])
    some = NotSkin(legs, legs.copy(), ("clothes on thighs and shins",), legs | (KINDS[PART] == "upper_arm"))
    x = np.zeros(fit.body.n_angles + 3 + fit.body.n_betas)
    whole = reach_farther(some, fit, x, len(legs))
    assert whole.vertices[np.isin(KINDS[PART], ["chest", "abdomen", "pelvis"])].mean() > 0.8
    assert whole.points[KINDS[PART] == "hand"].mean() < 0.1 and whole.vertices[legs].all()
    assert whole.places == ("clothes on pelvis, abdomen, chest, upper arms, forearms, thighs and shins",)
    # without bare parts nothing can be said
    assert reach_farther(NotSkin(legs | True, legs, (), legs), fit, x, len(legs)).points.sum() == legs.sum()


def test_a_crude_model_and_other_bodies_tell_nothing():
    scan = covered("thigh", by=0.04)
    assert found(scan) is not None and found(scan, crude=0.03) is None
    animal = as_body(MODEL)
    animal.skeleton = replace(MODEL.skeleton, names=tuple(f"part{k}" for k in range(len(NAMES))))
    assert find_not_skin(BODY, animal, prepare_scan(scan), len(scan.vertices)) is None


@pytest.mark.parametrize(("turn", "told"), [(1.0, True), (-1.0, False)])
def test_less_is_told_behind_than_in_front(turn, told):
    """People differ in bellies and faces, not in backs."""
    backs, belly, scalp = find_backs(BODY, PART, KINDS)
    assert not (backs & belly).any() and set(KINDS[PART[belly]]) == {"chest", "abdomen", "pelvis"}
    assert scalp[BODY.vertices[:, 2].argmax()] and not scalp[MODEL.info["landmarks"]["nose tip"]]
    assert (BODY.vertices[backs & (KINDS[PART] == "head")].mean(axis=0) @ [0, 1, 0]
            > BODY.vertices[KINDS[PART] == "head"].mean(axis=0) @ [0, 1, 0])
    side = np.clip(4 * turn * BODY.vertex_normals @ [0, 1, 0], 0, 1) * np.isin(KINDS[PART], ["head", "chest"])
    worn = found(BODY.with_vertices(BODY.vertices + 0.015 * side[:, None] * BODY.vertex_normals))
    assert (worn is not None) == told


def test_hair_on_a_head_is_no_doubt_and_clothes_are():
    done = completion_of_a_model()
    hair = tell_worn(done, np.ones(3, dtype=bool), ("hair on head",))
    assert hair.worn == ("hair on head",) and hair.judgement == done.judgement
    dressed = tell_worn(done, np.ones(3, dtype=bool), ("clothes on thighs", "hair on head"))
    assert dressed.judgement.verdict == "check" and "clothes on thighs" in dressed.judgement.why
    assert "hair" not in dressed.judgement.why


def completion_of_a_model():
    pose, seen = np.zeros((len(NAMES), 3)), np.ones(len(BODY.vertices), dtype=bool)
    return Completion(BODY, BODY, pose, np.zeros(3), np.zeros(3), seen, 0.001, 1.0, np.nan, True, 1,
                      judgement=Judgement.of())


@pytest.mark.slow
def test_the_body_is_sought_inside_trousers(tmp_path):
    """The mask that was found can be read, corrected and given; one without points says that all is skin."""
    scan = covered("thigh", "shin", by=0.04)
    legs = np.isin(KINDS[PART], ["thigh", "shin"])
    inside = complete(MODEL, scan)
    assert inside.worn == ("clothes on pelvis, thighs and shins",) and inside.judgement.verdict == "check"
    as_skin = complete(MODEL, scan, masked=np.zeros(len(scan.vertices), dtype=bool))
    assert as_skin.not_skin is None and as_skin.worn == ()
    # nearer to the truth by a third, and with an error that tells
    off, off_as_skin = (Surface(one.completed).closest(BODY.vertices[legs]).distances.mean()
                        for one in (inside, as_skin))
    assert off < 0.67 * off_as_skin
    assert np.median(inside.expected_error[legs]) > 2 * np.median(inside.expected_error[~legs])
    # files
    folder = inside.save(tmp_path / "done")
    again = load_completion(folder)
    np.testing.assert_array_equal(again.not_skin, inside.not_skin)
    assert again.worn == inside.worn
    np.testing.assert_array_equal(read_mask(folder / "mask.json", scan.vertices), inside.not_skin)
    # a result goes on with its mask, without another search
    on = complete(MODEL, scan, start=inside)
    assert on.worn == inside.worn and (on.not_skin == inside.not_skin).all()
