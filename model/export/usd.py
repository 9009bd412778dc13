"""USD: a body that hangs on joints as UsdSkel has it, and the exact body of every frame as points; by `usd-core`."""
from __future__ import annotations

import contextlib
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry.format_common import as_light
from scanprep.geometry.format_glb import turn_up
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import writing
from scanprep.pictures.gltf import skin_material

from ..rig import Rig, check_motion
from .glb import continuous_quaternions, four_carriers

USD = (".usd", ".usda", ".usdc", ".usdz")
_AT_ONCE = 32                        # frames whose bounds are looked for at a time


def write_skinned_usd(path: str | Path, rig: Rig, poses: np.ndarray | None = None, trans: np.ndarray | None = None,
                      rate: float = 30.0, up: int = 2) -> None:
    """Write a body that hangs on joints: a `SkelRoot` with skeleton, motion, skinned mesh and blend shapes.

    Blend shapes are those of `write_skinned_glb`: two for each beta (`beta_1_plus_3`, `beta_1_minus_3`), and the
    rig's correctives, which the motion drives. A frame is a time code; everything is turned so that y is up.

    Parameters
    ----------
    path : str or Path
        `.usd` or `.usdc` (binary), `.usda` (text) or `.usdz` (an archive, as phones open).
    rig : Rig
    poses : (T, J, 3) float, radians, optional
    trans : (T, 3) float, metres, optional
    rate : float, frames a second
    up : int
        0, 1 or 2: the axis of the body that points up.

    Raises
    ------
    ModuleNotFoundError
        usd-core is not installed.
    ValueError
        As `write_skinned_glb`.
    """
    U = turn_up(up).T
    rig = rig.turned(up)
    if poses is None or not len(poses):
        if rig.correctives is not None:
            raise ValueError("correctives: expected the poses that they belong to")
        poses = trans = np.zeros((0, 3))
    else:
        poses, trans = check_motion(rig.skeleton, poses, trans, rate)
        poses, trans = poses @ U, trans @ U
    with _stage(path, len(poses), rate) as stage:
        pxr = _library()
        root = pxr.UsdSkel.Root.Define(stage, "/body")
        stage.SetDefaultPrim(root.GetPrim())
        root.CreateExtentAttr(_extent(_reach(rig, poses, trans)))
        joints = _skeleton(stage, rig)
        mesh = _mesh(stage, "/body/mesh", rig.mesh)
        names = _blend_shapes(stage, mesh, rig)
        _bound(mesh, rig)
        if len(poses):
            _motion(stage, rig, joints, names, poses, trans)


def _reach(rig: Rig, poses: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """(n, 3) corners of boxes around the body, at rest or as it moves."""
    if not len(poses):
        return rig.mesh.vertices
    corners = []
    for start in range(0, len(poses), _AT_ONCE):
        bodies = rig.vertices(poses[start:start + _AT_ONCE], trans[start:start + _AT_ONCE])
        corners += [bodies.min(axis=(0, 1)), bodies.max(axis=(0, 1))]
    return np.array(corners)


def write_points_usd(path: str | Path, mesh: Mesh, frames: Iterable[np.ndarray], count: int, rate: float = 30.0,
                     up: int = 2) -> None:
    """Write the exact body of every frame: a mesh whose points and normals have a value at each time code.

    Parameters
    ----------
    path : str or Path
        As for `write_skinned_usd`.
    mesh : Mesh
        Triangles and colours.
    frames : `count` arrays (N, 3) float, metres
    rate : float, frames a second
    up : int
        0, 1 or 2: the axis of the body that points up.
    """
    U = turn_up(up).T
    with _stage(path, count, rate) as stage:
        pxr = _library()
        root = pxr.UsdGeom.Xform.Define(stage, "/body")
        stage.SetDefaultPrim(root.GetPrim())
        shape = _mesh(stage, "/body/mesh", mesh.with_vertices(mesh.vertices @ U))
        for t, vertices in enumerate(frames):
            body = mesh.with_vertices(vertices @ U)
            shape.GetPointsAttr().Set(_vectors(body.vertices), t)
            shape.GetNormalsAttr().Set(_vectors(body.vertex_normals), t)
            shape.GetExtentAttr().Set(_extent(body.vertices), t)


def _library() -> Any:
    """The modules of usd-core."""
    try:
        import pxr
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, UsdUtils, Vt  # noqa: F401
    except ImportError:
        raise ModuleNotFoundError("USD files are written by usd-core: pip install 'scapekit[usd]'") from None
    return pxr


@contextlib.contextmanager
def _stage(path: str | Path, frames: int, rate: float) -> Iterator[Any]:
    """A new stage in metres, y up, one time code a frame; it takes its place when the block ends well."""
    pxr, path = _library(), Path(path)
    packed = path.suffix.lower() == ".usdz"
    with writing(path) as beside, tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / f"{path.stem}.usdc" if packed else beside
        stage = pxr.Usd.Stage.CreateNew(str(place))
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
        if frames:
            stage.SetTimeCodesPerSecond(rate)
            stage.SetFramesPerSecond(rate)
            stage.SetStartTimeCode(0)
            stage.SetEndTimeCode(frames - 1)
        yield stage
        stage.GetRootLayer().Save()
        if packed and not pxr.UsdUtils.CreateNewUsdzPackage(str(place), str(beside)):
            raise OSError(f"{path}: usd-core could not pack it")


def _mesh(stage: Any, place: str, mesh: Mesh) -> Any:
    pxr = _library()
    out = pxr.UsdGeom.Mesh.Define(stage, place)
    out.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)         # else the surface is rounded, and shrinks
    out.CreatePointsAttr(_vectors(mesh.vertices))
    out.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, dtype=np.int32)))
    out.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(mesh.faces.ravel().astype(np.int32)))
    out.CreateNormalsAttr(_vectors(mesh.vertex_normals))
    out.SetNormalsInterpolation(pxr.UsdGeom.Tokens.vertex)
    out.CreateExtentAttr(_extent(mesh.vertices))
    plain = skin_material()["pbrMetallicRoughness"]["baseColorFactor"]
    colors = np.array([plain[:3]]) if mesh.colors is None else as_light(mesh.colors)
    kind = pxr.UsdGeom.Tokens.constant if mesh.colors is None else pxr.UsdGeom.Tokens.vertex
    out.CreateDisplayColorPrimvar(kind).Set(_vectors(colors))
    return out


def _skeleton(stage: Any, rig: Rig) -> list[str]:
    """The joints at rest; their paths, as the other prims name them."""
    pxr, names = _library(), _identifiers(rig.skeleton.names)
    paths: list[str] = []
    for name, parent in zip(names, rig.skeleton.parents, strict=True):
        paths.append(name if parent < 0 else f"{paths[parent]}/{name}")
    skeleton = pxr.UsdSkel.Skeleton.Define(stage, "/body/skeleton")
    skeleton.CreateJointsAttr(paths)
    skeleton.CreateBindTransformsAttr(_matrices(rig.axes, rig.skeleton.joints))
    rest = rig.local_rotations(np.zeros((len(paths), 3)))
    skeleton.CreateRestTransformsAttr(_matrices(rest, rig.local_offsets))
    return paths


def _bound(mesh: Any, rig: Rig) -> None:
    """Hang the mesh on the skeleton."""
    pxr = _library()
    binding = pxr.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets(["/body/skeleton"])
    joints, weights = four_carriers(rig.weights)
    binding.CreateJointIndicesPrimvar(False, joints.shape[1]).Set(
        pxr.Vt.IntArray.FromNumpy(joints.ravel().astype(np.int32)))
    binding.CreateJointWeightsPrimvar(False, joints.shape[1]).Set(
        pxr.Vt.FloatArray.FromNumpy(weights.ravel().astype(np.float32)))


def _blend_shapes(stage: Any, mesh: Any, rig: Rig) -> list[str]:
    """The blend shapes of betas, then those of correctives; their names."""
    pxr = _library()
    names, targets = rig.beta_targets()
    if rig.correctives is not None:
        names = names + [f"corrective {k + 1}" for k in range(len(rig.correctives.shapes))]
        targets = np.concatenate([targets, rig.correctives.shapes])
    if not names:
        return []
    told = _identifiers(name.replace("+", "plus ").replace("-", "minus ") for name in names)
    for name, change in zip(told, targets, strict=True):
        shape = pxr.UsdSkel.BlendShape.Define(stage, f"/body/mesh/{name}")
        shape.CreateOffsetsAttr(_vectors(change))
        normals = rig.mesh.with_vertices(rig.mesh.vertices + change).vertex_normals - rig.mesh.vertex_normals
        shape.CreateNormalOffsetsAttr(_vectors(normals))
    binding = pxr.UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateBlendShapesAttr(told)
    binding.CreateBlendShapeTargetsRel().SetTargets([f"/body/mesh/{name}" for name in told])
    return told


def _motion(stage: Any, rig: Rig, joints: list[str], names: list[str], poses: np.ndarray, trans: np.ndarray) -> None:
    pxr = _library()
    motion = pxr.UsdSkel.Animation.Define(stage, "/body/motion")
    motion.CreateJointsAttr(joints)
    motion.CreateScalesAttr(pxr.Vt.Vec3hArray.FromNumpy(np.ones((len(joints), 3), dtype=np.float16)))
    turns, places = motion.CreateRotationsAttr(), motion.CreateTranslationsAttr()
    offsets = rig.local_offsets.copy()
    for t, q in enumerate(continuous_quaternions(rig.local_rotations(poses))):
        offsets[0] = rig.skeleton.joints[0] + trans[t]
        turns.Set(pxr.Vt.QuatfArray([pxr.Gf.Quatf(w, x, y, z) for x, y, z, w in q.tolist()]), t)
        places.Set(_vectors(offsets), t)
    if names:
        motion.CreateBlendShapesAttr(names)
        weights = motion.CreateBlendShapeWeightsAttr(pxr.Vt.FloatArray(len(names), 0.0))
        if rig.correctives is not None:
            for t, row in zip(rig.correctives.frames.tolist(), rig.correctives.weights, strict=True):
                full = np.r_[np.zeros(len(names) - len(row)), row].astype(np.float32)
                weights.Set(pxr.Vt.FloatArray.FromNumpy(full), t)
    binding = pxr.UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/body/skeleton"))
    binding.CreateAnimationSourceRel().SetTargets(["/body/motion"])


def _vectors(values: np.ndarray) -> Any:
    return _library().Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


def _extent(points: np.ndarray) -> Any:
    return _vectors(np.stack([points.min(axis=0), points.max(axis=0)]))


def _matrices(R: np.ndarray, places: np.ndarray) -> Any:
    """Rotations (J, 3, 3) and places (J, 3) as USD has them: of rows, `p @ M`."""
    M = np.tile(np.eye(4), (len(R), 1, 1))
    M[:, :3, :3], M[:, 3, :3] = np.swapaxes(R, 1, 2), places
    return _library().Vt.Matrix4dArray.FromNumpy(M)


def _identifiers(names: Iterable[str]) -> list[str]:
    """Names as USD allows them: letters, digits and _, which differ."""
    found: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)
        plain = plain if re.match("[A-Za-z_]", plain) else f"_{plain}"
        while plain in found:
            plain += "_"
        found.append(plain)
    return found
