"""The notebooks run as they stand, on public names alone, and are short."""
import ast
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from readme_user import of_a_user

from completion.demo.sample import HALF_VIEW, PEOPLE, RATE, record_markers, sample_pose, scan_to_file
from completion.mocap.files.markers import write_markers
from model import load_model
from scanprep import write_mesh
from scanprep.synthetic.data_set import stand
from scanprep.synthetic.people import SyntheticPerson, synthesise_walk

NOTEBOOKS = {path.stem: path for path in (Path(__file__).parents[1] / "completion" / "notebooks").glob("*.ipynb")}


def code_of(name):
    cells = json.loads(NOTEBOOKS[name].read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") for cell in cells), "without outputs"
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_is_short_and_public(name):
    code = code_of(name)
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module != "pathlib":
            assert {each.name for each in node.names} <= set(importlib.import_module(node.module).__all__)
        assert not (isinstance(node, ast.Attribute) and node.attr.startswith("_"))


def run(name, folder):
    with of_a_user(folder):
        exec(compile(code_of(name), name, "exec"), {})


@pytest.mark.slow
def test_half_a_scan_becomes_a_table(tmp_path):
    scan_to_file(tmp_path, HALF_VIEW, SyntheticPerson(PEOPLE[HALF_VIEW.person]), 0)
    run("half_scan_to_table", tmp_path)
    head, *rows = (tmp_path / "measures.csv").read_text().splitlines()
    table = {row.split(",")[0]: float(row.split(",")[1]) for row in rows}
    assert head == "measure,value,error" and abs(table["stature"] - 1.8) < 0.05
    assert (tmp_path / "completed" / "completion.npz").exists()


def test_a_recording_becomes_joint_angles(tmp_path):
    person = SyntheticPerson(PEOPLE["frank"])
    poses, trans = synthesise_walk(24, RATE)
    bodies = np.stack([person.in_pose(*each) for each in zip(poses, trans, strict=True)])
    write_markers(tmp_path / "walk.c3d", record_markers(bodies, person.mesh.faces, RATE, np.random.default_rng(0),
                                                      lambda done, total: None))
    run("c3d_to_angles", tmp_path)
    with open(tmp_path / "angles.csv") as lines:
        head = lines.readline().strip().split(",")
    assert head[0] == "time" and "knee_angle_r" in head
    assert np.loadtxt(tmp_path / "angles.csv", delimiter=",", skiprows=1).shape == (24, len(head))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_scans_become_a_model(tmp_path):
    for name, pose in (("anna", "standing"), ("anna_boxer", "boxer"), ("carol", "standing")):
        person = SyntheticPerson(PEOPLE[name.partition("_")[0]])
        body = stand(person, sample_pose(pose, np.random.default_rng(0))).vertices
        write_mesh(tmp_path / "scans" / f"{name}.ply", person.mesh.with_vertices(body))
    (tmp_path / "scans" / "scans.csv").write_text("name,subject\nanna,anna\nanna_boxer,anna\ncarol,carol\n")
    run("scans_to_model", tmp_path)
    model = load_model(tmp_path / "model.npz")
    assert model.n_betas >= 1 and model.template.is_closed
