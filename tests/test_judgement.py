"""A result that means nothing is said in a line, with the likely cause and exit code 1; the files are there.

The limits were chosen on real data, see the comments beside them; here is that each is heard where it belongs.
"""
import csv
import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior
from people_bodies import small_people
from quiet_pictures import small_pictures  # noqa: F401 -- fixture
from scanned_shapes import ball as sphere
from scipy import stats

from completion import MarkerLayout, MarkerSequence, write_markers
from completion.__main__ import main
from completion.measuring import bodies
from completion.measuring import template as measuring_template
from completion.mocap.animate.work import AnimateTask as Follow
from completion.mocap.pose.judgement import hardly_seen, judge_motions, motion_doubts, motion_problem
from completion.mocap.pose.marked_body import AnimateConfig
from completion.mocap.subject.misplaced_markers import MisplacedMarkers
from completion.mocap.subject.person import PersonConfig
from completion.motion import Motion
from completion.partial.settings import CompletionConfig
from completion.partial.work import CompletionInputs, CompletionTask, complete_files
from completion.tracking.cli import wrong_size
from completion.tracking.sequence import tracking_doubts, tracking_problem
from model.coregistration.rounds import coregistration_doubts, coregistration_problem
from model.evaluation.errors import Errors, errors_problem
from model.learning.scape import judge_model, learn_scape, learning_problem
from model.people import ASKED, person_judgement
from scanprep import Mesh, command_line, config_files, write_landmarks, write_mesh
from scanprep.alignment.views import align_views, views_doubts, views_problem
from scanprep.batch.room import TaskContext
from scanprep.cleaning.clean_scan import clean_scan, cleaning_doubts
from scanprep.cli import Output
from scanprep.console import Metric, Outcome
from scanprep.correspondence.correspondences import Correspondences, correspondences_doubts, correspondences_problem
from scanprep.geometry.files import PointCloud, write_points
from scanprep.judgement import Judgement, carry_judgements, judge_many, read_judgement, size
from scanprep.pipeline.prepare import PrepareConfig
from scanprep.plausible import ONE_OF, USUAL, WrongScaleError, implausible_body, longest_betas
from scanprep.registration.nonrigid import Registration, registration_problem
from scanprep.registration.schedule import RegistrationConfig
from scanprep.skeleton.find import skeleton_problem
from scanprep.skeleton.tree import Skeleton

MARKS = {"head": 10, "tail": 380, "left": 100, "right": 200, "middle": 250}
LABELS = tuple(f"M{i}" for i in range(30))
ROWS = np.random.default_rng(4).choice(396, 30, replace=False)
QUICK = CompletionConfig(random_starts=4, rounds=3, scan_points=600, model_points=300)
FEW_NODES = RegistrationConfig(tuple(                              # for a body of 398 vertices
    dataclasses.replace(stage, nodes=min(stage.nodes, 100), rounds=min(stage.rounds, 8))
    for stage in RegistrationConfig().graph))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A template and a good scan of it, a ball, too few points, the scan in another unit, and a view of one side."""
    monkeypatch.chdir(tmp_path)
    body = worm_with_prior().template
    write_mesh("template.ply", body)
    write_landmarks("template.landmarks.json", MARKS)
    moved = body.with_vertices(body.vertices * [1, 1.05, 0.97] + [0, 0, 0.05])
    write_mesh("good.ply", moved)
    write_landmarks("good.json", {name: moved.vertices[v] for name, v in MARKS.items()})
    directions = np.random.default_rng(0).normal(size=(1500, 3))
    ball = 0.8 * directions / np.linalg.norm(directions, axis=1)[:, None] + body.vertices.mean(axis=0)
    write_points("ball.ply", PointCloud(ball))
    large = sphere(3, 0.8)
    write_mesh("ball_mesh.ply", Mesh(large.vertices + body.vertices.mean(axis=0), large.faces))
    write_points("ten.ply", PointCloud(moved.vertices[::40]))
    write_mesh("large.ply", Mesh(30 * moved.vertices, moved.faces))
    write_landmarks("large.json", {name: 30 * moved.vertices[v] for name, v in MARKS.items()})
    write_points("half.ply", PointCloud(half_view(body, np.array([0.0, -1.0, 0.0]))[0]))
    Path("quick.toml").write_text(config_files.write_settings({"config": FEW_NODES}))
    whole = PrepareConfig(dataclasses.replace(PrepareConfig().scan, registration=FEW_NODES))
    Path("quick_set.toml").write_text(config_files.write_settings({"config": whole}))
    return tmp_path


REGISTER = "prep register {}.ply --template template.ply -o out.ply --config quick.toml"
NOTHING = {
    "a ball": (REGISTER.format("ball"), ["of the scan lies off the template", "a scan of something else"]),
    "ten points": (REGISTER.format("ten"), ["0% of the template has data", "a scan of something else"]),
    "a ball to align": ("prep align ball_mesh.ply good.ply -o out.ply", ["a start far from the target"]),
    "another unit to align": ("prep align large.ply good.ply -o out.ply --unit m", ["--unit", "times as large"]),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", NOTHING)
def test_a_command_says_that_its_result_means_nothing(place, capsys, case):
    command, words = NOTHING[case]
    assert main(command.split()) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if "THE RESULT MEANS NOTHING" in line]
    assert len(said) == 1 and all(word in said[0] for word in words), said
    told = json.loads(Path("out.ply.report.json").read_text())
    assert Path("out.ply").exists() and told["judgement"]["verdict"] == "failed"
    assert told["judgement"]["reasons"][0] in said[0]
    if case == "ten points":                                        # there is nothing to converge to
        assert {"metric": "converged", "value": "False", "unit": ""} in told["metrics"]
        assert {"metric": "distance to the scan, RMS", "value": None, "unit": "mm"} in told["metrics"]


def test_another_unit_is_refused_before_the_search(place, tmp_path, capsys):
    assert main(f"{REGISTER.format('large')} --landmarks large.json --unit m".split()) == 1
    said = capsys.readouterr().err
    assert "large.ply: it is" in said and "times as large as the body: the wrong unit? (--unit)" in said
    assert not Path("out.ply").exists()
    work = CompletionTask(worm_with_prior().subject(None), "model.npz", MARKS, QUICK, "in")
    with pytest.raises(WrongScaleError, match=r"the scan is .* times as large as the body: the wrong unit"):
        complete_files(work, CompletionInputs((Path("half.ply"),)), TaskContext(tmp_path / "out"))


@pytest.mark.slow
def test_a_scan_of_something_else_is_a_failure_of_a_set(place, capsys):
    Path("scans").mkdir()
    for name in ("ten", "good"):
        Path(f"{name}.ply").rename(f"scans/{name}.ply")
    command = "prep run scans --template template.ply -o set --through pose --workers 1 --config quick_set.toml"
    assert main(command.split()) == 1
    assert "ten.ply: the template is not on it" in capsys.readouterr().err
    # the table and the report have a verdict on every scan
    verdicts = {row["name"]: row["verdict"] for row in csv.DictReader(Path("set/registration.csv").open())}
    told = {row["name"]: row for row in json.loads(Path("set/report.json").read_text())["scans"]}
    assert verdicts == {name: row["verdict"] for name, row in told.items()} and set(verdicts) == {"good", "ten"}
    assert verdicts["ten"] == "failed" and "the template is not on it" in told["ten"]["reasons"][0]
    assert "nan" not in Path("set/registration.csv").read_text() and "none" in Path("set/registration.csv").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("scan", "words"), [("half", None), ("ball", ["explains", "a scan of something else"])])
def test_completions(place, tmp_path, scan, words):
    model = worm_with_prior()
    work = CompletionTask(model.subject(None), "model.npz", MARKS, QUICK, None)
    rows = complete_files(work, CompletionInputs((Path(f"{scan}.ply"),)), TaskContext(tmp_path / "out"))
    check(rows, words)
    assert (tmp_path / "out" / "completed.ply").exists()


def check(rows: list[Metric], words):
    judgement = Judgement.read(rows[0].value)
    if words is None:
        assert judgement.verdict == "good", judgement
    else:
        assert judgement.verdict == "failed" and all(word in judgement.why for word in words), judgement


def walk(layout, scale=1.0):
    """Markers of a layout on a body that bends a little."""
    model, t = worm_with_prior(), np.arange(12) / 30
    poses = 0.1 * np.sin(3 * t)[:, None, None] * np.ones((12, 4, 3))
    bodies = model.subject(None).vertices(poses, np.stack([t, 0 * t, 0 * t], axis=1))
    positions = np.stack([layout.place(model.template.with_vertices(v)) for v in bodies])
    return MarkerSequence(scale * positions, layout.labels, 30.0)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "words"), [
    ("good", None), ("tenth", ["--unit", "0.1"]), ("shuffled", ["another layout"]),
    ("mirrored", ["left and right"])])
def test_motions(tmp_path, case, words):
    model = worm_with_prior()
    layout = MarkerLayout(LABELS, ROWS, 0.012)
    layout.save(tmp_path / "layout.json")
    markers = walk(layout, 0.1 if case == "tenth" else 1.0)
    if case == "shuffled":
        markers = dataclasses.replace(markers, labels=tuple(np.random.default_rng(1).permutation(LABELS).tolist()))
    if case == "mirrored":                                          # head and tail exchanged
        x = markers.positions[0, :, 0]
        order, back = np.argsort(x), np.argsort(-x)
        labels = np.empty(30, dtype=object)
        labels[order] = np.array(LABELS, dtype=object)[back]
        markers = dataclasses.replace(markers, labels=tuple(labels))
    write_markers(tmp_path / "walk.csv", markers)
    work = Follow(model, "model.npz", str(tmp_path / "layout.json"), model.subject(None), None, None, "m", None,
                  AnimateConfig(), PersonConfig())
    check(work(tmp_path / "walk.csv", TaskContext(tmp_path / "out")), words)
    assert (tmp_path / "out" / "motion.npz").exists()


def test_a_motion_without_any_marker_means_nothing():
    layout = MarkerLayout(LABELS, ROWS, 0.012)
    markers = walk(layout)
    empty = Motion(np.zeros((12, 4, 3)), np.zeros((12, 3)), None, 30.0, np.full((12, 30), np.nan), LABELS)
    assert "no marker" in motion_problem(empty, worm_with_prior().template, layout, markers)


def test_a_body_that_is_not_found_in_the_frames_means_nothing():
    found = np.arange(20) < 1
    motion = Motion(np.zeros((20, 4, 3)), np.zeros((20, 3)), None, 30.0, np.full((20, 1), 0.2), ("surface",),
                    converged=found)
    assert "5% of the frames" in tracking_problem(motion) and "200 mm" in tracking_problem(motion)
    assert tracking_problem(dataclasses.replace(motion, converged=found[::-1] | (np.arange(20) > 9))) is None
    nothing = dataclasses.replace(motion, residuals=np.full((20, 1), np.nan))
    assert "no frame shows anything" in tracking_problem(nothing)
    body = worm_with_prior().template
    assert tracking_doubts(nothing, body) == [] and "lost in 19 of 20 frames" in tracking_doubts(motion, body)[0]
    near = dataclasses.replace(motion, converged=np.arange(20) > 0, residuals=np.full((20, 1), 0.002 * size(body)))
    assert tracking_doubts(near, body) == []
    assert "the wrong scale" in tracking_doubts(dataclasses.replace(near, residuals=10 * near.residuals), body)[0]


def test_frames_that_cannot_show_the_body_mean_nothing():
    """Specks explain themselves well: a hand can be laid over them in every frame."""
    person = worm_with_prior().subject(None)
    points, unseen = person.template.vertices, PointCloud(np.zeros((0, 3)))
    half = PointCloud(points[points[:, 2] > np.median(points[:, 2])])
    assert wrong_size([[PointCloud(points)], [half]], person) is None and wrong_size([[half]], person) is None
    assert wrong_size([[], [unseen], [PointCloud(points[:9]), PointCloud(points)]], person) is None
    assert "0.01 times as large" in wrong_size([[PointCloud(0.01 * points)]] * 9, person)


def test_a_motion_of_hardly_any_frames_is_to_be_looked_at():
    residuals = np.full((10, 5), np.nan)
    residuals[:5, :3] = residuals[5:, :2] = 0.004
    motion = Motion(np.zeros((10, 4, 3)), np.zeros((10, 3)), None, 30.0, residuals, tuple("abcde"))
    assert hardly_seen([motion]) == ()
    (told,) = hardly_seen([motion, dataclasses.replace(motion, residuals=np.full((10, 5), np.nan))])
    assert told.startswith("15 of 20 frames show fewer than 3 markers")


def test_unsure_correspondences_mean_nothing():
    vertices, points = np.arange(5), np.zeros((5, 3))
    assert correspondences_problem(Correspondences(vertices, points, np.full(5, 0.8))) is None
    assert "0.30" in correspondences_problem(Correspondences(vertices, points, np.full(5, 0.3)))
    assert "0.43" in correspondences_problem(Correspondences(vertices, points, np.full(5, 0.43)))      # limbs mistaken
    assert "0.73" in correspondences_doubts(Correspondences(vertices, points, np.full(5, 0.73)))[0]
    assert correspondences_doubts(Correspondences(vertices, points, np.full(5, 0.79))) == []
    assert "0 pairs" in correspondences_problem(Correspondences(vertices[:0], points[:0], np.zeros(0)))


def test_a_figure_without_a_value_says_none():
    assert Metric("rms", float("nan"), "mm").text() == "none" and Metric("rms", 0.5).text() == "0.5"


def test_models_mean_nothing_when_their_errors_are_a_hands_width():
    model = dataclasses.replace(worm_with_prior(), info={"left_out_error": 0.008})
    body = model.template.vertices
    assert learning_problem(model) is None and learning_problem(model, body[None] * [[[1.1, 0.9, 1]]]) is None
    assert "--unit" in learning_problem(model, 1000 * body[None])
    wrong = dataclasses.replace(model, info={"left_out_error": 0.2})
    assert "200 mm" in learning_problem(wrong) and "too few poses" in learning_problem(wrong)


def test_a_model_of_meshes_that_are_all_alike_means_nothing():
    body = worm_with_prior().template
    bodies = np.tile(body.vertices, (4, 1, 1))
    whole = Skeleton(np.zeros(len(body.faces), dtype=int), np.array([-1]), body.vertices.mean(axis=0)[None], ("body",))
    model = learn_scape(body, bodies, bodies, whole)
    assert "neither in pose nor in shape" in judge_model(model).why and judge_model(model).verdict == "failed"


def test_a_model_says_which_joints_it_never_saw_bend():
    worm = worm_with_prior()
    poses = np.random.default_rng(0).normal(0, 0.3, (8, 4, 3))
    poses[:6, 2], poses[6:, 2] = np.radians([0, 3, 3]), 0.5            # only how the people stand bends it
    skeleton = dataclasses.replace(worm.skeleton, names=("trunk", "head", "forearm_right", "tail"))
    model = dataclasses.replace(worm, skeleton=skeleton, pose_examples=poses, info={"poses": 6})
    found = judge_model(model)
    assert found.verdict == "check" and found.why.startswith("the right elbow never bent more than 5 degrees")
    assert judge_model(dataclasses.replace(model, info={"poses": 8})).verdict == "good"
    crude = judge_model(dataclasses.replace(model, info={"poses": 8, "left_out_error": 0.04}))
    assert crude.verdict == "check" and "40 mm off: it needs more poses" in crude.why
    assert judge_model(dataclasses.replace(model, info={"poses": 6, "left_out_error": 0.2})).verdict == "failed"


def test_errors_of_bodies_in_another_unit_mean_nothing():
    model = worm_with_prior()
    body = model.template.vertices[None]

    def errors(mean):
        return Errors(np.array([mean]), np.array([mean]), np.array([mean]), np.zeros(1), np.zeros((1, 4)))

    assert errors_problem(errors(0.01), body, model) is None
    assert "another order" in errors_problem(errors(0.5), body, model)
    assert "--unit" in errors_problem(errors(500.0), 1000 * body, model)


def test_co_registrations_that_explain_nothing_mean_nothing():
    model = worm_with_prior()
    scan = model.template.vertices

    def done(explained, good):
        found = tuple(SimpleNamespace(explained=share) for share in explained)
        return SimpleNamespace(registrations=found, good=np.array(good), model=model)

    assert coregistration_problem(done([0.99, 0.2], [True, False]), [scan, scan]) is None
    assert coregistration_doubts(done([0.9, 0.9], [True, False]), ["a", "b"]) == ["b does not fit the model"]
    assert "0 of 2 scans" in coregistration_problem(done([0.9, 0.9], [False, False]), [scan, scan])
    assert "--unit" in coregistration_problem(done([0.1, 0.1], [True, False]), [1000 * scan, 1000 * scan])


def test_views_of_which_none_is_in_place_mean_nothing():
    views = [(sphere(2, 0.1), np.zeros(3)), (sphere(2, 0.1), np.zeros(3))]
    apart = [(Mesh(mesh.vertices + 5 * k, mesh.faces), camera) for k, (mesh, camera) in enumerate(views)]
    found = align_views(apart)
    assert not found.converged and np.isnan(found.rms) and "no view is in its place" in views_problem(found)
    assert views_doubts(found, ["front", "back"])[1] == "the place of back is uncertain"


def test_a_skeleton_of_one_part_means_nothing():
    one = SimpleNamespace(skeleton=SimpleNamespace(parents=np.array([-1])))
    assert "do not differ in pose" in skeleton_problem(one, None) and skeleton_problem(one, 1) is None
    assert skeleton_problem(SimpleNamespace(skeleton=SimpleNamespace(parents=np.array([-1, 0]))), None) is None


@pytest.mark.parametrize(("far", "seen", "off", "stretch", "words"), [
    (0.15, 0.8, 0.001, 1.0, None), (0.15, 0.7, 0.03, 2.5, ["left and right exchanged"]),
    (0.0, 0.9, 0.3, 1.0, ["left and right exchanged"]), (0.9, 0.005, 0.001, 1.0, ["something else"]),
    (0.42, 0.87, 0.001, 1.0, None), (0.0, 0.3, 0.001, 1.0, None), (0.0, 0.15, 0.001, 1.0, ["part of the body only"]),
    (0.32, 0.28, 0.001, 1.0, ["32% of the scan lies off"])])
def test_registrations_by_their_figures(far, seen, off, stretch, words):
    """Limbs in a wrong place alone need a look; with a tenth of the surface stretched too it is the sides."""
    body = worm_with_prior().template
    count = len(body.vertices)
    drawn = body.vertices.copy()
    drawn[drawn[:, 0] > 1] *= stretch
    fit = Registration(Mesh(drawn, body.faces), np.zeros(count), np.arange(count) < seen * count, 0.001, off, True, 1,
                       {}, 0, np.ones(count), far)
    told = registration_problem(body, body, fit, True)
    assert (told is None) if words is None else all(word in told for word in words), told


def test_an_alignment_that_did_not_converge_is_to_be_looked_at(place, capsys):
    assert main("prep align large.ply good.ply -o out.ply".split()) == 0            # read in inches, in which it fits
    told = json.loads(Path("out.ply.report.json").read_text())
    assert {"metric": "converged", "value": "False", "unit": ""} in told["metrics"]
    assert told["judgement"]["verdict"] == "check" and "did not converge" in told["judgement"]["reasons"][0]


def test_an_outcome_always_says_what_it_is_worth(tmp_path, capsys):
    def make(output: Path) -> Outcome:
        """Make something of unknown worth."""
        output.write_text("made")
        return Outcome(output, [], judgement=None)

    make.__annotations__ = {"output": Output, "return": Outcome}
    with pytest.raises(TypeError, match="judgement"):
        Outcome(None, [])
    assert command_line.run(make, "scape x", ["-o", str(tmp_path / "a.txt")]) == 1      # so in every test that runs one
    assert "what was made has a judgement" in capsys.readouterr().err


COMMANDS = ("prep clean good.ply -o clean.ply", "prep fill good.ply -o filled.ply",
            "prep decimate good.ply --faces 300 -o fewer.ply", "prep template good.ply --faces 500 -o mine.ply",
            "prep repair good.ply -o repaired.ply", "prep correspond good.ply --template template.ply -o pairs.json",
            "prep register good.ply --template template.ply --config quick.toml -o out.ply",
            "prep register good.ply --template template.ply --config quick.toml --landmarks good.json -o out.ply",
            "prep align good.ply template.ply -o aligned.ply",
            "model info model.npz", "model mesh model.npz -o mesh.ply", "model sample model.npz -n 2 -o sampled",
            "model export model.npz -o body.bvh", "model export model.npz -o body.ply",
            "model resample model.npz --vertices 200 -o small.npz")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_first_row_of_every_command_is_a_verdict(place, monkeypatch, command):
    shown = []
    monkeypatch.setattr(command_line, "show", shown.extend)
    worm_with_prior().save("model.npz")
    code = main(command.split())
    assert code == ("correspond" in command)             # a worm has no limbs by which they would be sure
    assert shown[0].name == "judgement" and shown[0].value == ("failed" if code else "good")
    if "-o" in command:
        output = Path(command.split()[-1])
        report = output / "report.json" if output.is_dir() else Path(f"{output}.report.json")
        assert json.loads(report.read_text())["judgement"]["verdict"] == shown[0].value


def reported(path, verdict, *reasons, written=None):
    """A file, and the report that a command would have written beside it."""
    Path(f"{path}.report.json").write_text(json.dumps({
        "judgement": {"verdict": verdict, "reasons": reasons}, **({} if written is None else {"written": written})}))


def test_a_verdict_travels_with_the_body_into_what_uses_it(place, capsys):
    command = "prep clean good.ply -o out.ply"
    reported("good.ply", "failed", "the template is not on it")
    assert main(command.split()) == 1
    assert "good.ply: its own report says that it failed: the template is not on it" in capsys.readouterr().err
    assert json.loads(Path("out.ply.report.json").read_text())["judgement"]["verdict"] == "failed"
    reported("good.ply", "check", "an arm is missing")
    assert main(command.split()) == 0 and "an arm is missing" in capsys.readouterr().err
    reported("good.ply", "failed", "another body", written={"good.ply": "0123"})        # since then it was replaced
    assert main(command.split()) == 0 and "another body" not in capsys.readouterr().err


def test_doubts_of_what_is_only_taken_along_stay_its_own(tmp_path):
    model, body = tmp_path / "model.npz", tmp_path / "body.ply"
    for path in (model, body):
        path.write_bytes(b"x")
        reported(path, "check", "look")
    assert carry_judgements([body], [body, model]).reasons == (f"{body}: its own report says to look at it: look",)
    reported(model, "failed", "nothing learned")
    assert carry_judgements([body], [body, model]).verdict == "failed"
    for report in ('{"judgement": 3}', "[]", '{"judgement": {"verdict": "superb", "reasons": []}}', "{"):
        Path(f"{model}.report.json").write_text(report)
        assert read_judgement(model) is None


def test_many_results_are_as_good_as_the_worst_of_them():
    good, bad = Judgement(), Judgement.of("nothing there")
    assert judge_many({"a": good, "b": good}).verdict == "good"
    assert judge_many({"a": good, "b": bad}).reasons == ("1 of 2 failed", "b: nothing there")
    assert judge_many({"a": good, "b": bad}).verdict == judge_many({"a": good}, failures=1).verdict == "check"
    assert judge_many({"b": bad}).verdict == judge_many({}, failures=2).verdict == "failed"


@pytest.mark.parametrize(("stature", "volume", "betas", "verdict", "word"), [
    (1.75, 75, 2.0, "good", ""), (1.50, 45, 4.0, "good", ""), (2.00, 140, 4.0, "good", ""),
    (2.61, 290, 20.0, "failed", "scale"), (4.04, 1150, 46.0, "failed", "scale"), (0.62, 6, 6.0, "failed", "scale"),
    (0.93, 12, 6.0, "check", "child"), (1.20, 25, 5.0, "check", "child"), (2.20, 120, 5.0, "check", "giant"),
    (1.75, 190, 5.0, "check", "second person"),
    (1.75, 30, 5.0, "check", "flattened"),
    (1.75, 400, 5.0, "failed", "several"), (1.75, 75, 9.0, "check", "standard deviations"),
    (1.75, 75, 6.5, "good", ""), (1.75, 75, 13.8, "failed", "scale")])
def test_bodies_beyond_what_people_are(stature, volume, betas, verdict, word):
    found = implausible_body(stature, volume, np.eye(18)[0] * betas)
    assert found.verdict == verdict and word in found.why, found


@pytest.mark.slow
def test_betas_that_somebody_typed_are_the_cause_of_the_body_that_they_make():
    model = small_people()
    found = person_judgement(model, np.array([20.0]), ASKED)
    assert found.verdict == "failed" and found.reasons[0].endswith(ASKED) and "--unit" not in found.why
    assert person_judgement(model, np.array([2.0, -1.0]), ASKED).verdict == "good"


def test_time_that_is_told_wrongly_is_seen_in_the_speed_of_markers():
    model, layout = worm_with_prior(), MarkerLayout(LABELS, ROWS, 0.012)
    markers = walk(layout)
    motion = SimpleNamespace(residuals=np.full(markers.positions.shape[:2], 0.004), distrusted=(), labels=LABELS,
                             converged=np.ones(len(markers.positions), dtype=bool))
    assert motion_doubts([motion], [markers], model.template) == ()
    (told,) = motion_doubts([motion], [dataclasses.replace(markers, rate=300.0)], model.template)
    assert told.endswith("frames in another order, or the wrong rate?")
    off = SimpleNamespace(**{**vars(motion), "residuals": motion.residuals + 0.02 * size(model.template)})
    assert "mm from where the body has them" in motion_doubts([off], [markers], model.template)[0]
    lost = Motion(np.zeros((len(markers.positions), 1, 3)), np.zeros((len(markers.positions), 3)), None, 300.0,
                  np.full(markers.positions.shape[:2], 0.5), LABELS)
    told = motion_problem(lost, model.template, layout, dataclasses.replace(markers, rate=300.0))
    assert told.endswith("the wrong rate?")                    # not swapped labels


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_a_motion_that_did_not_settle_or_lost_the_body_needs_a_look(scale):
    """Whatever the size: it was good with no frame settled, and with markers 27 cm off in one frame."""
    model, layout = worm_with_prior(), MarkerLayout(LABELS, ROWS, 0.012)
    markers, body = walk(layout), Mesh(scale * model.template.vertices, model.template.faces)
    far = np.full(markers.positions.shape[:2], 0.003 * size(body))
    motion = SimpleNamespace(residuals=far, distrusted=(), labels=LABELS, converged=np.ones(len(far), dtype=bool))
    slow = dataclasses.replace(markers, positions=scale * markers.positions)
    assert motion_doubts([motion], [slow], body) == ()
    # a quarter is unsettled in the fastest good recordings; frames that show nothing cannot settle
    motion.converged = np.arange(len(far)) % 4 > 0
    assert motion_doubts([motion], [slow], body) == ()
    hidden = SimpleNamespace(**{**vars(motion), "residuals": np.where(motion.converged[:, None], far, np.nan)})
    hidden.converged = motion.converged & (np.arange(len(far)) % 4 > 1)
    assert motion_doubts([hidden], [slow], body) == ()
    motion.converged = np.zeros(len(far), dtype=bool)
    (doubt,) = motion_doubts([motion], [slow], body)
    assert doubt.startswith("only 0% of the frames settled")
    # one ghost marker is no lost body, half of the markers are
    motion.converged[:] = True
    far[2, 0] = size(body)
    assert motion_doubts([motion], [slow], body) == ()
    far[2, ::2], far[2, 1] = 0.2 * size(body), 0.2 * size(body)
    (doubt,) = motion_doubts([motion], [slow], body)
    assert doubt.startswith(f"in 1 of {len(far)} frames half of the markers are far")


def test_a_ghost_of_one_frame_says_nothing_of_the_unit():
    layout = MarkerLayout(LABELS, ROWS, 0.012)
    markers = walk(layout)
    positions = np.array(markers.positions)
    positions[3, 5] += [0.0, 0.0, 50.0]
    motion = Motion(np.zeros((len(positions), 4, 3)), np.zeros((len(positions), 3)), None, 30.0,
                    np.full(positions.shape[:2], 0.004), LABELS)
    body = worm_with_prior().template
    assert motion_problem(motion, body, layout, dataclasses.replace(markers, positions=positions)) is None
    big = dataclasses.replace(markers, positions=10 * markers.positions)
    assert "the wrong unit?" in motion_problem(motion, body, layout, big)


def test_the_size_of_a_body_far_from_its_markers_is_told_last():
    person, own = Judgement.of("the person is 3.08 m tall"), Judgement.of("the markers are 421 mm off")
    body = worm_with_prior().template
    for off, first in ((0.5, own), (0.03, person)):
        motion = SimpleNamespace(residuals=np.full((3, 2), off * size(body)))
        assert judge_motions(person, own, [motion], body).reasons[0] == first.reasons[0]


def test_a_recording_whose_sides_are_all_exchanged_may_be_mirrored():
    labels = ("LSHO", "RSHO", "LELB", "RELB", "LKNE", "RKNE", "C7")
    pairs = tuple(zip(labels[:6:2], labels[1:6:2], strict=True))
    assert "mirrored recording" in MisplacedMarkers(exchanged=pairs).judgement(labels).doubts[0]
    assert MisplacedMarkers(exchanged=pairs[:1]).judgement(labels).doubts == ()      # two labels mixed up are put back


def test_what_cannot_be_measured_for_its_size_is_told_so(monkeypatch):
    monkeypatch.setattr(measuring_template, "lay_people", lambda mesh: None)
    ball = sphere(2, 1.0)
    for half, told in ((2.5, "wrong unit or scale"), (0.9, "^measuring begins")):
        slim = ball.with_vertices(half * ball.vertices * [0.15, 0.15, 1])
        with pytest.raises(ValueError, match=told):
            measuring_template.tape_template(None, [bodies.Body("a", slim, Path("a.ply"), np.zeros(0))], None)


def test_a_reason_stays_one_when_it_is_read_again():
    told = Judgement.of("the markers are 117 mm off; labels swapped?", ["look", "look"])
    assert told.reasons == ("the markers are 117 mm off: labels swapped?", "look") and Judgement.read(str(told)) == told


def test_a_second_person_is_no_furniture():
    one, many = sphere(3, 0.5), np.array([[0, 0, 0], [3.0, 0, 0]])
    both = Mesh(np.vstack([one.vertices + at for at in many]), np.vstack([one.faces, one.faces + len(one.vertices)]))
    assert cleaning_doubts(clean_scan(one)) == []
    assert "a second person?" in cleaning_doubts(clean_scan(both))[0]


@pytest.mark.parametrize("count", [1, 3, 18, 80])
def test_hardly_anybody_has_longer_betas(count):
    """[MoSh] Eq. 20: a sum of squares of so many standard normal numbers, by the distribution of another library."""
    length = longest_betas(count)
    assert length**2 == pytest.approx(max(stats.chi2.isf(1 / ONE_OF, count), USUAL**2 * count))
