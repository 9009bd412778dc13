"""The files that the READMEs name, in a folder of a user, and the commands and snippets that use them."""
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch
from urllib.parse import quote
from urllib.request import urlopen

import numpy as np

from completion import Motion, read_markers, write_markers
from completion.__main__ import main
from model import load_model, write_body_npz
from scanprep import RegisteredSet, write_mesh
from scanprep.batch.ownership import HOME
from scanprep.batch.values import load_step_header
from scanprep.decimation.registered_set import decimate_set
from scanprep.pipeline.prepare import SCANS
from scanprep.synthetic.data_set import read_views
from scanprep.viewer import server

ROOT = Path(__file__).parents[1]
CHILD = 0.6                          # the size of the person in the range views: small ones are merged quickly
OTHERS = 2500                        # triangles of meshes that others registered: a skeleton is sought on them
SIDES = {0: "front", 4: "back"}      # two views of the grown person
QUICKER = {"scape statue fit": ["--size", "512"]}            # added to a command that takes long
SET_UP = {"pip install . && scape demo", 'pip install ".[test]" && pytest'}


def blocks(readme, kind):
    """The texts of one kind, "bash" or "python", in a README."""
    return re.findall(rf"```{kind}\n(.*?)```", (ROOT / readme).read_text(encoding="utf-8"), re.DOTALL)


def commands(readme):
    return [line for text in blocks(readme, "bash") for line in text.splitlines() if line]


def run_commands(readme):
    """Every command of a README in its order, as each uses what the one before it wrote."""
    wanted = [line for line in commands(readme) if line not in SET_UP]
    assert wanted
    for line in wanted:
        words = shlex.split(line)
        assert words[0] == "scape"
        words = ["own.ply" if w == "template.ply" and "views" in words else w for w in words]    # it is there already
        words += QUICKER.get(" ".join(words[:3]), [])
        with patch.object(server, "serve", opened_once):
            assert main(words[1:]) == 0, line


def opened_once(app, *_given):
    """In place of a server that runs until Ctrl-C: one that a browser asks once for its page."""
    with server.Server(app) as running, urlopen(running.opening()) as answer:
        assert answer.status == 200 and b"scapekit.start" in answer.read()


def user_folder(demo, folder):
    """Ten scans, a template, a half view, a recording, frames of a walk, registered meshes, range views.

    Eight of the scans are registered already, in a set that is not finished. From six of these scans comes a model
    that loses a shin of the half view, and says so.
    """
    shutil.copytree(demo, folder / "scape_demo")
    demo = folder / "scape_demo"
    (folder / "scans").mkdir()
    rows = (demo / "scans" / "scans.csv").read_text().splitlines()
    mine = [row for row in rows[1:] if row.split(",")[1] == "subject"][:8]
    others = [row for row in rows[1:] if row.split(",")[1] != "subject"][:2]
    (folder / "scans" / "scans.csv").write_text("\n".join([rows[0], *mine, *others]) + "\n")
    for row in [*mine, *others]:
        for ending in (".ply", ".landmarks.json"):
            shutil.copy(demo / "scans" / (row.split(",")[0] + ending), folder / "scans")
    for source, target in (("template.ply", "template.ply"), ("template.landmarks.json", "template.landmarks.json"),
                           ("half_view/half_view.ply", "half_view.ply"), ("markers/walk.c3d", "walk.c3d"),
                           ("half_view/half_view.landmarks.json", "half_view.landmarks.json"),
                           ("markers/layout.json", "layout.json")):
        shutil.copy(demo / source, folder / target)
    walk = read_markers(folder / "walk.c3d")
    write_markers(folder / "raw.c3d", replace(walk, labels=tuple(f"*{i}" for i in range(len(walk.labels)))))
    shutil.copy(demo / "scans" / f"{mine[0].split(',')[0]}.ply", folder / "standing.ply")
    shutil.copy(demo / "scans" / f"{mine[1].split(',')[0]}.ply", folder / "anna.ply")
    cameras = {}
    for k, view in enumerate(read_views(demo / "template_scan" / "views" / "rest.npz")):
        if k in SIDES:
            write_mesh(folder / f"{SIDES[k]}.ply", view.mesh)
        write_mesh(folder / "views" / f"view{k}.ply", view.mesh.with_vertices(CHILD * view.mesh.vertices))
        cameras[f"view{k}"] = (CHILD * view.camera).tolist()
    (folder / "views" / "cameras.json").write_text(json.dumps(cameras))
    model, motion = load_model(demo / "model.npz"), Motion.load(demo / "animation" / "motion.npz")
    write_body_npz(folder / "SMPL_NEUTRAL.npz", model, draws=40)
    for t, vertices in enumerate(motion.vertices(model.subject(None), slice(0, 8, 2))):
        write_mesh(folder / "frames" / f"{t:04d}.ply", model.template.with_vertices(vertices))
    registered = RegisteredSet.load(demo / "set")
    small = decimate_set(registered.template, registered.poses("subject"), OTHERS)
    bodies = dict(zip(registered.names, small.transfer(registered.vertices()), strict=True))
    for part, rows in (("poses", mine), ("people", others + mine[:1])):
        for row in rows:
            name = row.split(",")[0]
            write_mesh(folder / "registered" / part / f"{name}.ply", small.template.with_vertices(bodies[name]))
    begun_set(demo / "set", folder / "set", [row.split(",")[0] for row in [*mine[:6], *mine[7:], others[0]]])
    return folder


def begun_set(demo, folder, names):
    """A set as a run leaves it that was stopped when it had registered these scans: `scape prep run` does the others.

    They are of the demonstration, which registered the same template to the same scans. What a whole run does is there.
    """
    for result in ("person", "skeleton", *(SCANS + name for name in names)):
        record = Path(HOME, "done", f"{quote(result, safe=' ')}.npz")
        header = load_step_header(demo / record)
        for file in (record, *header["files"]):
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(demo / file, folder / file)


def with_demo_model(folder):
    """The model of the demonstration, which learned from more scans than a user has, and what was made with it."""
    demo = folder / "scape_demo"
    shutil.copy(demo / "model.npz", folder / "model.npz")
    model = load_model(demo / "model.npz")
    standing = np.zeros((len(model.skeleton.parents), 3))
    write_mesh(folder / "heavier.ply", model.template.with_vertices(model.vertices(standing, np.array([1.5]))))
    (folder / "walk").mkdir(exist_ok=True)
    shutil.copy(demo / "animation" / "motion.npz", folder / "walk")
    return folder
