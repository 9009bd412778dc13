"""The demonstration: figures against the ground truth, a page that stands alone, and nothing done twice."""
import json
import re
import shutil

import numpy as np
import pytest

from completion import Motion
from completion.demo.cli import demo
from model import load_model
from scanprep import RegisteredSet
from scanprep.console import run
from scanprep.geometry.mesh import template_problem

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def figures(demo_folder):
    return {m["metric"]: m["value"] for m in json.loads((demo_folder / "report.json").read_text())["metrics"]}


def figure(figures, start):
    found = [value for name, value in figures.items() if name.startswith(start)]
    assert len(found) == 1, (start, list(figures))
    return found[0]


def test_registration_is_near_the_truth(figures):
    assert figure(figures, "registration: distance to the true surface") < 1.5
    assert figure(figures, "registration: worst scan") < 2.0
    assert figure(figures, "registration: distance of corresponding points") < 10.0


def test_skeleton_is_that_of_the_body(figures):
    # eight poses do not move every joint: hands and head may stay with their neighbours
    assert figure(figures, "skeleton: parts") == 16
    assert figure(figures, "skeleton: adjusted Rand index") > 0.5


def test_model_and_completion_and_animation(figures):
    assert figure(figures, "model: 2 held-out poses") < 12.0
    assert figure(figures, "completion: seen, ") < 4.0
    assert figure(figures, "completion: unseen, ") < 25.0
    assert figure(figures, "animation: distance of corresponding points") < 15.0


def test_outputs_are_whole(demo_folder):
    whole = RegisteredSet.load(demo_folder / "set")
    assert template_problem(whole.template) is None and whole.template.is_closed
    assert len(whole.entries) == 11 and len(whole.subjects) == 4
    model = load_model(demo_folder / "model.npz")
    assert model.n_betas == 3 and model.info["landmarks"]          # of four bodies
    motion = Motion.load(demo_folder / "animation" / "motion.npz")
    assert len(motion.poses) == 66 and np.isfinite(motion.poses).all()


def test_page_stands_alone(demo_folder):
    page = (demo_folder / "report.html").read_text(encoding="utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page)
    assert page.count("<img") >= 12 and 'download="walk.glb"' in page
    for stage in ("Scans", "Template", "Registration", "Skeleton", "Body shape", "Completion", "Animation"):
        assert re.search(rf"<h2[^>]*>{stage}</h2>", page)
    assert (demo_folder / "animation" / "walk.glb").read_bytes()[:4] == b"glTF"


def test_goes_on_where_it_was(demo_folder, tmp_path, figures):
    """Without the model and the page, a second run makes these again, the same, and touches nothing before them."""
    folder = tmp_path / "again"
    shutil.copytree(demo_folder, folder)
    (folder / "model.npz").unlink()
    (folder / "report.html").unlink()
    before = {p: p.stat().st_mtime_ns for p in (folder / "set").rglob("*.ply")}
    scans = {p: p.stat().st_mtime_ns for p in (folder / "scans").rglob("*") if p.name != "scans.csv"}
    assert run(demo, "scape demo", ["--quick", "--out", str(folder)]) == 0
    assert before == {p: p.stat().st_mtime_ns for p in (folder / "set").rglob("*.ply")}
    assert scans == {p: p.stat().st_mtime_ns for p in (folder / "scans").rglob("*") if p.name != "scans.csv"}
    again = {m["metric"]: m["value"] for m in json.loads((folder / "report.json").read_text())["metrics"]}
    same = [name for name in figures if name != "time"]
    assert {name: again[name] for name in same} == {name: figures[name] for name in same}


def test_other_settings_in_the_same_folder(demo_folder, capsys):
    assert run(demo, "scape demo", ["--out", str(demo_folder)]) == 1
    assert "other settings" in capsys.readouterr().err
