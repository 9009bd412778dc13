import json
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior
from test_completion_partial import MARKS
from test_completion_tracking import SETTINGS, motion

from completion import Motion
from completion.tracking import cli
from completion.tracking.folder import FrameFolder
from completion.tracking.report import _ranges
from completion.tracking.store import AT_ONCE, FrameStore
from completion.tracking.tracker import TrackedFrame, Tracker
from scanprep.console import run
from scanprep.geometry.files import PointCloud, read_mesh, write_points

FRAMES = 9


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("0 0 0\n1 0 0\n")


def test_frames_are_in_the_order_of_their_numbers(tmp_path):
    touch(tmp_path, "take2_frame9.xyz", "take2_frame10.xyz", "take2_frame008.xyz", "take2_frame12.xyz", "notes.md")
    found = FrameFolder(tmp_path)
    assert found.numbers == [8, 9, 10, 11, 12] and found.cameras == ("",) and len(found) == 5
    assert [len(views) for views in found] == [1, 1, 1, 0, 1]
    np.testing.assert_array_equal(found[0][0].points, [[0, 0, 0], [1, 0, 0]])


def test_steps_and_time_stamps_leave_no_gaps(tmp_path):
    touch(tmp_path / "a", "f0.xyz", "f5.xyz", "f15.xyz")
    touch(tmp_path / "b", "t100023.xyz", "t100107.xyz", "t100190.xyz")
    assert FrameFolder(tmp_path / "a").numbers == [0, 5, 10, 15]
    assert FrameFolder(tmp_path / "b").numbers == [100023, 100107, 100190]


def test_cameras_in_folders_or_by_pattern(tmp_path):
    touch(tmp_path / "a", "left/1.xyz", "left/2.xyz", "right/2.xyz", "right/3.xyz")
    touch(tmp_path / "b", "7_left.xyz", "8_left.xyz", "8_right.xyz")
    by_folder, by_name = FrameFolder(tmp_path / "a"), FrameFolder(tmp_path / "b", "{frame}_{camera}.xyz")
    assert by_folder.cameras == by_name.cameras == ("left", "right")
    assert [len(views) for views in by_folder] == [1, 2, 1] and [len(views) for views in by_name] == [1, 2]
    assert [p.name for p in by_name.paths(1)] == ["8_left.xyz", "8_right.xyz"]


def test_a_folder_that_does_not_fit_is_explained(tmp_path):
    touch(tmp_path / "same", "a_1.xyz", "b_1.xyz")
    touch(tmp_path / "none", "readme.md")
    touch(tmp_path / "unnamed", "scan.xyz")
    for folder, pattern, message in (("missing", None, "no such folder"), ("none", None, "found none"),
                                     ("same", None, r"a_1\.xyz and b_1\.xyz are both frame 1"),
                                     ("unnamed", None, "number of the frame"), ("same", "{camera}.xyz", "--cameras"),
                                     ("same", "x{camera}_{frame}.xyz", "no file is named")):
        with pytest.raises(ValueError, match=message):
            FrameFolder(tmp_path / folder, pattern)
    with pytest.raises(ValueError, match="found a file"):
        FrameFolder(tmp_path / "same" / "a_1.xyz")


def test_a_bad_file_is_a_camera_that_saw_nothing_and_is_named_once(tmp_path):
    touch(tmp_path, "1.xyz", "3.xyz")
    (tmp_path / "2.ply").write_text("ply\nhalf a header")
    (tmp_path / "4.xyz").write_text("")
    found = FrameFolder(tmp_path)
    assert [len(views) for views in found] == [1, 0, 1, 0] and not found[1]
    assert len(found.problems) == 1 and "2.ply" in found.problems[0]


def tracked(number):
    rng = np.random.default_rng(number)
    return TrackedFrame(number, rng.normal(size=9), bool(number % 3), float(rng.random()), 0.5, rng.normal(size=9),
                        rng.normal(size=(9, 9)))


def test_stored_frames_come_back_and_others_are_removed(tmp_path):
    frames, betas = [tracked(i) for i in range(AT_ONCE + 7)], np.array([0.5, -1])
    store = FrameStore(tmp_path, {"rate": 30})
    for frame in frames:
        store.add(frame, betas, ["a.ply: bad"])
    assert len(list(tmp_path.iterdir())) == 1
    store.write(betas, ["a.ply: bad"])
    again = FrameStore(tmp_path, {"rate": 30})
    loaded, found = again.load()
    assert again.problems == ["a.ply: bad"] and len(loaded) == len(frames)
    np.testing.assert_array_equal(found, betas)
    for a, b in zip(loaded, frames, strict=True):
        assert (a.number, a.found, a.residual, a.explained) == (b.number, b.found, b.residual, b.explained)
        np.testing.assert_array_equal(a.precision, b.precision)
    sorted(tmp_path.iterdir())[1].write_bytes(b"broken")
    assert len(FrameStore(tmp_path, {"rate": 30}).load()[0]) == AT_ONCE
    assert FrameStore(tmp_path, {"rate": 60}).load() == ([], None) and not list(tmp_path.iterdir())


def test_runs_of_numbers_are_told_as_ranges():
    assert _ranges(np.array([3, 4, 5, 9, 11, 12])) == "3 to 5, 9, 11 to 12"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A model file, frames of two cameras, and landmarks of the first frame."""
    folder, model = tmp_path_factory.mktemp("recording"), worm_with_prior()
    poses, trans = motion(FRAMES)
    model = replace(model, info={**model.info, "landmarks": {f"m{v}": int(v) for v in MARKS}})
    model.save(folder / "model.npz")
    bodies = [model.template.with_vertices(v) for v in model.subject(None).vertices(poses, trans)]
    for i, body in enumerate(bodies):
        for name, side in (("front", [0.2, -1, 0.4]), ("back", [-0.3, 1, 0.3])):
            if i != 5:
                (folder / "frames" / name).mkdir(parents=True, exist_ok=True)
                seen = half_view(body, np.array(side), 700)[0]
                write_points(folder / "frames" / name / f"{i:03d}.ply", PointCloud(seen))
    (folder / "marks.json").write_text(json.dumps({f"m{v}": bodies[0].vertices[v].tolist() for v in MARKS}))
    return folder, bodies


def call(recording, output, *more):
    folder, _ = recording

    def track_quickly(frames: cli.FramesArg, output: cli.Output, model: cli.ModelOrNone, landmarks: cli.Path,
                      subject: str | None = None, surfaces: bool = False) -> cli.Outcome:
        return cli.track_frames(frames, output, model, 25.0, landmarks=landmarks, subject=subject, unit="m",
                                surfaces=surfaces, keys=6, config=replace(SETTINGS, shape_frames=3))

    return run(track_quickly, "scape track", [str(folder / "frames"), "-m", str(folder / "model.npz"), "-o",
                                              str(output), "--landmarks", str(folder / "marks.json"), *more])


@pytest.fixture(scope="module")
def output(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert call(recording, out, "--subject", "template", "--surfaces") == 0
    return out


def test_the_command_writes_all_it_promises(recording, output):
    found = Motion.load(output / "motion.npz")
    model = worm_with_prior()
    assert found.rate == 25 and list(np.flatnonzero(~found.converged)) == [5]
    for vertices, body in zip(found.vertices(model.subject(None)), recording[1], strict=True):
        assert np.linalg.norm(vertices - body.vertices, axis=1).mean() < 0.03
    assert (output / "animation.glb").read_bytes()[:4] == b"glTF"
    assert f"Frames: {FRAMES}" in (output / "motion.bvh").read_text()
    for table in ("joint_angles", "joint_centres", "residuals"):
        assert len((output / f"{table}.csv").read_text().splitlines()) == 1 + FRAMES
    page = (output / "report.html").read_text()
    assert "Lost frames: 5" in page and "image/gif" in page and page.count("<figure") == 3
    told = {m["metric"]: m["value"] for m in json.loads((output / "report.json").read_text())["metrics"]}
    assert told["frames"] == FRAMES and told["frames lost"] == 1 and told["cameras"] == 2
    assert told["model"].endswith("model.npz") and 0.1 < told["distance of the points to the body, mean"] < 4
    surfaces = sorted((output / "surfaces").iterdir())
    assert [p.name for p in surfaces] == [f"{i:06d}.ply" for i in range(FRAMES)]
    assert len(read_mesh(surfaces[0], "m").faces) == len(model.template.faces)


def test_an_interrupted_run_goes_on_to_the_same_end(recording, output, tmp_path, monkeypatch):
    push, calls = Tracker.push, []

    def interrupted(self, frame):
        calls.append(1)
        if len(calls) == 7:
            raise KeyboardInterrupt
        return push(self, frame)

    monkeypatch.setattr(Tracker, "push", interrupted)
    monkeypatch.setattr(cli, "_page", lambda *_: None)
    assert call(recording, tmp_path, "--subject", "template", "--surfaces") == 130
    assert not (tmp_path / "motion.npz").exists()
    assert call(recording, tmp_path, "--subject", "template", "--surfaces") == 0
    assert len(calls) == 7 + FRAMES - 6
    whole, pieced = (Motion.load(folder / "motion.npz") for folder in (output, tmp_path))
    np.testing.assert_allclose(pieced.poses, whole.poses, atol=1e-9)
    np.testing.assert_allclose(pieced.trans, whole.trans, atol=1e-9)
    assert len(list((tmp_path / "surfaces").iterdir())) == FRAMES


def test_the_shape_is_kept_with_the_frames(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "_page", lambda *_: None)
    assert call(recording, tmp_path) == 0
    monkeypatch.setattr(Tracker, "push", lambda *_: pytest.fail("tracked again"))
    first = Motion.load(tmp_path / "motion.npz")
    assert call(recording, tmp_path) == 0
    np.testing.assert_array_equal(Motion.load(tmp_path / "motion.npz").betas, first.betas)
    assert first.betas.shape == (3,) and np.abs(first.betas).max() > 0


def test_what_is_wrong_is_said_in_a_line(recording, tmp_path, capfd):
    folder, _ = recording
    (tmp_path / "marks.json").write_text('{"m6": [0, 0, 0]}')
    assert run(cli.track_frames, "scape track", [str(folder / "frames"), "-m", str(folder / "model.npz"), "-o",
                                                 str(tmp_path), "--landmarks", str(tmp_path / "marks.json")]) == 1
    assert "marks.json" in capfd.readouterr().err
    assert run(cli.track_frames, "scape track", [str(tmp_path / "none"), "-o", str(tmp_path)]) == 1
    assert "no such folder" in capfd.readouterr().err
    with pytest.raises(SystemExit):
        run(cli.track_frames, "scape track", ["--help"])
    assert "Example: scape track frames -m model.npz" in capfd.readouterr().out
