"""Links between neighbours as regularisers: exact minima, derivatives, invariances."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matching_bodies import bent, crab

from scanprep.geometry import rotations
from scanprep.registration.affine import (
    AffineLinks,
    LinkStage,
    RigidLinks,
    allen_stages,
    amberg_stages,
    build_links,
    hahnel_stages,
)
from scanprep.registration.energies import pull

AFFINE = LinkStage("affine", 0.2, 0.1, 0.1)
RIGID = LinkStage("rigid", 0.1, 0.1, 0.1, nodes=80)


def all_wanted(x, share=1.0):
    body = crab()
    return pull(len(x), np.arange(len(x)), x, share * body.vertex_areas)


def total(links: AffineLinks, X, wanted, stage) -> float:
    """Data and links in the units that the solver weighs them in: areas and lengths over the size."""
    x = links.size * np.einsum("nk,nkd->nd", links._rest, X) + links._middle
    return wanted.energy(x) / links.size**4 + links.energy(X, stage)


@pytest.mark.parametrize(("translation", "slide"), [(1.0, 1.0), (0.1, 1.0), (1.0, 0.1)])
def test_an_affine_round_ends_where_the_energy_is_least(translation, slide):
    rng = np.random.default_rng(0)
    body = crab()
    links = build_links("affine", body)
    stage = replace(AFFINE, translation=translation)
    at = rng.integers(0, len(body.vertices), 400)
    normals = body.vertex_normals[at]
    wanted = pull(len(body.vertices), at, body.vertices[at] + 0.03 * rng.normal(size=(400, 3)),
                  rng.random(400) * 1e-3, normals, slide)
    links.round(wanted, stage)
    links.round(wanted, stage)
    least = total(links, links.X, wanted, stage)
    for _ in range(3):
        d = 1e-2 * rng.normal(size=links.X.shape)
        ahead, behind = (total(links, links.X + h * d, wanted, stage) for h in (1.0, -1.0))
        assert ahead > least and behind > least
        # The energy is quadratic: at its minimum it rises alike in both directions.
        assert abs(ahead - behind) < 2e-3 * (ahead + behind - 2 * least)


def test_one_affine_map_of_all_costs_nothing_and_is_followed():
    body = crab()
    M = np.array([[1.2, 0.1, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.3, 1.1]])
    wanted = body.vertices @ M.T + [0.3, -1.0, 2.0]
    links = build_links("affine", body)
    assert isinstance(links, AffineLinks)
    x = links.round(all_wanted(wanted), replace(AFFINE, length=1.0))
    np.testing.assert_allclose(x, wanted, atol=1e-4)
    assert links.energy(links.X, AFFINE) < 1e-8


def test_softer_links_follow_more():
    body = crab()
    wanted = bent(body, np.array([0, 0, 0.8]), np.array([0, 0.8, 0]))
    apart = [np.linalg.norm(build_links("affine", body).round(all_wanted(wanted), replace(AFFINE, length=length))
                            - wanted, axis=1).mean() for length in (1.0, 0.3, 0.1)]
    assert apart[0] > 2.5 * apart[1] > 6 * apart[2]


@pytest.mark.parametrize("stage", [AFFINE, RIGID])
def test_moves_with_the_input(stage):
    body = crab()
    wanted = bent(body, np.array([0, 0, 0.4]), np.array([0, 0.4, 0]))
    R, t = rotations.exp(np.array([0.4, -0.7, 1.1])), np.array([3.0, -1.0, 0.5])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    first = build_links(stage.kind, body).round(all_wanted(wanted), stage)
    moved = build_links(stage.kind, body, T=T).round(all_wanted(wanted @ R.T + t), stage)
    np.testing.assert_allclose((moved - t) @ R, first, atol=2e-5)


def test_rigid_links_turn_but_do_not_grow():
    body = crab()
    wanted = bent(body, np.array([0, 0, 0.6]), np.array([0, 0.6, 0]))
    links = build_links("rigid", body)
    assert isinstance(links, RigidLinks)
    for _ in range(6):
        x = links.round(all_wanted(wanted), replace(RIGID, length=0.03))
    assert np.linalg.norm(x - wanted, axis=1).mean() < 0.004
    assert links.motion is not None
    assert (links.motion.log_scale == 0).all()
    larger = build_links("rigid", body)
    for _ in range(4):
        y = larger.round(all_wanted(1.3 * body.vertices), replace(RIGID, length=5.0))
    assert np.ptp(y[:, 0]) < 1.02 * np.ptp(body.vertices[:, 0])


def test_a_finer_graph_goes_on_from_the_coarser_one():
    body = crab()
    wanted = bent(body, np.array([0, 0, 0.6]), np.array([0, 0.6, 0]))
    links = build_links("rigid", body)
    for _ in range(5):
        before = links.round(all_wanted(wanted), RIGID)
    after = links.round(all_wanted(wanted), replace(RIGID, nodes=200))
    assert np.linalg.norm(after - before, axis=1).mean() < 0.01
    assert np.linalg.norm(after - wanted, axis=1).mean() < np.linalg.norm(before - wanted, axis=1).mean() + 0.002


def test_presets_go_from_stiff_to_soft():
    for stages in (amberg_stages(), allen_stages(), hahnel_stages()):
        lengths = [stage.length for stage in stages]
        assert lengths == sorted(lengths, reverse=True)
        assert len({stage.kind for stage in stages}) == 1
        assert stages[0].reach == 0 and stages[-1].reach > 0


def test_an_unknown_kind_is_named():
    with pytest.raises(ValueError, match=r"kind: expected.*'elastic'"):
        build_links("elastic", crab())  # type: ignore[arg-type]
