"""A kind of body model in thirty lines: what a new one must say, and no more."""
from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from model.body import BodyModel
from model.features import linear_features
from model.linear import combination_weights
from model.products import ShapedProducts, Terms
from scanprep.geometry import storage
from scanprep.geometry.carrier import mount
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

TABLE = {"toy": ("toy_kind", "ToyModel")}                # its line of `model.files.KINDS`


@dataclass(frozen=True, eq=False, repr=False)
class ToyModel(BodyModel):
    """Skinned by fixed weights (N, J); three betas make it longer, wider and thicker by a twentieth each."""

    template: Mesh
    skeleton: Skeleton
    weights: np.ndarray
    pose_mean: np.ndarray
    pose_covariance: np.ndarray
    info: dict[str, Any] = field(default_factory=dict)
    pose_examples: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))

    kind, n_betas, explained = "toy", 3, np.arange(1, 4) / 3

    @property
    def features(self):
        return linear_features(self.skeleton, [np.zeros((3, 0))] * len(self.skeleton.parents))

    def points(self, vertex_ids, weights=None, n_betas=None):
        x, J = self.template.vertices - self.skeleton.joints[0], len(self.skeleton.parents)
        own, *longer = (self._carried(x * scale) for scale in (np.ones(3), *0.05 * np.eye(3)))
        whole = ShapedProducts(Terms(self.features, np.arange(J), self.features.starts), own, own, np.array(longer),
                               self.skeleton.joints[0])
        return whole.first(n_betas).combine(combination_weights(len(x), vertex_ids, weights))

    def _carried(self, x):
        """(J, 3, N) what each part carries of vertices (N, 3), about joints that follow them, the root's in place."""
        joints, below = self.joint_regressor @ x, (self.weights @ self.skeleton.descends).T[..., None]
        T = self.weights.T[..., None] * x - below * joints[:, None]
        np.add.at(T, self.skeleton.parents[1:], below[1:] * joints[1:, None])
        ring, share = self.skeleton.joint_weights(self.template, 0)
        return np.swapaxes(T - np.einsum("n,jnd->jd", share, T[:, ring])[:, None], 1, 2)

    def resample(self, template, skeleton, rounds, progress):
        weights = np.maximum(mount(self.template, template).values(self.weights), 0)
        return replace(self, template=template, skeleton=skeleton, weights=weights / weights.sum(axis=1)[:, None])

    def arrays(self):
        return {"weights": self.weights}

    @classmethod
    def restore(cls, parts, features, header, arrays):
        return cls(weights=storage.numbers(arrays, "weights", None, None), **parts)
