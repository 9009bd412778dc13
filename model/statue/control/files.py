"""Files of control models: our own, and skinned meshes of other programs."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .chart import Chart
from .model import ControlModel, control_problem

KIND, VERSION = "control model", 1


def read_control(path: str | Path) -> ControlModel:
    """A control model: a file of `write_control`, or a skinned mesh in a GLB file as Blender exports it.

    Of a skinned mesh the pose of the file is the default pose, turned so that z is up; vertices that stand at one place
    are one; joints turn about three axes with wide limits, every part is a segment of its own, and there are no
    landmarks. Joints that carry no triangle are left out. Without texture coordinates a chart is made.

    Raises
    ------
    StorageError
        Missing, neither of the two, damaged; a mesh that is open, not manifold or in several pieces, without weights,
        or with texture coordinates that are not one chart.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        return _load(path)
    if path.suffix.lower() == ".glb":
        from .glb import read_skinned

        return read_skinned(path)
    raise storage.StorageError(f"{path}: expected a control model in .npz or a skinned mesh in .glb")


def write_control(control: ControlModel, path: str | Path) -> None:
    """Write one `.npz` file, which `read_control` reads."""
    skeleton = control.skeleton
    storage.save(path, KIND, VERSION, {
        "vertices": control.mesh.vertices, "faces": control.mesh.faces.astype(np.int32),
        "part_of_face": skeleton.part_of_face.astype(np.int32), "parents": skeleton.parents, "joints": skeleton.joints,
        "weights": control.weights, "uv": control.chart.uv, "chart_faces": control.chart.faces.astype(np.int32),
        "axes": np.concatenate(control.axes), "limits": np.concatenate(control.limits),
        "freedom": np.array([len(axes) for axes in control.axes]), "segment_of_part": control.segment_of_part,
        "landmark_vertices": np.array(list(control.landmarks.values()), dtype=np.int64)},
        {"names": list(skeleton.names), "segments": list(control.segments), "landmarks": list(control.landmarks)})


def _load(path: str | Path) -> ControlModel:
    """A file of `write_control`."""
    header, arrays = storage.load(path, KIND, (VERSION,))
    with storage.taking_apart(path, "a whole control model"):
        freedom = storage.numbers(arrays, "freedom", None, kinds="iu")
        J, ends = len(freedom), np.cumsum(freedom)[:-1]
        mesh = Mesh(storage.numbers(arrays, "vertices", None, 3), storage.numbers(arrays, "faces", None, 3, kinds="iu"))
        N, k = len(mesh.vertices), int(freedom.sum())
        skeleton = Skeleton(storage.numbers(arrays, "part_of_face", len(mesh.faces), kinds="iu"),
                            storage.numbers(arrays, "parents", J, kinds="iu"), storage.numbers(arrays, "joints", J, 3),
                            tuple(header["names"]))
        marks = storage.numbers(arrays, "landmark_vertices", len(header["landmarks"]), kinds="iu")
        control = ControlModel(
            mesh, skeleton, storage.numbers(arrays, "weights", N, J),
            Chart(storage.numbers(arrays, "uv", None, 2),
                  storage.numbers(arrays, "chart_faces", len(mesh.faces), 3, kinds="iu").astype(np.int64)),
            dict(zip(header["landmarks"], marks.tolist(), strict=True)),
            tuple(np.split(storage.numbers(arrays, "axes", k, 3), ends)),
            tuple(np.split(storage.numbers(arrays, "limits", k, 2), ends)), tuple(header["segments"]),
            storage.numbers(arrays, "segment_of_part", J, kinds="iu"))
        problem = control_problem(control)
        if problem:
            raise ValueError(problem)
    return control
