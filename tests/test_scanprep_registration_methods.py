"""Another way to register is one function and one entry in `METHODS`; checks, last pass and figures are there."""
from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jointed_bodies import bent, crab
from scipy.sparse import block_diag, coo_array, csc_array, eye_array, kron, vstack
from scipy.spatial import cKDTree

from completion.__main__ import main
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.landmarks import write_landmarks
from scanprep.geometry.sparse import factor
from scanprep.registration.matches import Fit
from scanprep.registration.nonrigid import METHODS, register
from scanprep.registration.schedule import RegistrationConfig

MARKS = np.array([820, 821, 9 * 20, 9 * 20 + 10, 31 * 20 + 5, 31 * 20 + 15])


def affine(inputs, T, config, progress):
    """An affine map at every vertex, neighbours alike; closest points, ever softer.

    [Amberg] optimal step non-rigid ICP
    """
    template, target, (marks, places) = inputs.template, inputs.target, inputs.landmarks
    N, (a, b) = len(template.vertices), template.edges.T
    e = np.arange(len(a))
    arcs = coo_array((np.r_[-np.ones(len(e)), np.ones(len(e))], (np.r_[e, e], np.r_[a, b])), shape=(len(e), N))
    alike = kron(arcs, eye_array(4))
    D = csc_array(block_diag(np.c_[template.vertices, np.ones(N)][:, None]))
    maps, tree = np.tile(T[:3].T, (N, 1)), cKDTree(target.points)
    stiffness = 2.0 ** -np.arange(6)
    for k, alpha in enumerate(stiffness):
        for _ in range(3):
            far, near = tree.query(D @ maps)
            w = np.where(far < 0.1 * inputs.size, 1.0 - target.border[near], 0.0)
            rows = vstack([alpha * alike, w[:, None] * D, 3 * alpha * D[marks]], format="csc")
            goal = np.vstack([np.zeros((4 * len(e), 3)), w[:, None] * target.points[near], 3 * alpha * places])
            maps = factor(csc_array(rows.T @ rows + 1e-9 * eye_array(4 * N)))(rows.T @ goal)
        progress(k + 1, len(stiffness))
    return Fit(D @ maps, {"stiffness": float(alpha)}, 3 * len(stiffness), 0.0)


@pytest.fixture
def truth(monkeypatch):
    monkeypatch.setitem(METHODS, "affine", affine)
    return crab().with_vertices(bent(crab(), np.array([0, 0, 0.4]), np.array([0, 0.4, 0])))


def test_a_method_needs_one_function(truth):
    told = []
    config = replace(RegistrationConfig(), method="affine", final_fit=None)
    found = register(crab(), truth, (MARKS, truth.vertices[MARKS]), config, lambda *given: told.append(given))
    apart = np.linalg.norm(found.mesh.vertices - truth.vertices, axis=1)
    assert apart.mean() < 0.03 and found.rms < 0.003 and found.seen.mean() > 0.6
    assert told == sorted(told) and told[-1] == (100, 100) and set(found.energies) == {"stiffness"}
    whole = register(crab(), truth, (MARKS, truth.vertices[MARKS]), RegistrationConfig(method="affine"))
    assert "strain" in whole.energies and not whole.inverted


def test_it_is_a_word_in_the_settings_of_commands(truth, tmp_path, monkeypatch):
    for name, mesh in (("template", crab()), ("scan", truth)):
        write_mesh(tmp_path / f"{name}.ply", mesh)
        write_landmarks(tmp_path / f"{name}.json", {f"m{v}": mesh.vertices[v] for v in MARKS})
    (tmp_path / "c.toml").write_text('method = "affine"')
    words = ["prep", "register", str(tmp_path / "scan.ply"), "--template", str(tmp_path / "template.ply")]
    main([*words, "--config", str(tmp_path / "c.toml"), "-o", str(tmp_path / "out.ply")])
    assert np.linalg.norm(read_mesh(tmp_path / "out.ply").vertices - truth.vertices, axis=1).mean() < 0.03


def test_the_benchmark_knows_it(truth, monkeypatch, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parent / "benchmarks")
    import registration

    monkeypatch.setattr(sys, "argv", ["registration.py", "--help"])
    with pytest.raises(SystemExit):
        registration.main()
    assert "--method {graph,affine}" in capsys.readouterr().out


def test_an_unknown_method_is_named():
    with pytest.raises(ValueError, match="method: expected one of graph, got 'magic'"):
        register(crab(), crab(), config=RegistrationConfig(method="magic"))
