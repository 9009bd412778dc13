"""The synthetic data set: scans of one subject in many poses and of many subjects, with ground truth."""
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
from .scanner import Scan, ScannerConfig, scan

VERSION = 2                          # version 1 had other people, whose betas mean nothing here


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """What really stood in the scanner; for evaluation only, no stage uses it."""

    shape: BodyShape
    pose: np.ndarray  # (16, 3) float, radians
    trans: np.ndarray  # (3,) float, metres
    vertices: np.ndarray  # (N, 3) float, metres: in the topology shared by all people
    faces: np.ndarray  # (F, 3) int
    part_of_face: np.ndarray  # (F,) int
    joints: np.ndarray  # (16, 3) float, metres: in this pose

    @property
    def mesh(self) -> Mesh:
        """Return the true surface."""
        return Mesh(self.vertices, self.faces)

    def save(self, path: str | Path) -> None:
        """Write the truth as .npz."""
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
    """Put a person into a pose with the lowest point on the floor, z = 0."""
    vertices = person.in_pose(pose)
    trans = np.array([0.0, 0.0, -vertices[:, 2].min()])
    return GroundTruth(person.shape, np.asarray(pose, dtype=np.float64), trans, vertices + trans, person.mesh.faces,
                       person.part_of_face, person.joints_in_pose(pose, trans))


def click_landmarks(truth: GroundTruth, rng: np.random.Generator, error: float = 0.003,
                    seen: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Simulate landmarks clicked by a person, each coordinate off by a normal error of `error` metres.

    Landmarks without a point of the scan, `seen` (n, 3), within 12 mm are left out.
    """
    names = landmark_vertices()
    points = {name: truth.vertices[v] for name, v in names.items()}
    # noise for all landmarks in a fixed order, so that it does not depend on which are seen
    noise = {name: error * rng.normal(size=3) for name in names}
    if seen is not None:
        distances, _ = cKDTree(seen).query(np.stack(list(points.values())))
        points = {name: point for (name, point), d in zip(points.items(), distances, strict=True) if d < 0.012}
    return {name: point + noise[name] for name, point in points.items()}


def write_scan(folder: str | Path, name: str, scanned: Scan, truth: GroundTruth | None = None,
               landmarks: dict[str, np.ndarray] | None = None) -> Path:
    """Write a scan: `name.ply` with the triangles of all views, and beside it what is known of it.

    Landmarks go to `name.landmarks.json`, the truth to `truth/name.npz`. The PLY is written last: if it exists, the
    rest does too.
    """
    from ..geometry.files import write_mesh

    folder = Path(folder)
    if truth is not None:
        truth.save(folder / "truth" / f"{name}.npz")
    if landmarks is not None:
        storage.write_json(folder / f"{name}.landmarks.json",
                           {key: np.round(point, 6).tolist() for key, point in landmarks.items()})
    path = folder / f"{name}.ply"
    with storage.writing(path) as beside:
        write_mesh(beside, scanned.merged)
    return path


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
        """Return the file of the mesh of all views."""
        return self.folder / f"{self.name}.ply"

    @property
    def landmarks(self) -> Path:
        """Return the file of the landmarks."""
        return self.folder / f"{self.name}.landmarks.json"

    @property
    def truth(self) -> Path:
        """Return the file of the ground truth."""
        return self.folder / "truth" / f"{self.name}.npz"


WRIST, ANKLE = 0.6, 0.4                # radians: largest deviation of hands and feet from a named pose
# the subject in many poses: a man a little taller and lighter than the average
SUBJECT = BodyShape.like("male", stature=1.78, weight=-0.5)


def scan_plan(subject_poses: int, subjects: int) -> list[tuple[int, bool]]:
    """List the scans of a data set: number, and whether it is of the one subject."""
    return [(k, True) for k in range(subject_poses)] + [(k, False) for k in range(subjects)]


@lru_cache(maxsize=1)
def _person(shape: BodyShape) -> SyntheticPerson:
    """Return the person of a shape; the last one is kept, as building it takes long."""
    return SyntheticPerson(shape)


def synthetic_scan(folder: Path, seed: int, k: int, is_pose: bool, config: ScannerConfig, click_error: float = 0.003
                  ) -> SyntheticScan:
    """Make one scan of `scan_plan`, unless its files exist."""
    # a generator per scan: results do not depend on the order or on the number of scans
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
    """Return the k-th pose (16, 3) of the subject: rest, named poses, then random ones, each slightly varied."""
    if k == 0:
        return "rest", np.zeros((16, 3))
    order = [name for name in NAMED_POSES if name != "rest"]
    step = 11                                     # mixes kinds, which follow each other in the list
    if k <= len(order):
        name = order[(k * step) % len(order)]
        loose = 0.08 * rng.normal(size=(16, 3))
        # pelvis, forearms and shins vary less: elbows and knees are hinges
        loose[[0, 5, 8, 11, 14]] *= 0.3
        # hands and feet vary more, or the skeleton could not be found there
        loose[[6, 9]] = np.clip(4.5 * loose[[6, 9]], -WRIST, WRIST)
        loose[[12, 15]] = np.clip(3.0 * loose[[12, 15]], -ANKLE, ANKLE)
        pose = find_pose(name) + loose
        return name, mirror_synthetic_pose(pose) if rng.random() < 0.4 else pose
    return f"random{k}", random_pose(rng)


def near_rest(rng: np.random.Generator) -> np.ndarray:
    """Return a pose (16, 3) near rest, like people who are asked to stand still."""
    loose = 0.05 * rng.normal(size=(16, 3))
    loose[0] *= 0.3
    # elbows and knees only bend in their natural direction
    loose[[5, 8]] = np.abs(loose[[5, 8]]) * [[-1, 0, -1], [-1, 0, 1]]
    loose[[11, 14]] = np.abs(loose[[11, 14]]) * [1, 0, 0]
    return loose
