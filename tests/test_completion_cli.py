"""`scape complete`: files in, a folder with meshes, figures and a page out."""
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior
from config_files import config_file
from scene_reader import scenes_of

from completion.__main__ import main
from completion.partial import report
from completion.partial.completion import load_completion
from scanprep.geometry.files import PointCloud, read_mesh, write_mesh, write_points
from scanprep.geometry.landmarks import write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pictures import textures
from scanprep.pictures.textures import read_texture

POSE = np.array([[0.3, -0.5, 0.8], [0.2, 0.5, -0.4], [-0.1, -0.6, 0.3], [0.3, 0.1, 0.5]])
TRANS = np.array([0.4, -0.3, 1.1])
MARKS = {f"m{v}": v for v in (6, 75, 130, 200, 255, 330, 396)}
QUICK = {"random_starts": 3, "rounds": 3, "scan_points": 300, "model_points": 150}


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    """Nobody looks at them here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "HEIGHT", 60)
        patch.setattr(textures.bake_body_texture, "__defaults__", (256,))
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A model, two coloured views of a body as meshes, one as points, landmarks, a mask."""
    place = tmp_path_factory.mktemp("complete")
    model = worm_with_prior()
    model = replace(model, info={**model.info, "landmarks": MARKS})
    model.save(place / "model.npz")
    body = model.template.with_vertices(model.vertices(POSE, None, TRANS))
    points = {name: body.vertices[v] for name, v in MARKS.items()}
    for name, toward in (("one", [0.3, -1, 0.5]), ("two", [-0.9, 0.6, 0.1])):
        bare, seen = half_view(body, np.array(toward), count=1500, noise=0.001)
        view = body.submesh(seen[body.faces].all(axis=1))[0]
        write_mesh(place / f"{name}.ply", Mesh(view.vertices, view.faces, np.full(view.vertices.shape, 0.2)))
        write_points(place / f"{name}.xyz", PointCloud(bare))
    write_landmarks(place / "one.landmarks.json", points)
    (place / "mask.json").write_text(json.dumps(list(range(10))))
    return place


def run(*words):
    return main(["complete", *map(str, words)])


def quick(place, **more):
    """A short schedule, as a user would write it."""
    return "--config", config_file(place, **{**QUICK, **more})


def told(folder):
    written = json.loads((folder / "report.json").read_text())
    return {row["metric"]: row["value"] for row in written["metrics"]}, written


def test_two_coloured_views_make_one_body_and_a_page(place, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(place / "one.ply", place / "two.ply", "-m", place / "model.npz", "--subject", "template", "-o", out,
               "--mask", place / "mask.json", *quick(place)) == 0
    metrics, written = told(out)
    assert metrics["views"] == 2 and metrics["landmarks used"] == 7
    assert metrics["share of the body that was measured"] > 70
    assert metrics["scan points masked"] > 0 and str(place / "model.npz") in metrics["model"]
    assert written["settings"]["complete"]["random_starts"] == 3
    done = load_completion(out)
    assert done.betas is None and done.rms * 1000 == pytest.approx(
        metrics["what the scan leaves beside the body that was bent onto it, RMS"])
    colors = read_mesh(out / "completed.ply").colors
    np.testing.assert_allclose(colors[done.seen & (colors != 0.6).any(axis=1)], 0.2, atol=0.01)
    assert ((colors[:, 0] - 0.2)**2 < 1e-3).mean() > 0.5
    page = (out / "report.html").read_text()
    for wanted in ("What the colours say", "Distance of the scan", "clothing or hair",
                   "share of the scan that lies on the body"):
        assert wanted in page
    scene, = scenes_of(page)
    body = scene.layer("completed body")
    assert [shade["name"] for shade in body["shades"]] == [
        "", "colours of the scan", "distance of the scan to the completed body",
        "distance of the scan to the predicted body", "expected error"]
    np.testing.assert_allclose(scene.positions(body), done.completed.vertices, atol=1e-4)
    assert len(scene.layer("landmarks")["labels"]) == 7 and set(scene.layer("landmarks")["labels"]) == set(MARKS)
    assert not scene.layer("predicted body")["visible"] and not scene.layer("scan over it")["visible"]
    assert page.count("<img") == 1 and [p.name for p in out.glob(".*")] == [".scapekit"]
    assert "share of the scan" in capsys.readouterr().out


def test_without_landmarks_it_says_so_and_goes_on(place, tmp_path, capsys):
    assert run(place / "two.xyz", "-m", place / "model.npz", "--subject", "template", "-o", tmp_path / "out",
               *quick(place)) == 0
    assert told(tmp_path / "out")[0]["landmarks used"] == "none"
    assert "no landmarks" in capsys.readouterr().err


def test_the_unit_of_the_scan_may_be_unknown(place, tmp_path, capsys):
    view = read_mesh(place / "one.ply")
    write_mesh(tmp_path / "large.ply", view.with_vertices(view.vertices / 0.0254))
    marks = json.loads((place / "one.landmarks.json").read_text())
    write_landmarks(tmp_path / "large.landmarks.json", {n: np.array(p) / 0.0254 for n, p in marks.items()})
    assert run(tmp_path / "large.ply", "-m", place / "model.npz", "--subject", "template", "-o", tmp_path / "out",
               "--unit", "unknown", *quick(place)) == 0
    assert told(tmp_path / "out")[0]["unit of the scan"] == pytest.approx(0.0254, rel=0.05)
    assert "looks like unit" not in capsys.readouterr().err
    assert load_completion(tmp_path / "out").scale == pytest.approx(0.0254, rel=0.05)


def test_a_textured_scan_gives_a_textured_body(place, tmp_path):
    pytest.importorskip("xatlas")
    from PIL import Image

    view = read_mesh(place / "one.ply")
    low, extent = view.vertices.min(axis=0), np.ptp(view.vertices, axis=0)
    uv = ((view.vertices - low) / extent)[:, [0, 2]]
    ramp = np.broadcast_to((np.arange(256) / 255)[::-1, None], (256, 256))        # grows with v, from the bottom row
    Image.fromarray((255 * np.stack([ramp, 0 * ramp, 1 - ramp], axis=-1)).astype(np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd a.png\n")
    lines = [f"v {x} {y} {z}" for x, y, z in view.vertices] + [f"vt {u} {v}" for u, v in uv]
    faces = [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in view.faces + 1]
    (tmp_path / "one.obj").write_text("\n".join(["mtllib a.mtl", *lines, "usemtl skin", *faces]) + "\n")
    shutil.copy(place / "one.landmarks.json", tmp_path)
    assert run(tmp_path / "one.obj", "-m", place / "model.npz", "--subject", "template", "-o", tmp_path / "out",
               *quick(place)) == 0
    done = load_completion(tmp_path / "out")
    wanted = np.clip((done.completed.vertices[:, 2] - low[2]) / extent[2], 0, 1)
    colored = done.seen & (np.abs(done.completed.colors - 0.6) > 0.02).any(axis=1)
    off = np.abs(done.completed.colors[:, 0] - wanted)[colored]
    assert colored.sum() > 50 and np.quantile(off, 0.95) < 0.03
    texture = read_texture(tmp_path / "out" / "completed.glb")
    points, face, bary = texture.mesh.sample(3000, np.random.default_rng(0))
    found = texture.sample(face, bary)
    shown = np.abs(found[:, 1]) < 0.05                               # not the grey of what was not seen
    height = np.clip((points[:, 2] - low[2]) / extent[2], 0, 1)
    assert shown.mean() > 0.2 and np.quantile(np.abs(found[:, 0] - height)[shown], 0.95) < 0.04


@pytest.fixture(scope="module")
def folder(place, tmp_path_factory):
    """Three scans of a folder, of which one is damaged, completed once."""
    scans, out = tmp_path_factory.mktemp("scans"), tmp_path_factory.mktemp("done") / "out"
    for name in ("a", "b"):
        shutil.copy(place / "one.ply", scans / f"{name}.ply")
        shutil.copy(place / "one.landmarks.json", scans / f"{name}.landmarks.json")
    (scans / "c.ply").write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    code = run(scans, "-m", place / "model.npz", "--subject", "template", "-o", out, *quick(place))
    return scans, out, code


def words(place, folder, **more):
    return (folder[0], "-m", place / "model.npz", "--subject", "template", "-o", folder[1], *quick(place, **more))


def test_a_folder_is_completed_scan_by_scan(folder):
    _, out, code = folder
    assert code == 1                                                 # one scan failed
    metrics, written = told(out)
    assert metrics["scans completed"] == "2 of 3" and metrics["of them in this run"] == 2
    assert len(written["failures"]) == 1 and "c.ply" in written["failures"][0]
    for name in ("a", "b"):
        assert load_completion(out / name).seen.any() and (out / name / "report.html").is_file()
    page = (out / "report.html").read_text()
    assert 'href="a/report.html"' in page and len(scenes_of(page)) == 2 and "c.ply" in page
    assert sorted(p.name for p in out.iterdir() if p.name != ".scapekit") == ["a", "b", "report.html", "report.json"]


def test_what_is_finished_is_skipped_and_what_changed_is_done_anew(place, folder, capsys):
    scans, out, _ = folder
    (out / ".scapekit" / "making" / "left").mkdir(parents=True)     # by a run that was killed
    before = {name: (out / name / "completed.ply").stat().st_mtime_ns for name in ("a", "b")}

    def fresh(**more):
        run(*words(place, folder, **more))
        return told(out)[0]["of them in this run"]

    assert fresh() == 0
    assert before == {name: (out / name / "completed.ply").stat().st_mtime_ns for name in ("a", "b")}
    assert not (out / ".scapekit" / "making").exists() and [p.name for p in out.glob(".*")] == [".scapekit"]
    marks = json.loads((scans / "b.landmarks.json").read_text())
    write_landmarks(scans / "b.landmarks.json", {n: np.array(p) + 0.001 for n, p in marks.items()})
    assert fresh() == 1 and fresh() == 0                             # a changed input
    assert fresh(surface_weight=2.0) == 2                       # a changed setting


@pytest.mark.parametrize("words, message", [
    (("none.ply",), "none.ply: no such file"),
    (("one.ply", "--landmarks", "none.json"), "none.json: no such file"),
    (("one.ply", "--mask", "none.json"), "none.json: no such file"),
    (("one.ply", "--mask", "long.json"), "long.json: element 0: expected a point of 0.."),
    (("one.ply", "--config", "wing.toml"), "ignored_parts: expected names of"),
    (("one.ply", "two.ply", "--mask", *["mask.json"] * 3), "expected one file, or one for each of the 2 views, got 3"),
    (("one.ply", "--subject", "none.json"), "none.json: no such file"),
])
def test_what_cannot_be_used_is_named(place, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(place)
    (place / "long.json").write_text("[99999]")
    config_file(place, "wing.toml", ignored_parts=["wing"])
    settings = () if "--config" in words else quick(place)
    assert run(*words, "-m", "model.npz", "-o", tmp_path / "out", *settings) == 1
    assert message in " ".join(capsys.readouterr().err.split())
