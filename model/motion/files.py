"""Motion files (`.npz`), ours and those of AMASS: the one place that reads them."""
from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.storage import StorageError
from scanprep.ranges import BETAS, TINY, TURNS, Range

from ..body import BodyModel

OURS = ("scape", "blendscape", "skinning")           # what files of our models say they are made for
FAMILY = ("smpl", "star", "supr")                    # how the names of the models begin whose motions AMASS holds
JOINTS = (22, 24, 52, 55)                            # joints of these models: the body, with hands, fingers, face
RATES = ("mocap_frame_rate", "mocap_framerate")
_PIECES = ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")   # of poses, in their order
_TEXTS = ("gender", "surface_model_type")            # of which some files hold objects; then they are left out


@dataclass(frozen=True, eq=False)
class StoredMotion:
    """A motion as its file has it."""

    poses: np.ndarray                # (T, J, 3) radians
    trans: np.ndarray                # (T, 3) metres
    betas: np.ndarray | None         # (K,), None where there are none
    rate: float                      # frames a second
    gender: str
    made_for: str                    # the kind of model, "" where the file does not say
    more: dict[str, np.ndarray]      # further arrays that were asked for

    @property
    def of_family(self) -> bool:
        """Whether it is a motion of the SMPL family, as AMASS has them."""
        return self.made_for.lower().startswith(FAMILY) or (not self.made_for and self.poses.shape[1] in JOINTS)


def is_motion(path: Path) -> bool:
    """Whether an `.npz` file holds a motion."""
    names = storage.names_in(path, "a motion (.npz)")
    return "poses" in names or {"root_orient", "pose_body"} <= set(names)


def read_motion_file(path: str | Path, more: Collection[str] = (), parts: int | None = None) -> StoredMotion:
    """A motion file: `poses` or `root_orient` and `pose_body`, `trans`, `mocap_frame_rate`, and `betas` if it has some.

    `more` are further arrays to read, `parts` how many a model has, for the words of errors.

    Raises
    ------
    StorageError
        Missing, damaged, not finite, or no motion: which array, what was expected, what came.
    """
    path = Path(path)
    if path.suffix.lower() == ".bvh":
        raise StorageError(f"{path}: expected a motion (.npz), found BVH; scape animate {path.name} -m MODEL -o OUT "
                           "puts it on a model")
    what, wanted = "a motion (.npz)", ("poses", "trans", "betas", *RATES, *_PIECES, *more)
    a = storage.load_arrays(path, what, wanted)
    for name in _TEXTS:
        try:
            a |= storage.load_arrays(path, what, (name,))
        except StorageError:
            continue
    if "poses" not in a and {"root_orient", "pose_body"} <= set(a):
        with storage.taking_apart(path, "a whole motion"):
            a["poses"] = np.concatenate([a[name].reshape(len(a["trans"]), -1) for name in _PIECES if name in a], axis=1)
    lacking = [name for name in ("poses", "trans") if name not in a]
    if lacking:
        raise StorageError(f"{path}: expected a motion, it lacks {' and '.join(lacking)}")
    with storage.taking_apart(path, "a whole motion"):
        return _restored(path, a, more, parts)


def _restored(path: Path, a: dict[str, np.ndarray], more: Collection[str], parts: int | None) -> StoredMotion:
    made_for = storage.text(a, "surface_model_type", "")
    if not made_for.lower().startswith((*OURS, *FAMILY)) and made_for:
        raise StorageError(f"{path}: expected surface_model_type '{OURS[0]}', found '{made_for}'")
    rate = next((a[name] for name in RATES if name in a), None)
    if rate is None:
        raise StorageError(f"{path}: expected {' or '.join(RATES)}, the frames a second; it has neither")
    if not np.size(rate) == 1:
        raise ValueError(f"{RATES[0]}: expected one number, found shape {np.shape(rate)}")
    Range(TINY).check(float(rate.item()), RATES[0])
    T, shape = len(np.atleast_1d(a["poses"])), a["poses"].shape[1:]
    poses = storage.numbers(a, "poses", T, *shape)
    if not T or poses[0].size % 3 or not poses[0].size:
        whose = "parts" if parts is None else f"the model's {parts} parts"
        raise StorageError(f"{path}: expected frames of {whose}, three numbers each, found shape {poses.shape}")
    poses = poses.astype(np.float64).reshape(T, -1, 3)
    betas = a.get("betas", np.zeros(0))
    betas = betas[0] if betas.shape[:-1] == (1,) else betas                        # some files have them as a row
    betas = storage.numbers({"betas": betas}, "betas", None).astype(np.float64)
    BETAS.check(betas, "betas")
    TURNS.check(poses, "poses")
    return StoredMotion(poses, storage.numbers(a, "trans", T, 3).astype(np.float64), betas if betas.size else None,
                        float(rate.item()), storage.text(a, "gender", "neutral"),
                        made_for, {name: a[name] for name in more if name in a})


def check_ours(path: str | Path, stored: StoredMotion, where: str = "") -> None:
    """StorageError for a motion of models of another kind."""
    if stored.made_for not in (*OURS, ""):
        raise StorageError(f"{path}: expected surface_model_type '{OURS[0]}', found '{stored.made_for}'{where}")


def betas_for(path: str | Path, betas: np.ndarray | None, model: BodyModel) -> np.ndarray | None:
    """Betas that a model has: trailing zeros say nothing; StorageError where there are others."""
    if betas is None or len(betas) <= model.n_betas:
        return betas
    used = int(np.flatnonzero(betas).max(initial=-1)) + 1
    if used > model.n_betas:
        raise StorageError(f"{path}: expected at most the {model.n_betas} betas of the model, found {used}")
    return betas[:model.n_betas] if model.n_betas else None
