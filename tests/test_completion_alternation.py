from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MARKS, POSE, TRANS, half_view, worm_with_prior
from derivatives import slope

from completion.partial.alternation import Alternation, Blocks, Markers, nearest_markers, solve_twists
from completion.partial.completion import complete
from completion.partial.settings import CompletionConfig
from model.fitting.bodies import FixedBody
from model.fitting.scan import prepare_scan
from model.fitting.scan_fit import REACH, scan_fit
from model.gradients import edges
from scanprep.geometry import rotations
from scanprep.geometry.surface import Surface

BETAS = np.array([1.2, -0.8, 0.5])
TURNS = CompletionConfig(random_starts=12, rounds=6, scan_points=800, model_points=300,
                         method="alternation")
MODEL = worm_with_prior()


def away(betas=BETAS):
    """Blocks some way from the truth, and all vertices of the truth as markers."""
    truth = MODEL.vertices(POSE, betas, TRANS)
    off = np.random.default_rng(0).normal(0, 0.15, (4, 3))
    R, start = MODEL.skeleton.part_rotations(POSE + off), 0 * betas
    now = Blocks(R, Alternation(MODEL).predict(R, start) + MODEL.skeleton.joints[0] + TRANS, start)
    return truth, now, Markers(np.arange(len(truth)), truth, np.full(len(truth), 1.0))


def test_each_step_lowers_the_energy_over_its_own_block():
    _, now, markers = away()
    steps = Alternation(MODEL)
    for _ in range(4):
        before = steps.energy(now, markers)
        stretched = steps.solve_vertices(now, markers)
        shaped = steps.solve_shape(stretched)
        assert steps.energy(shaped, markers) < steps.energy(stretched, markers) < before
        assert stretched.R is now.R and stretched.betas is now.betas and shaped.R is now.R and shaped.Y is stretched.Y
        now = steps.solve_rotations(shaped, 0.0)


def test_the_surface_and_the_betas_are_where_the_gradient_vanishes():
    _, now, markers = away()
    steps, rng = Alternation(MODEL), np.random.default_rng(1)
    for found, name, h in ((steps.solve_vertices(now, markers), "Y", 1e-4), (steps.solve_shape(now), "betas", 1e-3)):
        direction = rng.normal(size=getattr(found, name).shape)

        def at(step, found=found, name=name, direction=direction):
            return steps.energy(replace(found, **{name: getattr(found, name) + step * direction}), markers)

        bend = (at(h) - 2 * at(0) + at(-h)) / h**2
        assert bend > 0 and abs(slope(at, h)) < 1e-3 * bend * h


def test_turns_reach_the_truth_when_every_point_is_known():
    truth, now, markers = away()
    steps = Alternation(MODEL)
    markers = replace(markers, weights=100 * markers.weights)        # the more they weigh, the fewer turns it takes
    for _ in range(30):
        now = steps.solve_shape(steps.solve_vertices(steps.solve_rotations(now, 0.01), markers))
    assert np.linalg.norm(now.Y - truth, axis=1).mean() < 1e-3
    true = Blocks(MODEL.skeleton.part_rotations(POSE), truth, BETAS)
    assert steps.energy(now, markers) <= steps.energy(true, markers)     # not zero: the edges do not quite fit together
    np.testing.assert_allclose(now.betas, BETAS, atol=0.2)
    np.testing.assert_allclose(now.R, true.R, atol=0.08)               # how Q turns with R is ignored


def test_damped_twists_are_where_the_gradient_of_their_energy_vanishes():
    """[SCAPE] Eq. 11, a parabola: central differences are exact."""
    skeleton, part, rng = MODEL.skeleton, MODEL.skeleton.part_of_face, np.random.default_rng(1)
    e = edges(MODEL.template.vertices, MODEL.template.faces)
    v = e @ np.swapaxes(rotations.exp(rng.normal(0, 0.3, (4, 3))), -1, -2)[part]

    def energy(t):
        off = e + np.cross(t[part][:, None], e) - v
        return (off**2).sum() + 0.2 * ((t[1:] - t[skeleton.parents[1:]])**2).sum()

    found = solve_twists(skeleton, part, e, v, 0.2)
    for step in np.eye(12).reshape(12, 4, 3):
        ahead, behind = energy(found + step), energy(found - step)
        assert abs(ahead - behind) < 1e-9 * (ahead + behind - 2 * energy(found))


def test_markers_weigh_as_the_points_of_the_scan():
    """On the scan itself all matches of its points weigh `surface_weight` a point; a landmark as its variance says."""
    model, config = worm_with_prior(0), replace(TURNS, surface_weight=0.7, landmark_sd=0.002, scan_sd=0.005)
    mesh = model.template
    fit = scan_fit(FixedBody(model.subject(None)), prepare_scan(mesh), MARKS, mesh.vertices[MARKS], config)
    found = nearest_markers(fit, config.surface_weight, mesh, REACH)
    cloud, thin = len(fit.cloud.points), len(fit.thin.points)
    of_scan = found.weights[len(MARKS):len(MARKS) + thin]
    np.testing.assert_allclose(of_scan.sum(), 0.7 * cloud, rtol=1e-3)
    one = 400 / 0.005**2 / thin                                 # what a point is worth: `EVIDENCE` over its variance
    np.testing.assert_allclose(found.weights[:len(MARKS)], 0.7 * cloud / thin * 0.002**-2 / one)


@pytest.mark.parametrize("betas", [None, BETAS], ids=["own body", "unknown shape"])
def test_half_a_scan_is_completed_in_turns(betas):
    model = MODEL if betas is not None else worm_with_prior(0)
    body = model.template.with_vertices(model.vertices(POSE, betas, TRANS))
    points, seen = half_view(body, np.array([0.3, -1, 0.5]), noise=0.001)
    result = complete(model, points, (MARKS, body.vertices[MARKS]), TURNS)
    assert Surface(body).closest(result.completed.vertices[seen]).distances.mean() < 0.002
    assert np.linalg.norm(result.completed.vertices - body.vertices, axis=1)[~seen].mean() < 0.02
    assert set(result.energies) == {"eq_10"} and result.iterations > TURNS.rounds
    assert (result.betas is None) == (betas is None)
    assert result.expected_error.shape == result.confidence.shape == seen.shape
    assert result.confidence[result.seen].min() > result.confidence[~result.seen].mean()


@pytest.mark.parametrize("body, change, message", [
    (MODEL.subject(None), {}, "body: expected a SCAPE model .* got a Subject; a model learned without shapes"),
    (MODEL, {"free_scale": True}, "free_scale: expected False with method='alternation'"),
    (MODEL, {"method": "jointly"}, "method: expected 'joint' or 'alternation', got 'jointly'"),
])
def test_what_the_alternation_cannot_use_is_refused(body, change, message):
    with pytest.raises(ValueError, match=message):
        complete(body, np.zeros((100, 3)), None, replace(TURNS, **change))
