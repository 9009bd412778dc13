"""A motion: one pose and place per frame, and its file."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from model.linear import Subject, check_subject
from model.motion.files import check_ours, read_motion_file
from model.motion.onto import BodyMotion
from scanprep.geometry import storage

Progress = Callable[[int, int], None]            # called with (done, total)


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of one body over time.

    Parameters
    ----------
    poses : (T, J, 3) float, radians
        Axis-angle of every part relative to its parent.
    trans : (T, 3) float, metres
        Place of the root.
    betas : (K,) float, standard deviations, or None
        Shape coefficients; None for the template's own body.
    rate : float, frames per second
        Frame rate.
    residuals : (T, L) float, metres
        Distance of each marker from where the body puts it, NaN where it was not seen; L may be 0.
    labels : tuple of str
        Names of the L markers.
    gender : str
        As body-model files name it: "male", "female" or "neutral".
    converged : (T,) bool
        Frames whose solution converged; all of them for a motion read from a file.
    trusted : (T, L) bool
        Markers that were seen and used under their own label; by default all that were seen.

    Raises
    ------
    ValueError
        Arrays whose shapes do not match.

    Examples
    --------
    >>> import numpy as np
    >>> from completion import Motion
    >>> still = Motion(np.zeros((60, 16, 3)), np.zeros((60, 3)), None, 30.0, np.zeros((60, 0)))
    >>> still, round(float(still.times[-1]), 2)
    (Motion(60 frames at 30/s, 16 parts), 1.97)
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
        # defaults that depend on the other arrays
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
        """(T,) float, seconds from the first frame."""
        return np.arange(len(self.poses)) / self.rate

    @property
    def distrusted(self) -> tuple[str, ...]:
        """Markers that were seen, but trusted in less than a tenth of these frames."""
        seen = np.isfinite(self.residuals)
        rarely_trusted = (self.trusted & seen).sum(axis=0) < 0.1 * seen.sum(axis=0)
        return tuple(label for label, rare in zip(self.labels, rarely_trusted, strict=True) if rare)

    def residuals_of_trusted(self) -> np.ndarray:
        """Return the residuals of the markers that are not `distrusted`.

        Returns
        -------
        (T, L) float, metres
            NaN for distrusted markers.
        """
        return np.where(np.isin(self.labels, self.distrusted), np.nan, self.residuals)

    def vertices(self, subject: Subject, frames: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Compute the meshes of some frames.

        Parameters
        ----------
        subject : Subject
            The body that moves.
        frames : (n,) int or slice
            Which frames; by default all.

        Returns
        -------
        (n, N, 3) float, metres
        """
        return check_subject(subject).vertices(self.poses[frames], self.trans[frames])

    def save(self, path: str | Path, **more: np.ndarray) -> None:
        """Write an `.npz` with the array names of body-model files, poses as (T, 3J).

        Parameters
        ----------
        path : str or Path
            File to write.
        **more : np.ndarray
            Further arrays for the file.
        """
        arrays = {
            "poses": self.poses.reshape(len(self.poses), -1), "trans": self.trans,
            "betas": np.zeros(0) if self.betas is None else self.betas,
            "gender": np.array(self.gender), "mocap_frame_rate": np.array(float(self.rate)),
            "surface_model_type": np.array("scape"), "marker_residuals": self.residuals,
            "marker_labels": np.array(self.labels, dtype=str), "converged": self.converged,
            "marker_trusted": self.trusted, **more}
        storage.save_arrays(path, arrays)

    @staticmethod
    def of(motion: BodyMotion) -> Motion:
        """Make a motion that does not come from markers.

        Parameters
        ----------
        motion : BodyMotion
            Poses, places and shape.

        Returns
        -------
        Motion
            Without markers.
        """
        no_markers = np.zeros((len(motion.poses), 0))
        return Motion(motion.poses, motion.trans, motion.betas, motion.rate, no_markers, gender=motion.gender,
                      trusted=no_markers.astype(bool))

    @staticmethod
    def load(path: str | Path, rate: float | None = None) -> Motion:
        """Read a file of `save`, or a body-model motion file of the same kind from elsewhere.

        Parameters
        ----------
        path : str or Path
            File to read.
        rate : float, frames per second, optional
            Where the file does not say, or says it wrongly.

        Returns
        -------
        Motion

        Raises
        ------
        ValueError
            The file holds another kind of motion, or is damaged.
        """
        # arrays that only scapekit writes; files from elsewhere lack them
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
