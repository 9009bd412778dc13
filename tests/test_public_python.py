"""What a user of Python sees: tables with names, verdicts, errors that help, and results in one line."""
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scan_folders import ball

from completion import (
    Completion,
    MarkerSequence,
    MarkerStream,
    Motion,
    animate,
    joint_angles,
    joint_centres,
    load_layout,
    measure_completion,
    retarget,
    transfer_layout,
)
from model import fit_pose, load_built_in_model, make_rig, pose_errors, read_motion, sample_bodies
from scanprep import (
    Correspondences,
    RegistrationConfig,
    SyntheticPerson,
    make_template,
    register,
    register_scans,
    write_mesh,
)
from scanprep.judgement import Judgement
from scanprep.pipeline.prepare import PrepareConfig, ScanSettings
from scanprep.registration.verdict import judge_registration

MODEL = load_built_in_model()
J, N = len(MODEL.skeleton.parents), len(MODEL.template.vertices)
STILL = Motion(np.zeros((2, J, 3)), np.zeros((2, 3)), None, 100.0, np.zeros((2, 0)))


@pytest.fixture(scope="module")
def whole():
    seen, error = np.ones(N, dtype=bool), np.full(N, 0.01)
    return Completion(MODEL.template, MODEL.template, np.zeros((J, 3)), np.zeros(3), np.zeros(3), seen, 0.001, 0.98,
                      np.nan, True, 12, {"data": 1.0}, expected_error=error, judgement=Judgement())


def test_a_model_stands_for_its_template_and_its_vertices():
    layout = load_layout("cmu41", MODEL)
    same = load_layout("cmu41", MODEL.template, np.array(MODEL.info["people_vertices"]))
    np.testing.assert_array_equal(layout.vertices, same.vertices)
    np.testing.assert_array_equal(layout.place(MODEL), layout.place(MODEL.template))
    assert transfer_layout(layout, MODEL, MODEL).layout is layout


def test_joint_angles_are_columns_with_names():
    table = joint_angles(STILL, MODEL.subject())
    assert list(table)[:2] == ["time", f"{MODEL.skeleton.names[0]}_rx"] and len(list(table)) == 1 + 3 * J
    assert float(table["time"][1]) == 0.01


@pytest.mark.parametrize("call", [
    lambda layout: joint_angles(STILL, MODEL), lambda layout: joint_centres(STILL, MODEL),
    lambda layout: STILL.vertices(MODEL), lambda layout: retarget(STILL, MODEL.subject(), MODEL),
    lambda layout: retarget(STILL, MODEL, MODEL.subject()), lambda layout: fit_pose(MODEL, MODEL.template.vertices),
    lambda layout: pose_errors(MODEL, MODEL.template.vertices[None], MODEL),
    lambda layout: read_motion("walk.npz", MODEL, MODEL),
    lambda layout: MarkerStream(MODEL, layout, layout.labels, 100.0),
    lambda layout: animate(MODEL, MarkerSequence(layout.place(MODEL)[None], layout.labels, 100.0), layout)])
def test_a_model_in_place_of_a_person_is_told_how_to_make_one(call):
    with pytest.raises(TypeError, match=r"model\.subject\(None\)"):
        call(load_layout("cmu41", MODEL))


def test_results_are_told_in_one_line(whole):
    told = repr(whole)
    assert told.startswith(f"Completion(good, completed=Mesh({N} vertices") and "rms=0.001" in told and "\n" not in told
    fit = register(ball(), ball(), config=RegistrationConfig.quick())
    errors = pose_errors(MODEL, MODEL.template.vertices[None])
    posed = fit_pose(MODEL.subject(), MODEL.template.vertices)
    for result in (fit, errors, measure_completion(whole), MODEL.subject(), posed):
        assert repr(result).startswith(type(result).__name__) and "\n" not in repr(result) and len(repr(result)) < 400
    assert "errors=Errors(0." in repr(errors)


def test_a_completion_is_measured_with_its_errors(whole):
    found, exact = measure_completion(whole, MODEL), measure_completion(whole)
    assert found.values == exact.values and 1.6 < found.values["stature"] < 1.8
    assert all(error > 0 for error in found.errors.values())
    person = SyntheticPerson().mesh
    with pytest.raises(ValueError, match="the one of this body"):
        measure_completion(Completion(person, person, *[getattr(whole, name) for name in (
            "pose", "betas", "trans", "seen", "rms", "explained", "landmark_rms", "converged", "iterations")]), MODEL)


def test_a_registration_judges_itself_as_the_command_does():
    egg = ball()
    scan = np.concatenate([egg.vertices, egg.vertices + [0.0, 0.0, 5.0]])
    good, bad = (register(egg, each, config=RegistrationConfig.quick()) for each in (egg, scan))
    assert good.judgement.verdict == "good" and bad.judgement.verdict != "good"
    assert pickle.loads(pickle.dumps(bad)).judgement == bad.judgement
    assert bad.judgement == judge_registration("scan", egg, scan, bad, None, None)
    assert replace(bad, judge=None).judgement.reasons == ("no judgement was made",)


def test_other_results_judge_themselves():
    pairs = Correspondences(np.arange(5), np.zeros((5, 3)), np.full(5, 0.3))
    assert pairs.judgement.verdict == "failed"


def test_a_template_and_a_set_are_made_in_one_call_each(tmp_path):
    made = make_template(ball(3, (1, 1, 1)), 500)
    assert made.mesh.is_closed and len(made.mesh.faces) == 500 and made.judgement.verdict == "good"
    write_mesh(tmp_path / "template.ply", made.mesh)
    write_mesh(tmp_path / "scans" / "anna.ply", made.mesh.with_vertices(1.01 * made.mesh.vertices))
    quick = PrepareConfig(ScanSettings(RegistrationConfig.quick(), through="pose"))
    for _ in range(2):
        done = register_scans(tmp_path / "scans", tmp_path / "template.ply", tmp_path / "set", config=quick)
        assert done.registered.names == ("anna",) and done.judgement.verdict in ("good", "check")
    assert not done.fresh and (tmp_path / "set" / "report.html").exists()


def test_bodies_and_rigs_are_public():
    assert sample_bodies(MODEL, 2, np.random.default_rng(0)).vertices.shape == (2, N, 3)
    assert make_rig(MODEL).weights.shape == (N, J)
