"""A motion: one pose and place a frame, and the file it lives in."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from model.linear import Subject
from model.motion.files import check_ours, read_motion_file
from model.motion.onto import BodyMotion
from scanprep.geometry import storage

Progress = Callable[[int, int], None]            # called with (done, total)


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of one body over time.

    Attributes
    ----------
    poses : (T, J, 3) float, radians
    trans : (T, 3) float, metres
    betas : (K,) float, or None for the template's own body
    rate : float, frames per second
    residuals : (T, L) float, metres
        Distance of each marker from where the body puts it, NaN where it was not seen; L may be 0.
    labels : L strings
        The markers.
    gender : str
        As body-model files name it: "male", "female" or "neutral".
    converged : (T,) bool
        Frames whose solution settled; all true for a motion that was read from a file.
    trusted : (T, L) bool
        Markers that were seen and believed under their own label; when not given, all that were seen.
    """

    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray | None
    rate: float
    residuals: np.ndarray
    labels: tuple[str, ...] = ()
    gender: str = "neutral"
    converged: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    trusted: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))

    def __post_init__(self) -> None:
        T = len(self.poses)
        if self.poses.ndim != 3 or self.poses.shape[2] != 3 or self.trans.shape != (T, 3):
            raise ValueError(f"poses, trans: expected (T, J, 3) and (T, 3), got {self.poses.shape} "
                             f"and {self.trans.shape}")
        if self.residuals.shape != (T, len(self.labels)):
            raise ValueError(f"residuals: expected shape {(T, len(self.labels))}, got {self.residuals.shape}")
        if not len(self.converged):
            object.__setattr__(self, "converged", np.ones(T, dtype=bool))
        if not self.trusted.size:
            object.__setattr__(self, "trusted", np.isfinite(self.residuals))
        if self.trusted.shape != self.residuals.shape:
            raise ValueError(f"trusted: expected shape {self.residuals.shape}, got {self.trusted.shape}")

    def __repr__(self) -> str:
        return f"Motion({len(self.poses)} frames at {self.rate:g}/s, {self.poses.shape[1]} parts)"

    @property
    def times(self) -> np.ndarray:
        """(T,) seconds from the first frame."""
        return np.arange(len(self.poses)) / self.rate

    @property
    def distrusted(self) -> tuple[str, ...]:
        """Markers that were seen, but believed in less than a tenth of those frames."""
        seen = np.isfinite(self.residuals)
        few = (self.trusted & seen).sum(axis=0) < 0.1 * seen.sum(axis=0)
        return tuple(label for label, is_few in zip(self.labels, few, strict=True) if is_few)

    def residuals_of_trusted(self) -> np.ndarray:
        """The residuals (T, L) of the markers that tell of the body, metres, NaN for those that are `distrusted`."""
        return np.where(np.isin(self.labels, self.distrusted), np.nan, self.residuals)

    def vertices(self, subject: Subject, frames: np.ndarray | slice = slice(None)) -> np.ndarray:
        """The meshes (n, N, 3) of some frames, metres."""
        return subject.vertices(self.poses[frames], self.trans[frames])

    def save(self, path: str | Path, **more: np.ndarray) -> None:
        """Write an `.npz` with the array names that body-model files use, poses as (T, 3J), and more arrays."""
        arrays = {
            "poses": self.poses.reshape(len(self.poses), -1), "trans": self.trans,
            "betas": np.zeros(0) if self.betas is None else self.betas,
            "gender": np.array(self.gender), "mocap_frame_rate": np.array(float(self.rate)),
            "surface_model_type": np.array("scape"), "marker_residuals": self.residuals,
            "marker_labels": np.array(self.labels, dtype=str), "converged": self.converged,
            "marker_trusted": self.trusted, **more}
        storage.save_arrays(path, arrays)

    @staticmethod
    def of(found: BodyMotion) -> Motion:
        """A motion that came from no markers."""
        none = np.zeros((len(found.poses), 0))
        return Motion(found.poses, found.trans, found.betas, found.rate, none, gender=found.gender,
                      trusted=none.astype(bool))

    @staticmethod
    def load(path: str | Path, rate: float | None = None) -> Motion:
        """Read a file of `save`, or a body-model motion file of the same kind from elsewhere.

        `rate` is frames a second, where the file does not say or says it wrongly.
        """
        # what else our files hold
        stored = read_motion_file(path, ("marker_residuals", "marker_labels", "converged", "marker_trusted"), rate=rate)
        check_ours(path, stored, f"; scape animate {Path(path).name} -m MODEL -o OUT puts it on a model")
        with storage.taking_apart(path, "a whole motion"):
            a, T = stored.more, len(stored.poses)
            labels = tuple(str(label) for label in a.get("marker_labels", ()))
            residuals = (storage.numbers(a, "marker_residuals", T, len(labels), finite=False)
                         if "marker_residuals" in a else np.full((T, len(labels)), np.nan))
            converged = storage.numbers(a, "converged", T, kinds="b") if "converged" in a else np.ones(T)
            return Motion(stored.poses, stored.trans, stored.betas, stored.rate, residuals, labels, stored.gender,
                          converged.astype(bool), a.get("marker_trusted", np.zeros((0, 0))).astype(bool))
