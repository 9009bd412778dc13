import json
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import worm_with_prior

from completion.partial.completion import (
    Completion,
    beyond_closed,
    completion_doubts,
    find_unexplained,
    load_completion,
)
from completion.partial.settings import CompletionConfig
from model.fitting.bodies import FixedBody
from model.fitting.confidence import estimate_error
from model.fitting.scan import prepare_scan
from model.fitting.scan_fit import scan_fit
from scanprep.geometry import storage
from scanprep.judgement import Judgement
from scanprep.synthetic.people import SyntheticPerson

MODEL = replace(worm_with_prior(), skeleton=replace(worm_with_prior().skeleton,
                                                    names=("trunk", "upper_arm_left", "forearm_left", "head")))


def made(betas):
    rng, pose = np.random.default_rng(0), np.full((4, 3), 0.1)
    mesh = MODEL.template.with_vertices(MODEL.vertices(pose, betas))
    error = rng.random(398)
    return Completion(mesh.with_vertices(mesh.vertices + 0.01), mesh, pose, betas, np.ones(3), error > 0.5, 0.002, 0.9,
                      0.01, True, 9, {"scan_planes": 3.5}, 0.001, error, 1 - error,
                      Judgement("check", ("the left hand may be 90 mm off, nothing of it was seen", "a leg")),
                      (0.022, 0.001))


@pytest.mark.parametrize("betas", [None, np.arange(3.0)], ids=["known", "unknown"])
def test_a_completion_comes_back_from_its_folder(tmp_path, betas):
    saved = made(betas)
    again = load_completion(saved.save(tmp_path))
    for name in ("pose", "trans", "seen", "expected_error", "confidence"):
        np.testing.assert_array_equal(getattr(again, name), getattr(saved, name))
    assert again.betas is None if betas is None else np.array_equal(again.betas, betas)
    for name in ("rms", "explained", "landmark_rms", "converged", "iterations", "energies", "scale", "judgement",
                 "soles"):
        assert getattr(again, name) == getattr(saved, name)
    for name in ("completed", "predicted"):
        np.testing.assert_allclose(getattr(again, name).vertices, getattr(saved, name).vertices, atol=1e-6)
        np.testing.assert_array_equal(getattr(again, name).faces, MODEL.template.faces)


def test_a_folder_of_the_first_version_is_read_without_what_it_lacks(tmp_path):
    saved = made(None)
    saved.save(tmp_path)
    path = tmp_path / "completion.npz"
    with np.load(path) as kept:
        header = json.loads(str(kept["header"]))
        arrays = {name: kept[name] for name in ("pose", "trans", "seen")}
    facts = {name: header[name] for name in header if name not in ("kind", "version", "scale", "judgement")}
    storage.save(path, "completion", 1, arrays, facts)
    again = load_completion(tmp_path)
    assert again.scale == 1 and again.expected_error is None and again.confidence is None and again.rms == saved.rms
    assert again.judgement.verdict == "check" and "no judgement" in again.judgement.why
    again.save(tmp_path)
    assert load_completion(tmp_path).confidence is None


def test_a_folder_that_lacks_an_array_is_refused(tmp_path):
    made(None).save(tmp_path)
    storage.save(tmp_path / "completion.npz", "completion", 2, {"pose": np.zeros((4, 3))}, {})
    with pytest.raises(storage.StorageError, match="it lacks"):
        load_completion(tmp_path)


def test_parts_that_may_be_far_off_are_named_the_worst_first():
    body, x = FixedBody(MODEL.subject(None)), np.zeros(15)
    fit = scan_fit(body, prepare_scan(MODEL.template.vertices), np.zeros(0, dtype=np.int64), np.zeros((0, 3)),
                  CompletionConfig())
    error, seen = np.full(398, 0.004), np.ones(398, dtype=bool)
    error[fit.part == 1] = 0.035
    assert completion_doubts(fit, x, error, seen) == []
    error[fit.part == 1] = 0.045
    seen[np.flatnonzero(fit.part == 1)[::2]] = False
    error[fit.part == 2], seen[fit.part == 2] = 0.25, False
    assert completion_doubts(fit, x, error, seen) == ["the left forearm may be 250 mm off, nothing of it was seen",
                                                      "the left upper arm may be 45 mm off, 49% of it was seen"]


def test_a_model_of_too_few_poses_is_doubted_and_its_errors_are_expected():
    nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    for left_out, told in ((0.01, 0), (0.05, 1)):
        body = FixedBody(replace(MODEL, info={"left_out_error": left_out}).subject(None))
        fit = scan_fit(body, prepare_scan(MODEL.template.vertices), *nothing, CompletionConfig())
        found = completion_doubts(fit, np.zeros(15), np.full(398, 0.004), np.ones(398, dtype=bool))
        assert len(found) == told and all("50 mm off" in reason for reason in found)
    far, off = np.array([0.0, 1.0]), np.zeros(2)
    np.testing.assert_allclose(estimate_error(off, far, 0.001, 0.05), [0.001, 0.0425], rtol=1e-3)
    np.testing.assert_allclose(estimate_error(off, far, 0.001), [0.001, 0.0076], rtol=1e-2)


def test_a_joint_held_as_in_no_known_pose_is_named_and_a_known_way_is_not():
    poses = np.zeros((1, 4, 3))
    poses[0, 1, 0] = np.radians(120)
    fit = scan_fit(FixedBody(replace(MODEL, pose_examples=poses).subject(None)), prepare_scan(MODEL.template.vertices),
                  np.zeros(0, dtype=np.int64), np.zeros((0, 3)), CompletionConfig())
    x, fine = np.zeros(15), (np.full(398, 0.004), np.ones(398, dtype=bool))
    x[:3] = 1.0                                                       # the whole body may stand anyhow
    for degrees, told in ((120, 0), (80, 0), (170, 1), (0, 1)):
        x[3] = np.radians(degrees)
        found = [reason for reason in completion_doubts(fit, x, *fine) if "known to be held" in reason]
        assert len(found) == told, (degrees, found)
    assert f"{120 - degrees} degrees" in found[0]


@pytest.mark.parametrize(("explained", "told"), [(0.98, False), (0.95, True)])
def test_a_limbs_worth_of_scan_without_a_body_is_told(explained, told):
    fit = scan_fit(FixedBody(MODEL.subject(None)), prepare_scan(MODEL.template.vertices), np.zeros(0, dtype=np.int64),
                  np.zeros((0, 3)), CompletionConfig())
    assert find_unexplained(fit,
                            explained) == (["5.0% of the scan has no body near: clutter, or a limb elsewhere"] * told)


def test_a_body_that_goes_on_where_the_scan_is_closed_is_doubted():
    """As one whose ankles were taken for the feet, 16 cm longer than the scan."""
    scan = SyntheticPerson().mesh
    middle = scan.vertices.mean(axis=0)
    longer = scan.with_vertices(middle + (scan.vertices - middle) * [1, 1, 1.2])
    assert beyond_closed(scan, scan) == []
    assert "is outside of the scan, which is closed there" in beyond_closed(scan, longer)[0]
    cut = scan.submesh(scan.corners[:, :, 2].mean(axis=1) > scan.vertices[:, 2].min() + 0.3)[0]
    assert beyond_closed(cut, scan) == []            # what lies beyond a border is missing in the scan
