"""Rigid links between neighbours [Hahnel]: nodes rotate and move, and keep their size."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jointed_bodies import bent, crab

from scanprep.geometry.mesh import Mesh
from scanprep.registration.graph_fit import GraphFit, start_fit
from scanprep.registration.matches import prepare_problem, pull
from scanprep.registration.nonrigid import register
from scanprep.registration.schedule import GraphStage, RegistrationConfig

LEFT, RIGHT = np.array([0, 0, 0.6]), np.array([0, 0.6, 0])
GIVEN = prepare_problem(crab(), crab())
SIZE = GIVEN.size


def all_wanted(x):
    return pull(len(x), np.arange(len(x)), x, GIVEN.template.vertex_areas)


def begun(T=None, nodes=80) -> GraphFit:
    return start_fit(GIVEN.template, np.eye(4) if T is None else T, nodes)


def linked(fit: GraphFit, wanted, length: float) -> GraphFit:
    return fit.minimise(wanted, GraphStage(80, length / SIZE, 0.0, 0.0, 0.0), SIZE, 3)


def off(fit: GraphFit, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(fit.x - wanted, axis=1).mean())


def test_nodes_rotate_but_do_not_grow():
    wanted, fit, larger = bent(crab(), LEFT, RIGHT), begun(), begun()
    for _ in range(6):
        fit = linked(fit, all_wanted(wanted), 0.03 * SIZE)
    assert off(fit, wanted) < 0.004
    assert (fit.motion.log_scale == 0).all()
    for _ in range(4):
        larger = linked(larger, all_wanted(1.3 * crab().vertices), 5.0 * SIZE)
    assert np.ptp(larger.x[:, 0]) < 1.02 * np.ptp(crab().vertices[:, 0])


@pytest.mark.slow
def test_the_published_registration_bends_the_body_too():
    stages = RegistrationConfig.from_paper().graph
    assert [stage.stretch for stage in stages] == sorted((stage.stretch for stage in stages), reverse=True)
    x = bent(crab(), LEFT / 2, RIGHT / 2)
    marks = np.array([820, 821, 9 * 20, 9 * 20 + 10, 31 * 20 + 5, 31 * 20 + 15])
    config = replace(RegistrationConfig.from_paper(), graph=tuple(replace(s, nodes=150) for s in stages))
    found = register(crab(), Mesh(x, crab().faces), (marks, x[marks]), config)
    apart, before = (np.linalg.norm(y - x, axis=1).mean() for y in (found.mesh.vertices, crab().vertices))
    assert apart < 0.02 and apart < 0.8 * before        # point to point, matches slide along the skin
    assert found.rms < 0.001 and found.seen.mean() > 0.8
