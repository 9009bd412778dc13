import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import worm_with_prior
from recordings import FRAMES, arguments, quick_page, track, write_recording
from scene_reader import scenes_of
from trees import tree

from completion import Motion
from completion.tracking import cli, report
from completion.tracking.folder import FrameFolder
from completion.tracking.sequence import BodyTracker
from model import load_model
from scanprep.command_line import run
from scanprep.geometry.files import PointCloud, read_mesh, read_points, write_points

KNOWN = "--subject", "template", "--surfaces"


def contents(folder):
    """Path -> bytes of all files but the report, which holds times."""
    return tree(folder, "report.json")


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("0 0 0\n1 0 0\n")


@pytest.mark.parametrize("names, numbers, views", [
    (("f9.xyz", "f10.xyz", "f008.xyz", "f12.xyz", "notes.md"), [8, 9, 10, 11, 12], [1, 1, 1, 0, 1]),
    (("f0.xyz", "f5.xyz", "f15.xyz"), [0, 5, 10, 15], [1, 1, 0, 1]),
    (("t100023.xyz", "t100107.xyz", "t100190.xyz"), [100023, 100107, 100190], [1, 1, 1]),
    (("left/1.xyz", "left/2.xyz", "right/2.xyz", "right/3.xyz"), [1, 2, 3], [1, 2, 1])])
def test_frames_are_in_the_order_of_their_numbers_however_they_are_counted(tmp_path, names, numbers, views):
    touch(tmp_path, *names)
    found = FrameFolder(tmp_path)
    assert found.numbers == numbers and [len(frame) for frame in found] == views


def test_a_folder_that_does_not_fit_is_explained(tmp_path):
    touch(tmp_path / "same", "a_1.xyz", "b_1.xyz")
    touch(tmp_path / "none", "readme.md")
    touch(tmp_path / "unnamed", "scan.xyz")
    for folder, message in (("missing", "no such folder"), ("none", "found none"), ("same/a_1.xyz", "found a file"),
                            ("same", r"a_1\.xyz and b_1\.xyz are both frame 1"), ("unnamed", "number of the frame")):
        with pytest.raises(ValueError, match=message):
            FrameFolder(tmp_path / folder)


def test_a_bad_file_is_a_camera_that_saw_nothing_and_is_named_once(tmp_path):
    touch(tmp_path, "1.xyz", "3.xyz")
    (tmp_path / "2.ply").write_text("ply\nhalf a header")
    (tmp_path / "4.xyz").write_text("")
    found = FrameFolder(tmp_path)
    assert [len(views) for views in found] == [1, 0, 1, 0] and not found[1]
    assert len(found.problems) == 1 and "2.ply" in found.problems[0]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Where a recording is, and its bodies."""
    folder = tmp_path_factory.mktemp("recording")
    return folder, write_recording(folder)


def call(recording, output, *more):
    return track(*arguments(recording[0], output, *more))


@pytest.fixture(scope="module")
def output(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert call(recording, out, *KNOWN) == 0
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
    assert "Lost frames: 5" in page and page.count("<figure") == 2
    scene, = scenes_of(page)
    lost = np.isfinite(scene.frames(scene.layer("lost frames"))).all(axis=(1, 2))
    assert list(np.flatnonzero(lost)) == [5] and "measured points" in [layer["name"] for layer in scene.layers]
    told = {m["metric"]: m["value"] for m in json.loads((output / "report.json").read_text())["metrics"]}
    assert told["frames"] == FRAMES and told["frames lost"] == 1 and told["cameras"] == 2
    assert told["model"].endswith("model.npz") and 0.1 < told["distance of the points to the body, mean"] < 4
    surfaces = sorted((output / "surfaces").iterdir())
    assert [p.name for p in surfaces] == [f"{i:06d}.ply" for i in range(FRAMES)]
    assert len(read_mesh(surfaces[0], "m").faces) == len(model.template.faces)


@pytest.fixture
def again(recording, output, tmp_path, monkeypatch):
    """The recording and what came of it, to be changed; how often a frame is followed."""
    folder, out, numbers, push = tmp_path / "recording", tmp_path / "out", [], BodyTracker.push
    shutil.copytree(recording[0], folder)
    shutil.copytree(output, out)
    monkeypatch.setattr(report, "track_page", quick_page)

    def counted(self, frame):
        numbers.append(self.state.number)
        return push(self, frame)

    monkeypatch.setattr(BodyTracker, "push", counted)
    assert track(*arguments(folder, out, *KNOWN)) == 0 and not numbers          # the page names where the model is
    return folder, out, numbers


def changed(before, after):
    return {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}


@pytest.mark.parametrize("given, files", [
    ((), set()),
    (("--smoothing", 0), {"motion.npz", "motion.bvh", "motion.trc", "joint_angles.csv", "joint_centres.csv",
                          "animation.glb", "report.html"})])
def test_what_is_made_of_frames_does_not_follow_them_again(again, given, files):
    folder, out, numbers = again
    before = contents(out)
    assert track(*arguments(folder, out, *KNOWN, *given)) == 0
    assert not numbers and changed(before, contents(out)) == files


@pytest.mark.slow
def test_a_changed_frame_is_followed_anew_with_those_after_it(again):
    folder, out, numbers = again
    before, path = contents(out), folder / "frames" / "front" / "007.ply"
    cloud = read_points(path, "m")
    write_points(path, PointCloud(cloud.points + [0.01, 0, 0]))
    assert track(*arguments(folder, out, *KNOWN)) == 0
    assert numbers == [5, 6, 7, 8]
    assert {n for n in changed(before, contents(out)) if n[:8] == "surfaces"} == {
        "surfaces/000007.ply", "surfaces/000008.ply"}
    assert track(*arguments(folder, out.with_name("anew"), *KNOWN)) == 0
    assert contents(out) == contents(out.with_name("anew"))


def test_a_shorter_recording_leaves_nothing_behind(again):
    folder, out, numbers = again
    for path in (folder / "frames").glob("*/00[4-8].ply"):
        path.unlink()
    assert track(*arguments(folder, out, *KNOWN)) == 0
    assert numbers == [0, 1, 2, 3] and len(list((out / "surfaces").iterdir())) == 4


@pytest.mark.parametrize("what", ["model", "shifted", "landmarks", "rate", "subject", "force"])
def test_all_is_followed_anew_when_it_depends_on_what_changed(again, monkeypatch, what):
    folder, out, _ = again
    given = {"rate": ["--rate", 26], "force": ["--force"]}.get(what, [])
    if what == "model":
        model = load_model(folder / "model.npz")            # of the same training set
        replace(model, pose_mean=1.01 * model.pose_mean).save(folder / "model.npz")
    elif what == "shifted":
        for path in (folder / "frames").glob("*/000.ply"):
            path.unlink()
    elif what == "landmarks":
        marks = json.loads((folder / "marks.json").read_text())
        (folder / "marks.json").write_text(json.dumps({n: [x + 0.01, y, z] for n, (x, y, z) in marks.items()}))

    def interrupted(self, frame):
        assert self.state.number == 0
        raise KeyboardInterrupt

    monkeypatch.setattr(BodyTracker, "push", interrupted)
    assert track(*arguments(folder, out, *(KNOWN if what != "subject" else KNOWN[2:]), *given)) == 130


def test_a_file_that_cannot_be_read_is_told_again(again, capfd):
    folder, out, numbers = again
    (folder / "frames" / "back" / "006.ply").write_text("ply\nhalf a header")
    for followed in ([5, 6, 7, 8], []):
        del numbers[:]
        assert track(*arguments(folder, out, *KNOWN)) == 1
        assert numbers == followed and capfd.readouterr().err.count(f"failed: {folder}/frames/back/006.ply: ") == 1


@pytest.mark.slow
def test_landmarks_that_nobody_shares_are_told_and_left_out(recording, tmp_path, capfd):
    folder, _ = recording
    (tmp_path / "marks.json").write_text('{"m6": [0, 0, 0]}')
    given = ["-m", str(folder / "model.npz"), "-o", str(tmp_path / "out")]
    assert run(cli.track_frames, "scape track", [str(folder / "frames"), *given, "--landmarks",
                                                 str(tmp_path / "marks.json")]) == 0
    assert "going on without landmarks" in capfd.readouterr().err
