"""The demonstration: figures against the ground truth, a page that stands alone, and nothing done twice.

Figures are those of `scape demo --quick`; all else is tested on a demonstration that is as small as it can be.
"""
import json
import re
import shutil
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from quiet_pictures import coarse_pictures
from scene_reader import scenes_of

from completion import Motion
from completion.demo import chain, cli
from completion.demo.chain import QUICK
from completion.viewing.files import Files
from model import load_model
from scanprep import RegisteredSet
from scanprep.command_line import run
from scanprep.geometry.mesh import template_problem
from scanprep.pipeline.mend import MendApp
from scanprep.pipeline.prepare import PrepareConfig, prepare
from scanprep.pipeline.scan import ScanSettings
from scanprep.registration import person
from scanprep.registration.schedule import RegistrationConfig
from scanprep.skeleton.find import SkeletonConfig

pytestmark = pytest.mark.timeout(600)
# a demonstration of four scans, few triangles, few nodes and rounds, whose errors nobody measures
SMALL = replace(QUICK, poses=3, subjects=1, faces=2000, resolution=0.02, template_resolution=0.015, held_out=1)
FEW_STEPS = PrepareConfig(
    ScanSettings(RegistrationConfig(tuple(replace(stage, nodes=min(stage.nodes, 100), rounds=2, ends=0)
                                          for stage in RegistrationConfig().graph)), through="none"),
    SkeletonConfig(restarts=1), min_poses=3)


@contextmanager
def small():
    """`scape demo --quick` is the small one; its template is not sought for the parts of a person."""
    def few_steps(tasks, template, landmarks, folder, _, *rest):
        return prepare(tasks, template, landmarks, folder, FEW_STEPS, *rest)

    with coarse_pictures(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "QUICK", SMALL)
        patch.setattr(chain, "prepare", few_steps)
        patch.setattr(person, "_person_on", lambda *given: None)
        yield


@pytest.fixture(scope="module")
def small_demo(tmp_path_factory):
    """The folder of the small demonstration; nothing is written in it."""
    folder = tmp_path_factory.mktemp("small") / "scape_demo"
    with small():
        assert run(cli.demo, "scape demo", ["--quick", "--output", str(folder)]) == 0
    return folder


def metrics(folder):
    return {m["metric"]: m["value"] for m in json.loads((folder / "report.json").read_text())["metrics"]}


@pytest.fixture(scope="module")
def figures(demo_folder):
    return metrics(demo_folder)


def figure(figures, start):
    found = [value for name, value in figures.items() if name.startswith(start)]
    assert len(found) == 1, (start, list(figures))
    return found[0]


@pytest.mark.slow
def test_registration_is_near_the_truth(figures):
    assert figure(figures, "registration: 11 scans, mean distance to the true surface") < 1.5
    assert figure(figures, "registration: the same, worst scan") < 2.0
    assert figure(figures, "points registered beside their true place") < 10.0


@pytest.mark.slow
def test_one_number_for_one_thing(figures, demo_folder):
    """The worst scan is as far from the truth on the page as in the report; the verdict stands before all figures."""
    page = (demo_folder / "report.html").read_text(encoding="utf-8")
    worst = figure(figures, "registration: the same, worst scan")
    assert f">{worst:.3g}</td>" in page and f"{worst:.2f} mm from the truth" in "".join(
        pane["label"] for scene in scenes_of(page) for pane in scene.header["panes"])
    assert 0 < page.index('<p class="verdict good">') < page.index("<table>")


@pytest.mark.slow
def test_model_and_completion_and_animation(figures):
    assert figure(figures, "model: 2 poses it never saw") < 12.0
    assert figure(figures, "completion, seen: ") < 3.0
    assert figure(figures, "completion, hidden: ") < 25.0
    assert figure(figures, "animation: mean error") < 15.0


@pytest.mark.slow
def test_outputs_are_whole(demo_folder):
    whole = RegisteredSet.load(demo_folder / "set")
    assert template_problem(whole.template) is None and whole.template.is_closed
    assert len(whole.entries) == 11 and len(whole.subjects) == 4
    model = load_model(demo_folder / "model.npz")
    assert model.n_betas == 3 and model.info["landmarks"]          # of four bodies
    assert set(model.skeleton.names) >= {"pelvis", "head", "hand_left", "hand_right", "foot_left", "foot_right"}
    motion = Motion.load(demo_folder / "animation" / "motion.npz")
    assert len(motion.poses) == 66 and np.isfinite(motion.poses).all()


def test_its_motion_opens_and_its_set_can_be_mended(small_demo, tmp_path):
    """By themselves, as those of `scape animate` and `scape prep run`; nothing has to be registered again."""
    folder = shutil.copytree(small_demo, tmp_path / "demo")             # the app writes beside the set
    entry, = Files((folder / "animation",)).entries()
    assert entry.load().shapes
    app = MendApp(folder / "set")
    assert len(app.scans) == 4 and not app.changed


def test_page_stands_alone(small_demo):
    page = (small_demo / "report.html").read_text(encoding="utf-8")
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page)
    scenes = scenes_of(page)
    assert len(scenes) == 8 and len(page) < 4_000_000 and "animation/walk.glb" in page
    assert scenes[-1].layer("body")["motion"]["frames"] == 66
    for stage in ("Scans", "Template", "Registration", "Skeleton", "Body shape", "Completion", "Animation"):
        assert re.search(rf"<h2[^>]*>{stage}</h2>", page)
    assert (small_demo / "animation" / "walk.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.slow
def test_goes_on_where_it_was(small_demo, tmp_path):
    """Without the model and the page, a second run makes these again, the same, and touches nothing before them."""
    folder = tmp_path / "again"
    shutil.copytree(small_demo, folder)
    (folder / "model.npz").unlink()
    (folder / "report.html").unlink()

    def touched():
        kept = [p for part in ("set/meshes", "scans", "half_view") for p in (folder / part).rglob("*")]
        return {p: p.stat().st_mtime_ns for p in kept}

    before = touched()
    with small():                                                       # as the first time
        assert run(cli.demo, "scape demo", ["--quick", "--output", str(folder)]) == 0
    assert before == touched()
    elsewhere = "report.json", "run.json"                               # times, and the paths of the call
    assert files(folder, *elsewhere) == files(small_demo, *elsewhere)
    figures, again = metrics(small_demo), metrics(folder)
    same = [name for name in figures if name != "time"]
    assert {name: again[name] for name in same} == {name: figures[name] for name in same}


def files(folder, *but):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*")
            if p.is_file() and ".scapekit" not in p.parts and p.name not in but}
