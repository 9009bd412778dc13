"""pymomentum's calibration and tracking of markers on a skeleton; imports neither scapekit nor scipy.

Their C++ library is not the one that pymomentum brings, which must be loaded first: else it ends in a segmentation
fault where it draws its progress bar. For the same reason torch, which it imports but does not need here, is held back.
"""
from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from alone import MissingError, processor_seconds


@dataclass(frozen=True)
class Given:
    """What pymomentum is given beside the rig; the values here are its defaults, and no limit at all.

    Attributes
    ----------
    lengths : float
        The share by which bones may become longer or shorter.
    size : float
        The power of two by which the whole body may.
    held : float
        How strongly locators are held at their places while these are calibrated.
    calibration, tracking : dict
        Settings of `CalibrationConfig` and `TrackingConfig`.
    """

    lengths: float = np.inf
    size: float = np.inf
    held: float = 0.0
    calibration: dict[str, Any] = field(default_factory=dict)
    tracking: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Markers:
    """A skeleton at rest with markers, and where these are seen; centimetres, y up."""

    names: tuple[str, ...]           # of J joints
    parents: np.ndarray              # (J,)
    joints: np.ndarray               # (J, 3)
    labels: tuple[str, ...]          # of L markers
    parts: np.ndarray                # (L,) the joint that carries each
    places: np.ndarray               # (L, 3) at rest
    seen: np.ndarray                 # (T, L, 3), NaN where one was not


def solve(markers: Markers, given: Given) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Places of the markers (T, L, 3), quaternions (T, J, 4) x y z w and places (T, J, 3) of joints, processor seconds.
    """
    geometry, tracking = modules()
    frames = [[geometry.Marker(label, np.nan_to_num(x), bool(np.isnan(x[0])))
               for label, x in zip(markers.labels, frame, strict=True)] for frame in markers.seen]
    character = build(geometry, markers, given)
    start = processor_seconds()
    found = tracking.process_markers(character, np.zeros(0, np.float32), frames,
                                     tracking.TrackingConfig(**given.tracking),
                                     tracking.CalibrationConfig(**given.calibration), calibrate=True)
    cpu_s = processor_seconds() - start
    state = np.asarray(geometry.model_parameters_to_skeleton_state(character, found), dtype=float)
    offset = np.stack([locator.offset for locator in character.locators])
    on = state[:, markers.parts]
    places = on[..., :3] + on[..., 7:] * turned(on[..., 3:7], offset)
    return places, state[..., 3:7], state[..., :3], cpu_s


def modules() -> tuple[Any, Any]:
    """`pymomentum.geometry` and `pymomentum.marker_tracking`."""
    sys.modules["torch"] = None          # type: ignore[assignment]
    try:
        import pymomentum.geometry as geometry
        import pymomentum.marker_tracking as tracking
    except ImportError as error:
        raise MissingError("pymomentum-core") from error
    finally:
        del sys.modules["torch"]
    geometry.set_log_level(geometry.LogLevel.Error)
    return geometry, tracking


def build(geometry: Any, markers: Markers, given: Given) -> Any:
    """The character: joints, what may change about them, and a locator for every marker."""
    names, parents, joints = markers.names, markers.parents, markers.joints
    J, offsets = len(names), np.concatenate([joints[:1], joints[1:] - joints[parents[1:]]])
    bones = geometry.Skeleton([geometry.Joint(name, int(parent), np.array([0, 0, 0, 1], np.float32), offset)
                               for name, parent, offset in zip(names, parents, offsets.astype(np.float32),
                                                               strict=True)])
    columns = {f"root_{kind}": unit(J, 0, i) for i, kind in enumerate(("tx", "ty", "tz", "rx", "ry", "rz"))}
    columns |= {f"{names[j]}_{kind}": unit(J, j, 3 + i) for j in range(1, J)
                for i, kind in enumerate(("rx", "ry", "rz"))}
    limits = {"scale_global": given.size}
    columns["scale_global"] = unit(J, 0, 6)
    for j in range(1, J):
        bone = "scale_" + names[j].removesuffix("_left").removesuffix("_right")
        columns.setdefault(bone, np.zeros((J, 7)))[j, :3] = offsets[j]
        limits[bone] = given.lengths
    transform = geometry.ParameterTransform(
        list(columns), bones, np.stack([c.ravel() for c in columns.values()], axis=1).astype(np.float32))
    local = (markers.places - joints[markers.parts]).astype(np.float32)
    locators = [geometry.Locator(label, int(part), place, limit_origin=place, limit_weight=np.full(3, given.held))
                for label, part, place in zip(markers.labels, markers.parts, local, strict=True)]
    return geometry.Character("person", bones, transform, locators=locators).with_parameter_limits(
        [geometry.ParameterLimit.create_minmax(i, -limits[name], limits[name], 1.0)
         for i, name in enumerate(columns) if np.isfinite(limits.get(name, np.inf))])


def unit(J: int, joint: int, parameter: int) -> np.ndarray:
    """(J, 7) zeros but for one parameter of one joint."""
    out = np.zeros((J, 7))
    out[joint, parameter] = 1.0
    return out


def turned(q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Vectors x (..., 3) turned by quaternions (..., 4), x y z w."""
    twice = 2 * np.cross(q[..., :3], x)
    return x + q[..., 3:] * twice + np.cross(q[..., :3], twice)
