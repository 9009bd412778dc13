"""`scape animate`: markers in, a folder with motions, tables and a page out."""
import json

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior
from config_files import config_file
from glb_reader import Glb
from quiet_pictures import small_pictures  # noqa: F401 -- fixture

from completion.__main__ import main
from completion.mocap.files import motion_files
from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.motion import Motion
from scanprep.geometry.format_glb import turn_up
from scanprep.pictures.camera import guess_upright

FRAMES = 30
BETAS = np.array([0.9, -0.6, 0.4])
WRITTEN = {"motion.npz", "animation.glb", "motion.bvh", "motion.trc",
           "joint_angles.csv", "joint_centres.csv", "residuals.csv",
           "report.html"}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A model, a layout, and markers on a body of unknown shape: one file, and a folder of two."""
    place = tmp_path_factory.mktemp("animate")
    model = worm_with_prior()
    model.save(place / "model.npz")
    config_file(place, person={"frames": 4})
    vertices = np.random.default_rng(4).choice(396, 30, replace=False)
    layout = MarkerLayout(tuple(f"M{i}" for i in range(30)), vertices, 0.012)
    layout.save(place / "layout.json")
    t = np.arange(FRAMES) / 60
    poses = MEAN + np.sin(3 * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    trans = np.stack([t, 0 * t, 0 * t], axis=1)
    meshes = model.subject(BETAS).vertices(poses, trans)
    positions = np.stack([layout.place(model.template.with_vertices(v)) for v in meshes])
    positions[5:9, 3] = np.nan
    (place / "many").mkdir()
    for name in ("walk.csv", "many/one.csv", "many/two.c3d"):
        write_markers(place / name, MarkerSequence(positions, layout.labels, 60.0))
    np.savez(place / "truth.npz", meshes=meshes)
    return place


def run(place, *words):
    return main(["animate", *map(str, words), "-m", str(place / "model.npz"), "--layout", str(place / "layout.json"),
                 "--config", str(place / "config.toml"), "--workers", "1"])


def told(folder):
    return {row["metric"]: row["value"] for row in json.loads((folder / "report.json").read_text())["metrics"]}


def test_a_person_and_the_motion_from_markers(place, tmp_path):
    (tmp_path / "to.json").write_text(json.dumps({"0": [0, 0, 0], "0.4": [2.0, 0, 0]}))
    (tmp_path / "onto.json").write_text("[-1, 1, 0.5]")
    out = tmp_path / "out"
    assert run(place, place / "walk.csv", "-o", out, "--retarget-to", tmp_path / "onto.json", "--betas-to",
               tmp_path / "to.json") == 0
    assert {p.name for p in out.iterdir()} >= WRITTEN | {"subject.json", "layout.json", "onto.npz", "onto.glb",
                                                         "morph.glb", "report.json"}
    motion = Motion.load(out / "motion.npz")
    assert (len(motion.poses), motion.rate) == (FRAMES, 60)
    np.testing.assert_allclose(json.loads((out / "subject.json").read_text())["betas"], motion.betas)
    model = worm_with_prior()
    off = np.linalg.norm(motion.vertices(model.subject(motion.betas)) - np.load(place / "truth.npz")["meshes"], axis=2)
    assert off.mean() < 0.01
    np.testing.assert_array_equal(Motion.load(out / "onto.npz").betas, [-1, 1, 0.5])
    figures = told(out)
    assert figures["markers used"] == "30 of 30" and figures["layout"].endswith("layout.json")
    assert figures["distance of markers, mean"] < 5 and figures["markers missing"] == pytest.approx(100 * 4 / 900)
    page = (out / "report.html").read_text()
    assert "On another person" in page and "With a body that changes" in page and ">M29<" in page


@pytest.mark.parametrize("changing", [False, True])
def test_a_long_motion_is_shown_at_its_own_times(tmp_path, changing, monkeypatch):
    """Of 53 frames the bodies of 20 are asked for: 2.7 frames apart, which even times would shift by half of one."""
    monkeypatch.setattr(motion_files, "KEYS", 20)
    t = np.linspace(0, 3, 53)[:, None, None]
    poses = 0.4 * np.sin(t * np.array([2.0, 3, 1]) + np.arange(4)[:, None])
    motion = Motion(poses, np.c_[t[:, 0, 0], 0 * t[:, 0], 0 * t[:, 0]], None, 24.0, np.zeros((53, 0)))
    body = worm_with_prior().subject(None)
    place = motion.trans[:, None]
    exact = place + (motion.vertices(body) - place) * (1 + 0.2 * np.sin(t) * changing)
    motion_files.write_glb(tmp_path / "a.glb", motion, body, exact.__getitem__ if changing else None)
    glb = Glb((tmp_path / "a.glb").read_bytes())
    samplers = glb.json["animations"][0]["samplers"]
    frames = np.round(24 * glb.array(samplers[-1]["input"])[:, 0]).astype(int)
    assert len(frames) == (20 if changing else 53)
    assert np.allclose(24 * glb.array(samplers[-1]["input"])[:, 0], frames, atol=1e-4)
    weights = glb.array(samplers[-1]["output"]).reshape(len(frames), -1)
    assert weights.min() >= 0 and weights.max() <= 1
    places = np.stack([glb.skinned(t) for t in range(53)])
    off = np.linalg.norm(places @ turn_up(guess_upright(body.template)[0]) - exact, axis=2)
    assert off[frames].mean() < 1e-3 and off.mean() < 2e-3
    assert not (tmp_path / "out" / "subject.json").exists()


def test_a_known_subject_is_taken_as_it_is(place, tmp_path):
    (tmp_path / "betas.json").write_text(json.dumps({"betas": BETAS.tolist()}))
    assert run(place, place / "walk.csv", "-o", tmp_path / "out", "--subject", tmp_path / "betas.json") == 0
    np.testing.assert_array_equal(Motion.load(tmp_path / "out" / "motion.npz").betas, BETAS)
    assert told(tmp_path / "out")["distance of markers, mean"] < 3


def test_a_folder_goes_on_where_it_was(place, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(place, place / "many", "-o", out, "--subject", "template") == 0
    assert WRITTEN <= {p.name for p in (out / "one").iterdir()} and WRITTEN <= {p.name for p in (out / "two").iterdir()}
    assert told(out)["done before"] == 0
    when = (out / "one" / "motion.npz").stat().st_mtime_ns
    write_markers(place / "many" / "two.c3d", MarkerSequence(np.random.default_rng(0).random((5, 3, 3)),
                                                             ("A", "B", "C"), 60.0))
    assert run(place, place / "many", "-o", out, "--subject", "template") == 1
    assert (out / "one" / "motion.npz").stat().st_mtime_ns == when
    assert told(out) | {"done before": 1, "failed": 1, "files": 2} == told(out)
    assert "two.c3d: labels: expected at least 3 markers of the layout, found 0" in capsys.readouterr().err


@pytest.mark.parametrize("words, message", [
    (("--betas-to", "bad.json"), "expected betas at the end"),
    (("--layout", "cmu40"), "layout: expected a file or one of biomech57, cmu41"),
    (("--layout", "cmu41"), "template: expected a body on which 'cmu41' is known"),
])
def test_wrong_words_are_one_line(place, tmp_path, capsys, words, message):
    (tmp_path / "bad.json").write_text('{"0": "fat"}')
    words = [str(tmp_path / w) if w.endswith(".json") else w for w in words]
    code = main(["animate", str(place / "walk.csv"), "-o", str(tmp_path / "out"), "-m", str(place / "model.npz"),
                 *(() if "--layout" in words else ("--layout", str(place / "layout.json"))), *words])
    assert code == 1 and message in capsys.readouterr().err


def test_an_empty_folder_is_refused(place, tmp_path, capsys):
    (tmp_path / "._walk.c3d").write_bytes(b"what a Mac leaves beside a file on a foreign disk")
    assert run(place, tmp_path, "-o", tmp_path / "out") == 1
    wanted = "expected files ending in .c3d, .trc, .csv, .tsv, or motions (.bvh, .npz), found none"
    assert wanted in capsys.readouterr().err
