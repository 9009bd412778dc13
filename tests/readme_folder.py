"""The files that the documents name, in a folder of a user, and the commands and snippets that use them."""
import json
import os
import re
import shlex
import shutil
from pathlib import Path
from unittest.mock import patch
from urllib.parse import quote
from urllib.request import urlopen

import pytest
from readme_user import of_a_user

from completion import Motion
from completion.__main__ import main
from completion.demo.sample import PEOPLE, RATE, WALKER, write_figure
from model import load_model, write_body_npz
from scanprep import RegisteredSet, write_mesh
from scanprep.batch.ownership import HOME
from scanprep.batch.values import load_step_header
from scanprep.decimation.registered_set import decimate_set
from scanprep.pipeline.prepare import SCANS
from scanprep.synthetic.data_set import GroundTruth
from scanprep.synthetic.people import SyntheticPerson, synthesise_walk
from scanprep.synthetic.scanner import ScannerConfig, scan
from scanprep.viewer import server

ROOT = Path(__file__).parents[1]
README = "README.md"
# Which documents each test file runs, in this order. Those of one file use what the commands before them wrote.
PARTS = {
    "start": (README, "index", "tasks/researcher", "tasks/anthropometrist", "tasks/biomechanist", "tasks/animator"),
    "scans": ("scanprep/README.md", "methods/registration", "methods/skeleton", "methods/scan-repair",
              "methods/correspondence"),
    "model": ("model/README.md", "methods/scape", "methods/other-models", "methods/learning-from-few-scans",
              "methods/body-fit", "methods/coregistration", "methods/measurement", "methods/statues",
              "methods/pytorch")}
REST = "completion"                  # all other documents
CHILD = 0.5                          # the size of the person in the range views: small ones are merged quickly
OTHERS = 2500                        # triangles of meshes that others registered: a skeleton is sought on them
SIDES = {0: "front", 4: "back"}      # two views of the grown person
SETTINGS = "quicker.toml"
# added to commands that begin so and take long: words, or settings in a file
QUICKER = {
    "scape statue fit": "--size 512",
    "scape prep skeleton": "restarts = 1",
    "scape learn --poses set --shapes set --kind": "--skeleton set/skeleton.json"}
# what the pages about methods find in the folder, made with the model of the demonstration
MADE_BEFORE = ("scape model mesh model.npz --betas 1.5 -o bigger.ply",
               "scape complete half_view.ply -m model.npz -o completed",
               "scape animate walk.c3d -m model.npz --layout layout.json -o walk")
SET_UP = {"pip install ."}


def documents(part):
    """The documents of a part that exist, as paths from the root."""
    pages = sorted((ROOT / ".docs" / "pages").rglob("*.md"))
    everything = [README, *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("[a-z]*/README.md")),
                  *(path.relative_to(ROOT).as_posix() for path in pages)]
    named = {one: [name if name.endswith(".md") else f".docs/pages/{name}.md" for name in names]
             for one, names in PARTS.items()}
    taken = {name for names in named.values() for name in names}
    wanted = named[part] if part != REST else [name for name in everything if name not in taken]
    return [name for name in wanted if name in everything]


def blocks(document, kind):
    """The texts of one kind, "bash" or "python", in a document."""
    return re.findall(rf"```{kind}\n(.*?)```", (ROOT / document).read_text(encoding="utf-8"), re.DOTALL)


def commands(document):
    return [line for text in blocks(document, "bash") for line in text.splitlines() if line]


def commands_of_part(part):
    """Every command of a part in its order, each once. Those of README are run by the part that README is in."""
    elsewhere = set() if README in documents(part) else set(commands(README))
    lines = dict.fromkeys(line for document in documents(part) for line in commands(document))
    return [line for line in lines if line not in SET_UP | elsewhere]


def snippets_of_part(part):
    """(document, code) of every Python snippet of a part, each once."""
    found = {code: pytest.param(document, code, id=f"{document}-{i}") for document in reversed(documents(part))
             for i, code in enumerate(blocks(document, "python"))}
    return list(found.values())[::-1]


def run_command(line):
    """One command as a user writes it."""
    words = shlex.split(line)
    if words[0] == "cd":
        os.chdir(words[1])
        return
    assert words[0] == "scape", line
    words = ["own.ply" if w == "template.ply" and "views" in words else w for w in words]    # it is there already
    more = next((more for begin, more in QUICKER.items() if line.startswith(begin)), "")
    if "=" in more:
        Path(SETTINGS).write_text(more + "\n")
        more = f"--config {SETTINGS}"
    words += more.split()
    with patch.object(server, "serve", open_once):
        assert main(words[1:]) == 0, line


def run_snippet(document, code):
    if "import torch" in code:
        pytest.importorskip("torch")
    exec(compile(code, document, "exec"), {})


def open_once(app, *_given):
    """In place of a server that runs until Ctrl-C: one that a browser asks once for its page."""
    with server.Server(app) as running, urlopen(running.opening()) as answer:
        assert answer.status == 200 and b"scapekit.start" in answer.read()


def user_folder(demo, folder):
    """Ten scans, a template, a half view, a recording, frames of a walk, registered meshes, range views.

    All scans are registered already, in a set that is not finished.
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
    shutil.copy(demo / "scans" / f"{mine[0].split(',')[0]}.ply", folder / "standing.ply")
    write_figure(folder, SyntheticPerson(PEOPLE[WALKER]), *synthesise_walk(24, RATE))
    shutil.copy(demo / "scans" / f"{mine[1].split(',')[0]}.ply", folder / "anna.ply")
    cameras = {}
    rest = GroundTruth.load(demo / "template_scan" / "truth" / "rest.npz")
    for k, view in enumerate(scan(rest.mesh, ScannerConfig(views=12, blind_reach=0.01)).views):
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
    begun_set(demo / "set", folder / "set", [row.split(",")[0] for row in mine + others])
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


def keep_scans(folder, names):
    """Remove the other scans, so that a command of the whole folder is quick."""
    rows = (folder / "scans" / "scans.csv").read_text().splitlines()
    kept = [row for row in rows[1:] if row.split(",")[0] in names]
    assert len(kept) == len(names)
    (folder / "scans" / "scans.csv").write_text("\n".join([rows[0], *kept]) + "\n")
    for row in rows[1:]:
        if row not in kept:
            for ending in (".ply", ".landmarks.json"):
                (folder / "scans" / (row.split(",")[0] + ending)).unlink()


def with_demo_model(folder):
    """Set and model of the demonstration, and what is made with it."""
    demo = folder / "scape_demo"
    shutil.copy(demo / "model.npz", folder / "model.npz")
    shutil.copytree(demo / "set", folder / "set", dirs_exist_ok=True)
    with of_a_user(folder):
        for line in MADE_BEFORE:
            run_command(line)
    return folder
