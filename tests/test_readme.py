"""Every command and snippet of the README runs, on files under the names that it uses."""
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from completion import Motion
from completion.__main__ import main
from model import load_model
from scanprep import write_mesh
from scanprep.synthetic.data_set import read_views

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SET_UP = {"pip install . && scape demo", 'pip install ".[test]" && pytest'}
BLOCKS = re.findall(r"```(bash|python)\n(.*?)```", README, re.DOTALL)
COMMANDS = [line for kind, text in BLOCKS if kind == "bash" for line in text.splitlines() if line]

pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    """A folder with a user's files: five scans, a template, a half view, a recording, frames of a walk."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(demo_folder, folder / "scape_demo")
    demo = folder / "scape_demo"
    (folder / "scans").mkdir()
    rows = (demo / "scans" / "scans.csv").read_text().splitlines()
    mine = [row for row in rows[1:] if row.split(",")[1] == "subject"][:5]
    others = [row for row in rows[1:] if row.split(",")[1] != "subject"][:1]
    (folder / "scans" / "scans.csv").write_text("\n".join([rows[0], *mine, *others]) + "\n")
    for row in [*mine, *others]:
        for ending in (".ply", ".landmarks.json"):
            shutil.copy(demo / "scans" / (row.split(",")[0] + ending), folder / "scans")
    for source, target in (("template.ply", "template.ply"), ("template.landmarks.json", "template.landmarks.json"),
                           ("half_view/half_view.ply", "half_view.ply"), ("markers/walk.c3d", "walk.c3d"),
                           ("half_view/half_view.landmarks.json", "half_view.landmarks.json"),
                           ("markers/layout.json", "layout.json")):
        shutil.copy(demo / source, folder / target)
    shutil.copy(demo / "scans" / f"{mine[0].split(',')[0]}.ply", folder / "standing.ply")
    shutil.copy(demo / "scans" / f"{mine[1].split(',')[0]}.ply", folder / "anna.ply")
    cameras = {}
    for k, view in enumerate(read_views(demo / "template_scan" / "views" / "rest.npz")):
        write_mesh(folder / "views" / f"view{k}.ply", view.mesh)
        cameras[f"view{k}"] = view.camera.tolist()
    (folder / "views" / "cameras.json").write_text(json.dumps(cameras))
    model, motion = load_model(demo / "model.npz"), Motion.load(demo / "animation" / "motion.npz")
    for t, vertices in enumerate(motion.vertices(model.subject(None), slice(0, 8, 2))):
        write_mesh(folder / "frames" / f"{t:04d}.ply", model.template.with_vertices(vertices))
    for part, names in (("poses", mine), ("people", others + mine[:1])):
        (folder / "registered" / part).mkdir(parents=True)
        for row in names:
            shutil.copy(demo / "set" / "meshes" / f"{row.split(',')[0]}.ply", folder / "registered" / part)
    return folder


def test_set_up_is_what_ci_does():
    assert SET_UP <= set(COMMANDS)
    ci = (ROOT / ".ci" / "run").read_text()
    assert 'pip install --quiet ".[test]"' in ci and "\npytest\n" in ci


def test_commands(place, monkeypatch):
    """In their order, as each uses what the one before it wrote; the template is not overwritten."""
    monkeypatch.chdir(place)
    monkeypatch.setenv("SCAPEKIT_CACHE", str(place / "cache"))
    wanted = [line for line in COMMANDS if line not in SET_UP]
    assert len(wanted) >= 8
    for line in wanted:
        words = shlex.split(line)
        assert words[0] == "scape"
        words = ["own.ply" if w == "template.ply" and "views" in words else w for w in words]
        assert main(words[1:]) == 0, line
    assert (place / "completed" / "report.html").exists() and (place / "walk" / "animation.glb").exists()
    assert (place / "walking" / "statue.glb").exists() and (place / "detailed.ply").exists()
    assert (place / "first_answer" / "completed.ply").exists() and (place / "tracked" / "motion.npz").exists()


@pytest.mark.parametrize("code", [text for kind, text in BLOCKS if kind == "python"])
def test_snippets(place, monkeypatch, code):
    monkeypatch.chdir(place)
    exec(compile(code, "README.md", "exec"), {})
    assert (place / "whole.ply").stat().st_size > 10_000


def test_first_screen_and_limits():
    head = README[:1500]
    assert "![" in head and "scape demo" in head
    picture = re.search(r"!\[[^\]]*\]\(([^)]+)\)", head).group(1)
    assert (ROOT / picture).stat().st_size > 20_000
    assert "## What it does not do" in README
