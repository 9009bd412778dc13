"""A statue in motion: by its own skeleton, or following a learned model."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from scanprep.correspondence.correlated import find_correspondences
from scanprep.geometry.landmarks import match_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError, load_arrays
from scanprep.registration.nonrigid import Registration, register, registration_problem

from ...body import BodyModel
from ...export.bvh_read import read_bvh
from ...fitting import fit_shape
from ..detail.reconstruction import Reconstruction
from ..detail.subdivision import subdivide
from ..statue import Statue
from .follow import Follower
from .motions import bvh_motion, own_motion, people_motion
from .retarget import StatueMotion

Progress = Callable[[int, int], None]
REGISTERED_ON = 2                    # level of the reconstruction that a learned model is registered to


def read_statue_motion(statue: Statue, path: Path) -> StatueMotion:
    """A motion for the skeleton of a statue: BVH, or `.npz` of its own parts or of the synthetic people.

    Raises
    ------
    StorageError
        Missing, damaged, or of other parts.
    """
    if path.suffix.lower() == ".bvh":
        return bvh_motion(statue.control, statue.pose, read_bvh(path, "cm"))     # travel is scaled by the legs
    stored = load_arrays(path, "a motion (.npz) or BVH")
    if "poses" not in stored:
        raise StorageError(f"{path}: expected a motion, it lacks poses")
    count = stored["poses"].size // max(3 * len(np.atleast_1d(stored["poses"])), 1)
    own, people = len(statue.control.skeleton.parents), 16
    if count == own:
        return own_motion(statue.control, path)
    if count != people:
        raise StorageError(f"{path}: expected the {own} parts of the statue or the {people} of the synthetic people, "
                           f"found {count}; for a motion of a learned model name it with --model")
    rate = stored.get("mocap_frame_rate", stored.get("mocap_framerate", np.array(60.0)))
    poses = stored["poses"].astype(np.float64).reshape(-1, people, 3)
    return people_motion(statue.control, statue.pose, poses, stored.get("trans"), float(rate))


def follower_of(statue: Statue, model: BodyModel, registered: np.ndarray | None = None,
                progress: Progress | None = None) -> Follower:
    """The control mesh bound to a learned model, which is registered to the statue first.

    Parameters
    ----------
    registered : (N, 3) float, metres, optional
        The model's template on the scan, where that is known; else it is brought there by the landmarks that both
        have, or without any by correspondences.

    Raises
    ------
    ValueError
        The template could not be brought onto the statue.
    """
    if registered is None:
        surface = Reconstruction(statue.control, statue.map,
                                 subdivide(statue.control.mesh, statue.control.chart, REGISTERED_ON)).mesh()
        registered = _registered(statue, model, surface, progress).mesh.vertices
    fit = fit_shape(model, registered)
    subject = model.subject(fit.betas if model.n_betas else None)
    return Follower(statue.control.mesh, subject, fit.pose, fit.trans, registered)


def _registered(statue: Statue, model: BodyModel, surface: Mesh, progress: Progress | None) -> Registration:
    control, pairs, hints = statue.control, None, None
    places = {name: control.mesh.vertices[vertex] for name, vertex in control.landmarks.items()}
    try:
        pairs = match_landmarks(model.info.get("landmarks") or {}, places, minimum=8)[1:]
        pairs = pairs[0].astype(np.int64), pairs[1]
    except ValueError:                   # other names, or none
        hints = find_correspondences(model.template, surface)
    fit = register(model.template, surface, pairs, progress=progress, correspondences=hints)
    problem = registration_problem(model.template, surface, fit, pairs is not None)
    if problem:
        raise ValueError(f"model: its template could not be brought onto the statue, {problem}; register it to the "
                         "scan with landmarks (scape prep register) and name the result with --registered")
    return fit
