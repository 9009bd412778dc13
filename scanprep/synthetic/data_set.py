"""The synthetic data set: scans of one subject in many poses and of many subjects, truth kept beside them."""
from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import storage
from ..geometry.mesh import Mesh
from .landmarks import landmarks as landmark_vertices
from .people import NAMED_POSES, BodyShape, SyntheticPerson, find_pose, mirror_synthetic_pose, random_pose
from .scanner import RangeView, Scan, ScannerConfig, scan

VERSION = 2                          # 1 was of people who were made up; their shapes mean nothing here


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """What really stood in the scanner; for evaluation, used by no stage."""

    shape: BodyShape
    pose: np.ndarray  # (16, 3) float, radians
    trans: np.ndarray  # (3,) float, metres
    vertices: np.ndarray  # (N, 3) float, metres: on the topology shared by all people
    faces: np.ndarray  # (F, 3) int
    part_of_face: np.ndarray  # (F,) int
    joints: np.ndarray  # (16, 3) float, metres: in the pose

    @property
    def mesh(self) -> Mesh:
        """The true surface."""
        return Mesh(self.vertices, self.faces)

    def save(self, path: str | Path) -> None:
        """Write as .npz."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "shape"}
        shape = {f.name: getattr(self.shape, f.name) for f in fields(self.shape)}
        storage.save(path, "ground truth", VERSION, arrays, {"shape": shape})

    @staticmethod
    def load(path: str | Path) -> GroundTruth:
        """Read a file of `save`."""
        header, a = storage.load(path, "ground truth", (VERSION,))
        with storage.taking_apart(path, "a whole ground truth"):
            J = len(a["joints"])
            mesh = Mesh(storage.numbers(a, "vertices", None, 3), storage.numbers(a, "faces", None, 3))
            part = storage.numbers(a, "part_of_face", len(mesh.faces))
            if not np.isin(part, np.arange(J)).all():
                raise ValueError(f"part_of_face: expected parts 0..{J - 1}")
            return GroundTruth(BodyShape(**header["shape"]), storage.numbers(a, "pose", J, 3),
                               storage.numbers(a, "trans", 3), a["vertices"], a["faces"], part,
                               storage.numbers(a, "joints", J, 3))


def stand(person: SyntheticPerson, pose: np.ndarray) -> GroundTruth:
    """A person in a pose with the lowest point on the floor, z = 0."""
    vertices = person.in_pose(pose)
    trans = np.array([0.0, 0.0, -vertices[:, 2].min()])
    return GroundTruth(person.shape, np.asarray(pose, dtype=np.float64), trans, vertices + trans, person.mesh.faces,
                       person.part_of_face, person.joints_in_pose(pose, trans))


def click_landmarks(truth: GroundTruth, rng: np.random.Generator, error: float = 0.003,
                    seen: np.ndarray | None = None, reach: float = 0.012) -> dict[str, np.ndarray]:
    """Landmarks as a person would click them on the scan, each coordinate off by `error`, metres.

    Those without a point of the scan, `seen` (n, 3), within `reach` are left out.
    """
    names = landmark_vertices()
    true = {name: truth.vertices[v] for name, v in names.items()}
    noise = {name: error * rng.normal(size=3) for name in names}
    if seen is not None:
        distances, _ = cKDTree(seen).query(np.stack(list(true.values())))
        true = {name: point for (name, point), d in zip(true.items(), distances, strict=True) if d < reach}
    return {name: point + noise[name] for name, point in true.items()}


def write_scan(folder: str | Path, name: str, scanned: Scan, truth: GroundTruth | None = None,
               landmarks: dict[str, np.ndarray] | None = None, views: bool = True) -> Path:
    """Store a scan: `name.ply` with all views' triangles, and beside it what is known.

    Landmarks go to `name.landmarks.json`, the views to `views/name.npz`, the truth to `truth/name.npz`. The
    PLY is written last, so where it is, the rest is too.
    """
    from ..geometry.files import write_mesh

    folder = Path(folder)
    if truth is not None:
        truth.save(folder / "truth" / f"{name}.npz")
    if views:
        _write_views(folder / "views" / f"{name}.npz", scanned)
    if landmarks is not None:
        storage.write_json(folder / f"{name}.landmarks.json",
                           {key: np.round(point, 6).tolist() for key, point in landmarks.items()})
    path = folder / f"{name}.ply"
    with storage.writing(path) as beside:
        write_mesh(beside, scanned.merged)
    return path


def _write_views(path: Path, scanned: Scan) -> None:
    arrays = {}
    for k, view in enumerate(scanned.views):
        arrays.update({f"points{k}": view.points, f"faces{k}": view.mesh.faces, f"normals{k}": view.normals,
                       f"T_world_camera{k}": view.T_world_camera, f"depth{k}": view.depth,
                       f"intrinsics{k}": view.intrinsics})
    storage.save(path, "range views", VERSION, arrays, {"views": len(scanned.views)})


def read_views(path: str | Path) -> list[RangeView]:
    """The views of one scan, from `views/name.npz`."""
    header, a = storage.load(path, "range views", (VERSION,))
    with storage.taking_apart(path, "whole range views"):
        return [_view(a, k) for k in range(header["views"])]


def _view(a: dict[str, np.ndarray], k: int) -> RangeView:
    mesh = Mesh(storage.numbers(a, f"points{k}", None, 3), storage.numbers(a, f"faces{k}", None, 3))
    T = storage.numbers(a, f"T_world_camera{k}", 4, 4)
    return RangeView(mesh, storage.numbers(a, f"normals{k}", len(mesh.vertices), 3), T[:3, 3], T,
                     storage.numbers(a, f"depth{k}", None, None, finite=False),
                     storage.numbers(a, f"intrinsics{k}", 3, 3))


@dataclass(frozen=True)
class SyntheticScan:
    """One scan of the synthetic data set."""

    name: str  # file name without ending
    subject: str  # "subject" for the one in many poses, else "person00", ...
    pose: str  # name of the pose
    sex: str  # "male" or "female"
    folder: Path  # where its files are

    @property
    def path(self) -> Path:
        """The mesh of all views."""
        return self.folder / f"{self.name}.ply"

    @property
    def landmarks(self) -> Path:
        return self.folder / f"{self.name}.landmarks.json"

    @property
    def views(self) -> Path:
        return self.folder / "views" / f"{self.name}.npz"

    @property
    def truth(self) -> Path:
        return self.folder / "truth" / f"{self.name}.npz"


WRIST, ANKLE = 0.6, 0.4                # radians by which hands and feet are held other than in named poses, at most
SUBJECT = BodyShape.like("male", stature=1.78, weight=-0.5)


def scan_plan(subject_poses: int, subjects: int) -> list[tuple[int, bool]]:
    """The scans of a data set: the number of each, and whether it is of the one subject."""
    return [(k, True) for k in range(subject_poses)] + [(k, False) for k in range(subjects)]


@lru_cache(maxsize=1)
def _person(shape: BodyShape) -> SyntheticPerson:
    return SyntheticPerson(shape)


def synthetic_scan(folder: Path, seed: int, k: int, is_pose: bool, config: ScannerConfig, click_error: float = 0.003
                  ) -> SyntheticScan:
    """One scan of `scan_plan`, made unless its files are there."""
    rng = np.random.default_rng([seed, int(is_pose), k])
    if is_pose:
        label, pose = subject_pose(k, rng)
        shape, subject, name = SUBJECT, "subject", f"subject_{k:02d}_{label}"
    else:
        shape = BodyShape.random(rng, sex="female" if k % 2 == 0 else "male")
        pose, label, subject = near_rest(rng), "rest", f"person{k:02d}"
        name = f"person_{k:02d}_{'female' if k % 2 == 0 else 'male'}"
    entry = SyntheticScan(name, subject, label, shape.sex, folder)
    if not entry.path.exists():
        truth = stand(_person(shape), pose)
        scanned = scan(truth.mesh, config, rng)
        write_scan(folder, name, scanned, truth, click_landmarks(truth, rng, click_error, scanned.merged.vertices))
    return entry


def subject_pose(k: int, rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """The k-th pose (16, 3) of the subject: rest, then the named poses, then random ones, each a little loosened."""
    if k == 0:
        return "rest", np.zeros((16, 3))
    order = [name for name in NAMED_POSES if name != "rest"]
    step = 11                                     # spreads kinds of pose evenly over a short list
    if k <= len(order):
        name = order[(k * step) % len(order)]
        loose = 0.08 * rng.normal(size=(16, 3))
        loose[[0, 5, 8, 11, 14]] *= 0.3
        # hands and feet held in all ways, or none could tell where they begin
        loose[[6, 9]] = np.clip(4.5 * loose[[6, 9]], -WRIST, WRIST)
        loose[[12, 15]] = np.clip(3.0 * loose[[12, 15]], -ANKLE, ANKLE)
        pose = find_pose(name) + loose
        return name, mirror_synthetic_pose(pose) if rng.random() < 0.4 else pose
    return f"random{k}", random_pose(rng)


def near_rest(rng: np.random.Generator) -> np.ndarray:
    """A pose (16, 3) near rest, as people who are asked to stand still take it."""
    loose = 0.05 * rng.normal(size=(16, 3))
    loose[0] *= 0.3
    loose[[5, 8]] = np.abs(loose[[5, 8]]) * [[-1, 0, -1], [-1, 0, 1]]
    loose[[11, 14]] = np.abs(loose[[11, 14]]) * [1, 0, 0]
    return loose
