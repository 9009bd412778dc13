"""`scape layout design` on a folder of meshes."""
import csv
import json
from itertools import pairwise

import numpy as np
import pytest
from completion_bodies import worm_with_prior

from completion.__main__ import main
from completion.mocap.marker_selection.linear import example_poses, in_poses
from completion.mocap.marker_sets.layout import MarkerLayout
from model.fitting.vertices import spread_vertices
from scanprep.geometry.files import write_mesh

MODEL = worm_with_prior()
LABELS = ("LA", "RA", "LB", "RB", "LC", "RC", "C1", "C2", "C3", "C4")
RNG = np.random.default_rng(0)
POSES = MODEL.pose_mean + RNG.normal(0, 0.3, (4, 4, 3))
BODIES = MODEL.vertices(POSES, RNG.normal(0, 1, (4, 3)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("design")
    MODEL.save(place / "model.npz")
    (place / "bodies").mkdir()
    for i, body in enumerate(BODIES):
        write_mesh(place / "bodies" / f"b{i}.ply", MODEL.template.with_vertices(body))
    layout = MarkerLayout(LABELS, spread_vertices(MODEL.template.vertices, len(LABELS)), 0.01, loose=("LC", "RC"))
    layout.save(place / "candidates.json")
    MarkerLayout(("C1", "NEW"), [layout.vertices[6], 17], 0.01, aliases={"OLD": "NEW"}).save(place / "keep.json")
    return place


def run(folder, *more):
    given = {"--bodies": "bodies", "-m": "model.npz", "--candidates": "candidates.json", "-o": "out"}
    return main(["layout", "design", *(x for key, name in given.items() for x in (key, str(folder / name))), *more])


def test_a_layout_a_curve_and_a_page_are_written(folder, capsys):
    assert run(folder, "--keep", str(folder / "keep.json"), "--count", "6") == 0
    layout = MarkerLayout.load(folder / "out" / "layout.json", len(MODEL.template.vertices))
    assert len(layout.labels) == 6 and {"C1", "NEW"} <= set(layout.labels) and layout.aliases == {"OLD": "NEW"}
    assert {x[1] for x in layout.labels if x[0] == "L"} == {x[1] for x in layout.labels if x[0] == "R"}
    assert set(layout.loose) == {"LC", "RC"} & set(layout.labels)
    rows = list(csv.DictReader((folder / "out" / "curve.csv").open()))
    assert {row["curve"] for row in rows} == {"removed", "added"}
    added = [row for row in rows if row["curve"] == "added"]
    assert [int(row["markers"]) for row in added][-1] == 11 and added[0]["labels"] == ""
    for before, row in pairwise(added):
        assert int(row["markers"]) - int(before["markers"]) == len(row["labels"].split())
    report = json.loads((folder / "out" / "report.json").read_text())
    figures = {name: value for name, value, *_ in (tuple(m.values()) for m in report["metrics"])}
    assert figures["markers"] == 6 and figures["RMSE of all vertices"] >= figures["with the whole surface seen"]
    page = (folder / "out" / "report.html").read_text()
    assert "6 markers" in page and "svg" in page and "NEW" in page
    assert "RMSE of all vertices" in capsys.readouterr().out


@pytest.mark.parametrize(("more", "message"), [
    (("--count", "12"), "count: expected 3..10 markers"),
    (("--config", "many.toml", "--count", "5"), "count: expected 1.."),
    (("--candidates", "nosuch"), "expected a file or one of")])
def test_wrong_input_is_one_line(folder, capsys, monkeypatch, more, message):
    monkeypatch.chdir(folder)
    (folder / "many.toml").write_text("poses = 999\n")
    assert run(folder, *more) == 1
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


def test_bodies_are_put_into_different_poses():
    poses = example_poses(MODEL, min(3, len(MODEL.pose_examples))) if len(MODEL.pose_examples) else POSES[:3]
    out = in_poses(MODEL, BODIES[:2], poses)
    assert out.shape == (2, len(poses), *MODEL.template.vertices.shape)
    assert np.abs(out - in_poses(MODEL, BODIES[:2], poses[::-1])[:, ::-1]).max() < 1e-6
    own = in_poses(MODEL, BODIES[:1], POSES[:1])[0, 0]
    assert np.linalg.norm(own - own.mean(axis=0) - (BODIES[0] - BODIES[0].mean(axis=0)), axis=1).mean() < 0.003
