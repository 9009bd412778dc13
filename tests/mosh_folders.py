"""Folders of tiny recordings for `scape mosh`; as a program it does one: PLACE WORDS."""
import hashlib
import json
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior
from config_files import config_file
from quiet_pictures import render

from completion import MarkerLayout, MarkerSequence, write_markers
from completion.__main__ import main
from completion.mocap.mosh import cli, report
from completion.mocap.mosh.work import MoshTask
from scanprep.batch.workspace import HOME
from scanprep.pictures import scene
from scanprep.pictures.page import Page

FRAMES = 40
BETAS = {"ann": np.array([0.9, -0.6, 0.4]), "bob": np.array([-0.8, 0.5, -0.3])}
TAKES = (("ann", "walk", 0.0), ("ann", "run", 1.0), ("bob", "jump", 0.5))
QUICK = {"frames": 4, "annealing": [4.0, 1.0]}
TIMES = ("s", "frames/s")            # units of figures that differ between two runs


def recorded(model, layout, betas, phase):
    """Markers (T, L, 3) on a worm that bends, and its meshes."""
    t = np.arange(FRAMES) / 60
    poses = MEAN + np.sin(3 * t[:, None, None] + np.arange(4)[:, None] + phase) * np.array([0.05, 0.3, 0.2])
    meshes = model.subject(betas).vertices(poses, np.stack([t, 0 * t, 0 * t], axis=1))
    return np.stack([layout.place(model.template.with_vertices(v)) for v in meshes]), meshes


def write_people(place):
    """A model, a layout, and two people: ann with two recordings, bob with one."""
    model = worm_with_prior()
    model.save(place / "model.npz")
    vertices = np.random.default_rng(4).choice(396, 34, replace=False)
    layout = MarkerLayout(tuple(f"M{i}" for i in range(34)), vertices, 0.012)
    layout.save(place / "layout.json")
    truth = {}
    for person, name, phase in TAKES:
        positions, truth[name] = recorded(model, layout, BETAS[person], phase)
        positions[5:9, 3] = np.nan
        (place / "people" / person).mkdir(parents=True, exist_ok=True)
        write_markers(place / "people" / person / f"{name}.csv", MarkerSequence(positions, layout.labels, 60.0))
    np.savez(place / "truth.npz", **truth)
    return place


def run(place, *words, **settings):
    """`scape mosh` with few frames and stages, and other settings."""
    settings["person"] = QUICK | settings.get("person", {})
    return main(["mosh", "--config", str(config_file(place, **settings)), "-m", str(place / "model.npz"),
                 "--layout", str(place / "layout.json"), "--workers", "1", *map(str, words)])


@contextmanager
def small_pictures():
    """Nobody looks at them here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "render", render)
        yield


class QuietWork(MoshTask):
    """The work with small pictures and charts that are not drawn, in other processes too."""

    def __call__(self, actor, room):
        with small_pictures(), pytest.MonkeyPatch.context() as patch:
            patch.setattr(report, "chart_residuals", lambda motion: None)
            patch.setattr(Page, "chart", lambda page, *_rest: page)
            return super().__call__(actor, room)


def contents(output):
    """File -> what it holds, without what differs between two runs."""
    found = {}
    for path in sorted(p for p in output.rglob("*") if p.is_file() and HOME not in p.parts):
        data = path.read_bytes()
        if path.name == "report.json":
            tree = json.loads(data)
            kept = [m for m in tree["metrics"] if m["unit"] not in TIMES and m["metric"] != "done before"]
            data = json.dumps([tree["settings"], tree["failures"], kept]).encode()
        found[path.relative_to(output).as_posix()] = hashlib.sha256(data).hexdigest()
    return found


if __name__ == "__main__":
    cli.MoshTask = QuietWork
    sys.exit(run(Path(sys.argv[1]), *sys.argv[2:]))
