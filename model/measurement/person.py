"""Measurements of a person in any pose: what the pose changes is measured standing, all else as the person is.

Their expected errors have three sources: the surface, the place where the tape lies, and the pose.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.sides import split_side

from ..posing.standing import StandingBody, StandingModel
from .measure import Measurements, measure
from .reading import Reading
from .tapes import Found, Girth, Span, Tapes, Weight

# How far joints are from where the model has them, metres: those of limbs, and those of the spine, which bends over its
# whole length. A tape changes by CREASE of its length when the joints beside it turn by one radian; beside means nearer
# than about BESIDE, metres. Chosen on the true bodies of 30 people whom the model does not know, in seven kinds of
# poses: root mean squares of true and stated errors are 6 and 6 mm of stature, 9 and 8 of bust, 10 and 11 of hips.
LIMB, SPINE, CREASE, BESIDE = 0.012, 0.018, 0.020, 0.20


def measure_person(vertices: np.ndarray, tapes: Tapes, standing: StandingModel, axes: np.ndarray,
                   expected_error: np.ndarray | None = None) -> Measurements:
    """Measure a registered person in any pose.

    Girths across a limb or the neck, the waist and the weight are measured as the person is, since bringing a limb
    elsewhere changes its skin by more than the pose does. All else is measured in the pose of the standing model.

    Parameters
    ----------
    vertices : (N, 3) float, metres
        The body, in the topology of the template of the tapes.
    tapes : Tapes
        Tapes of the template.
    standing : StandingModel
        What brings the body into the standing pose.
    axes : (3, 3) float
        Unit vectors up, left and ahead of the standing body.
    expected_error : (N,) float, metres, optional
        Expected errors of the vertices.

    Returns
    -------
    Measurements
        With curves on the standing body, which `Measurements.body` is.
    """
    stood = standing.stand(vertices)
    upright = measure(stood.vertices, tapes, axes, expected_error)
    # as the person is, laid on the standing body around the waist: level is across the trunk, however it leans
    waist = tapes.found.get("waist_girth")
    ring = np.unique(waist.faces) if isinstance(waist, Girth) else slice(None)
    R, shift = rotations.procrustes(vertices[ring], stood.vertices[ring])
    as_it_is = measure(vertices @ R.T + shift, tapes, axes, expected_error, [
        name for name, found in tapes.found.items() if keeps_in_pose(name, found)])
    readings, missing, errors = dict(upright.readings), dict(upright.missing), dict(upright.errors)
    posed = errors_of_pose(upright.readings, tapes, standing, stood)
    for name in readings:
        errors[name] = float(np.hypot(errors[name], posed[name]))
    for name, reading in as_it_is.readings.items():
        # the curve is that on the standing body, which the page shows
        drawn = readings[name].curve if name in readings else np.zeros((0, 3))
        readings[name] = replace(reading, curve=drawn)
        # a neighbouring joint that turned folds the skin, or swells a muscle, that hangs when people are measured
        errors[name] = float(np.hypot(as_it_is.errors[name], crease_error(readings[name], tapes.found[name], standing,
                                                                          stood.pose)))
        missing.pop(name, None)
    return Measurements({name: readings[name] for name in tapes.found if name in readings}, missing, (), axes, errors,
                        stood.vertices)


def keeps_in_pose(name: str, found: object) -> bool:
    """Return whether a measurement is the same in every pose: one part alone carries it, and no joint is in it."""
    return isinstance(found, Weight) or name == "waist_girth" or (
        isinstance(found, Girth) and found.axis is not None and not name.startswith("knee"))


def errors_of_pose(readings: Mapping[str, Reading], tapes: Tapes, standing: StandingModel, stood: StandingBody
                ) -> dict[str, float]:
    """Compute the error of each measurement, metres, by bringing a body from its pose into the standing one.

    Where joint j is off by c, everything beyond it comes to lie (I - R_j) c from its right place. The derivative of
    the measurement by these vertices carries it over. Skin that folds adds `crease_error`.
    """
    skeleton, parts = standing.model.skeleton, standing.parts
    R = rotations.exp(stood.pose)
    shift = np.eye(3) - R                                        # (J, 3, 3)
    errors = dict[str, float]()
    for name, reading in readings.items():
        square = 0.0
        for j in range(1, len(skeleton.parents)):
            beyond = skeleton.descends[parts[reading.vertices], j]
            sd = LIMB if split_side(skeleton.names[j])[1] else SPINE
            square += sd**2 * float(((reading.force[beyond].sum(axis=0) @ shift[j])**2).sum())
        errors[name] = float(np.hypot(np.sqrt(square), crease_error(reading, tapes.found[name], standing, stood.pose)))
    return errors


def crease_error(reading: Reading, found: Found, standing: StandingModel, pose: np.ndarray) -> float:
    """Compute the error of a girth or breadth, metres, beside joints that turned by a pose (J, 3); 0 of all else."""
    if not isinstance(found, Girth | Span):
        return 0.0
    joints = standing.model.joint_regressor @ standing.model.template.vertices
    near = np.exp(-(np.linalg.norm(joints - reading.curve.mean(axis=0), axis=1) / BESIDE)**2)
    near[0] = 0                                                  # the whole body turned
    return CREASE * reading.value * float(np.sqrt(near @ (pose**2).sum(axis=1)))
