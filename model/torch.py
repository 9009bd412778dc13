"""Body models as PyTorch layers: for networks and optimisers that need gradients through the body.

The layer computes what `model.vertices` does, from the same tables: every kind of model is a sum of products of betas,
pose features and rotations. Nothing else in the package imports this file or PyTorch.

A SCAPE body is computed part by part, as in `model.condensed`. Inside part p, before the parts are joined,

    U_p = R_p Σ_ak δ_a β_k T_pak,    k = 0 for the mean person, whose β is 1

is one matrix product for a batch of bodies, `(B, n (1 + K)) @ (n (1 + K), 3 rows)`, whether or not they share betas.

[SCAPE] Eq. 6, Eq. 9
"""
from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor, nn

from scanprep.geometry import storage

from .bilinear import ShapedPoints
from .blended import Blended, ShapedBlended
from .body import BodyModel
from .condensed import Condensed, ShapedCondensed, slices
from .features import PoseFeatures
from .linear import PointOperator, Subject
from .products import Products, ShapedProducts, Terms


def rotation_matrices(twist: Tensor) -> Tensor:
    """Compute rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians, with finite gradients at 0 and π.

    Examples
    --------
    >>> (rotation_matrices(torch.tensor([0.0, 0.0, torch.pi / 2])).round() + 0.0).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    square = (twist * twist).sum(-1)[..., None, None]
    sine, half = _sine_ratio(square), _sine_ratio(square / 4)
    # Rodrigues' formula: I + sin θ / θ K + (1 - cos θ) / θ² K², with 1 - cos θ = 2 sin²(θ / 2)
    x, y, z = twist.unbind(-1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.eye(3, dtype=twist.dtype, device=twist.device) + sine * K + half * half / 2 * (K @ K)


def _sine_ratio(square: Tensor) -> Tensor:
    """Compute sin θ / θ from θ²."""
    # below 1e-3 square radians the series is exact to 1e-12, and has gradients at 0
    small = square < 1e-3
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    series = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
    return torch.where(small, series, angle.sin() / angle)


def wrap_twists(pose: Tensor) -> Tensor:
    """Compute twists (..., 3), at most π long, of rotation vectors (..., 3) of any length, radians.

    [SCAPE] §4.2
    """
    # beyond π, whole turns are taken off the angle; the axis stays, or is reversed
    square = (pose * pose).sum(-1, keepdim=True)
    far = square > math.pi**2
    angle = torch.where(far, square, torch.ones_like(square)).sqrt()
    turns = torch.round(angle.detach() / (2 * math.pi)) * (2 * math.pi)
    return torch.where(far, (1 - turns / angle) * pose, pose)


def _quadratic(t: Tensor) -> Tensor:
    x, y, z = t.unbind(-1)
    return torch.cat([t, torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], -1)], -1)


def _rotation(t: Tensor) -> Tensor:
    return (rotation_matrices(t) - torch.eye(3, dtype=t.dtype, device=t.device)).flatten(-2)


def _quaternion(t: Tensor) -> Tensor:
    square = (t * t).sum(-1, keepdim=True)
    # cos(θ / 2) - 1 = -2 sin²(θ / 4)
    return torch.cat([_sine_ratio(square / 4) / 2 * t, -square / 8 * _sine_ratio(square / 16)**2], -1)


LIFTS: dict[str, Callable[[Tensor], Tensor]] = {
    "linear": lambda t: t, "quadratic": _quadratic, "rotation": _rotation, "quaternion": _quaternion}


class _Points(nn.Module):
    """Base of the layers that compute points (B, L, 3), metres; the template's own and the mean body have own buffers.
    """

    n_betas: int

    def keep(self, name: str, value: np.ndarray) -> None:
        """Register an array as a buffer: numbers in the layer's type, or indices."""
        self.register_buffer(name, torch.from_numpy(np.array(value)))

    def forward(self, R: Tensor, features: Tensor, lifted: Tensor, betas: Tensor | None) -> Tensor:
        """Compute the points at trans zero for part rotations (B, J, 3, 3), features (B, A), lifted twists."""
        raise NotImplementedError


class _CondensedPoints(_Points):
    """A whole SCAPE body; see `model.condensed`."""

    def __init__(self, points: ShapedCondensed | Condensed) -> None:
        super().__init__()
        shaped = points if isinstance(points, ShapedCondensed) else None
        own = points.own if isinstance(points, ShapedCondensed) else points
        mean, system, terms = own if shaped is None else shaped.mean, own.system, own.terms
        self.n_betas, self.n_parts = 0 if shaped is None else shaped.n_betas, len(system.parts)
        n = len(system.border)

        # the products of a part come in blocks of one rotation each; a block has all features of the part
        self.blocks: list[tuple[int, int, int, slice]] = []
        flat = None if shaped is None else slices([table.size for table in mean.tables])
        for p, products in enumerate(own.products_of_part):
            rows = own.tables[p].shape[2]
            changes = np.zeros((0, *mean.tables[p].shape))
            if shaped is not None and flat is not None:
                changes = shaped.flat[:, flat[p]].reshape(self.n_betas, *mean.tables[p].shape)
            for rotation in np.unique(terms.part[products]):
                chosen = np.flatnonzero(terms.part[products] == rotation)
                features = terms.feature[products][chosen]
                assert (np.diff(features) == 1).all(), "features of one part stand side by side"
                number = len(self.blocks)
                self.keep(f"own{number}", own.tables[p][chosen].reshape(len(chosen), 3 * rows))
                # (1 + K, n, 3 rows): the mean person, then by each beta
                shapes = np.concatenate([mean.tables[p][None, chosen], changes[:, chosen]])
                self.keep(f"table{number}", shapes.reshape(1 + self.n_betas, len(chosen), 3 * rows))
                self.blocks.append((p, int(rotation), rows, slice(int(features[0]), int(features[-1]) + 1)))

        # how borders follow from loads, and insides from borders
        self.inside = [len(part.inside) for part in system.parts]
        for p, part in enumerate(system.parts):
            self.keep(f"spread{p}", np.ascontiguousarray(part.spread.T))
            self.keep(f"places{p}", part.places)
        self.keep("answer", np.ascontiguousarray(system.answer.T))
        self.keep("loads", np.concatenate([part.loads for part in system.parts]))
        self.keep("place_of", system.place_of)
        self.keep("origin", own.origin)
        self.n_loads = n + 1

    def forward(self, R: Tensor, features: Tensor, lifted: Tensor, betas: Tensor | None) -> Tensor:
        # 1. U of the vertices inside each part and its loads on the border, rotated with the part
        local: list[Tensor] = [features.new_zeros(0)] * self.n_parts
        for number, (p, rotation, rows, of_features) in enumerate(self.blocks):
            delta = features[:, of_features]
            table = getattr(self, f"own{number}")
            if betas is not None:
                shapes = getattr(self, f"table{number}")[:1 + betas.shape[-1]]
                if betas.shape[0] == 1:                        # one person: combine the tables once for all poses
                    table = shapes[0] + (betas[0] @ shapes[1:].flatten(1)).unflatten(0, shapes.shape[1:])
                else:                                          # several people: products of betas and features first
                    one = torch.cat([torch.ones_like(betas[:, :1]), betas], -1)
                    delta, table = (one[:, :, None] * delta[:, None]).flatten(1), shapes.flatten(0, 1)
            turned = R[:, rotation] @ (delta @ table).unflatten(-1, (3, rows))                 # (B, 3, rows)
            local[p] = turned if local[p].numel() == 0 else local[p] + turned

        # 2. the border from the loads of all parts, and the insides that follow it
        left = torch.cat([rows[..., i:] for rows, i in zip(local, self.inside, strict=True)], -1)
        loads = left.new_zeros((*left.shape[:-1], self.n_loads)).index_add(-1, self.loads, left)
        around = loads @ self.answer
        inside = [rows[..., :i] + around.index_select(-1, getattr(self, f"places{p}")) @ getattr(self, f"spread{p}")
                  for p, (rows, i) in enumerate(zip(local, self.inside, strict=True))]
        y = torch.cat([*inside, around], -1).index_select(-1, self.place_of)
        return y.transpose(-1, -2) + self.origin


class _ProductPoints(_Points):
    """Chosen points of a SCAPE body, or of any kind of model that is a sum of products; see `model.products`."""

    def __init__(self, points: ShapedProducts | Products) -> None:
        super().__init__()
        terms: Terms = points.terms
        own, mean, change = ((points.own, points.mean, points.change) if isinstance(points, ShapedProducts) else
                             (points.basis, points.basis, np.zeros((0, *points.basis.shape))))
        self.n_betas = len(change)

        # (3M, L) and (1 + K, 3M, L): products, then coordinates, times points
        rows = 3 * len(own), own.shape[-1]
        self.keep("own", own.reshape(rows))
        self.keep("table", np.concatenate([mean[None], change]).reshape(1 + len(change), *rows))
        self.keep("part", terms.part)
        self.keep("feature", terms.feature)
        self.keep("origin", points.origin)

    def forward(self, R: Tensor, features: Tensor, lifted: Tensor, betas: Tensor | None) -> Tensor:
        # δ R of every product, then one matrix product with the table of these betas
        delta = features.index_select(-1, self.feature)
        W = delta[:, :, None, None] * R.index_select(1, self.part)                             # (B, M, i, j)
        W = W.transpose(1, 2).flatten(2)                                                       # (B, i, 3M)
        table = self.own
        if betas is not None:
            table = self.table[0] + (betas @ self.table[1:1 + betas.shape[-1]].flatten(1)).unflatten(
                -1, self.table.shape[1:])
        return (W @ table).transpose(-1, -2) + self.origin


class _BlendedPoints(_Points):
    """A skinned body; see `model.blended`."""

    def __init__(self, points: ShapedBlended | Blended, parents: np.ndarray) -> None:
        super().__init__()
        shaped = points if isinstance(points, ShapedBlended) else None
        own = points.own if isinstance(points, ShapedBlended) else points
        mean = own if shaped is None else shaped.mean
        self.n_betas, self.parents = 0 if shaped is None else shaped.n_betas, parents.tolist()

        # rest points, joints and origins of the template's own body, of the mean person, and by each beta
        def both(name: str, of_own: np.ndarray, of_mean: np.ndarray, by_beta: np.ndarray | None) -> None:
            self.keep(f"own_{name}", of_own)
            changes = np.zeros((0, *of_mean.shape)) if by_beta is None else by_beta
            self.keep(f"table_{name}", np.concatenate([of_mean[None], changes]))

        both("rest", own.rest, mean.rest, None if shaped is None else shaped.rest)
        both("joints", own.places, mean.places, None if shaped is None else shaped.joints)
        both("origin", own.origin, mean.origin, None if shaped is None else shaped.origin)
        self.keep("weights", own.weights)
        bends = own.bent * own.bends                                                           # (J - 1, m, 3, n)
        self.keep("bends", np.swapaxes(bends, -1, -2).reshape(bends.shape[0] * bends.shape[1], -1))
        self.mixed, self.held = own.mix is not None, own.middle is not None
        if self.mixed:
            self.keep("mix", own.mix if isinstance(own.mix, np.ndarray) else csr_array(own.mix).toarray())
        if self.held:
            assert own.middle is not None and mean.middle is not None, "both are held in the same way"
            self.middle = _ProductPoints(own.middle if shaped is None else ShapedProducts(
                own.middle.terms, own.middle.basis, mean.middle.basis, shaped.middle, own.middle.origin))

    def forward(self, R: Tensor, features: Tensor, lifted: Tensor, betas: Tensor | None) -> Tensor:
        def of(name: str) -> Tensor:
            """Return an array (1 or B, ...) of the body with these betas."""
            if betas is None:
                return getattr(self, f"own_{name}")[None]
            table = getattr(self, f"table_{name}")
            return table[0] + (betas @ table[1:1 + betas.shape[-1]].flatten(1)).unflatten(-1, table.shape[1:])

        x, joints = of("rest"), of("joints")
        if self.bends.numel():
            x = x + (lifted[:, 1:].flatten(1) @ self.bends).unflatten(-1, (-1, 3))

        # translation y_j - R j of every part, then the weighted mean of all motions
        y = chain_joints(R, joints, self.parents)
        t = y - (R @ joints[..., None])[..., 0]
        motion = self.weights @ torch.cat([R, t[..., None]], -1).flatten(2)                    # (B, n, 12)
        motion = motion.unflatten(-1, (3, 4))
        points = (motion[..., :3] @ x[..., None])[..., 0] + motion[..., 3]
        if self.mixed:
            points = self.mix @ points
        if self.held:
            points = points - self.middle(R, features, lifted, betas)
        return points + of("origin")[:, None]


def chain_joints(R: Tensor, joints: Tensor, parents: list[int]) -> Tensor:
    """Compute posed joints (B, J, 3) from joints at rest (B, J, 3) and part rotations (B, J, 3, 3); the root's is 0."""
    y = [torch.zeros_like(R[:, 0, 0])]
    for j in range(1, len(parents)):
        p = parents[j]
        y.append(y[p] + (R[:, p] @ (joints[:, j] - joints[:, p])[..., None])[..., 0])
    return torch.stack(y, 1)


class _ChainedJoints(_Points):
    """The joints of an imported model, which are a chain of bones and not combinations of posed vertices."""

    def __init__(self, points: _BlendedPoints) -> None:
        super().__init__()
        self.parents, self.n_betas = points.parents, points.n_betas
        for name in ("own_joints", "table_joints", "own_origin", "table_origin"):
            self.register_buffer(name, getattr(points, name))

    def forward(self, R: Tensor, features: Tensor, lifted: Tensor, betas: Tensor | None) -> Tensor:
        joints, origin = self.own_joints[None], self.own_origin[None]
        if betas is not None:
            k = 1 + betas.shape[-1]
            joints = self.table_joints[0] + (betas @ self.table_joints[1:k].flatten(1)).unflatten(-1, (-1, 3))
            origin = self.table_origin[0] + betas @ self.table_origin[1:k]
        return chain_joints(R, joints, self.parents) + origin[:, None]


def _points_layer(points: ShapedPoints | PointOperator, parents: np.ndarray) -> _Points:
    """Build the layer for a kind of points; ValueError for an unknown kind."""
    if isinstance(points, ShapedCondensed | Condensed):
        return _CondensedPoints(points)
    if isinstance(points, ShapedBlended | Blended):
        return _BlendedPoints(points, parents)
    if isinstance(points, ShapedProducts | Products):
        return _ProductPoints(points)
    raise ValueError(f"body: a layer of {type(points).__name__} is not known here")


class BodyLayer(nn.Module):
    """A body model as a PyTorch module: `layer(poses, betas, trans)` gives vertices and joints.

    Parameters
    ----------
    body : BodyModel or Subject
        A model of any kind, or a person of fixed shape, who has no betas.
    vertices : (L,) int, optional
        Only these vertices, in this order. The others are never computed, so a fit to a few markers is much faster.
    dtype : torch.dtype
        float32, or float64 which agrees with the model to 1e-10 m. `layer.to(device)` as for every module.

    Attributes
    ----------
    faces : (F, 3) int64 tensor
        Triangles of the whole body.
    n_betas : int
    n_joints : int

    Raises
    ------
    ValueError
        A kind of features or of model that has no layer; vertices that the body has not.

    Examples
    --------
    >>> from model import load_model
    >>> layer = BodyLayer(load_model("people"))
    >>> poses = torch.zeros(2, layer.n_joints, 3, requires_grad=True)
    >>> vertices, joints = layer(poses, betas=torch.zeros(2, 10))
    >>> vertices.shape, joints.shape
    (torch.Size([2, 5002, 3]), torch.Size([2, 16, 3]))
    >>> joints[:, 4].sum().backward()                        # gradients of poses, betas and trans
    >>> poses.grad.shape
    torch.Size([2, 16, 3])

    [SCAPE] Eq. 6
    """

    faces: Tensor

    def __init__(self, body: BodyModel | Subject, vertices: np.ndarray | None = None,
                 dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        features = body.features if isinstance(body, BodyModel) else _features_of(body.operator)
        if features.lift.kind not in LIFTS:
            raise ValueError(f"body: its features are of the kind '{features.lift.kind}', "
                             f"a layer knows {', '.join(LIFTS)}")
        self.lift, skeleton = LIFTS[features.lift.kind], body.skeleton
        self.n_joints, N = len(skeleton.parents), len(body.template.vertices)
        whole: ShapedPoints | PointOperator = body.everywhere if isinstance(body, BodyModel) else body.operator

        # parts of one depth below the root are turned together
        self.depths = [parts.tolist() for parts in skeleton.depths]
        self.above = [[before.index(skeleton.parents[j]) for j in parts]
                      for before, parts in zip(self.depths[:-1], self.depths[1:], strict=True)]
        self.back = np.argsort(np.concatenate(skeleton.depths)).tolist()

        # points: all vertices, or those chosen and the joints after them
        self.n_points, regressor = N, body.joint_regressor
        if vertices is None:
            self.points = _points_layer(whole, skeleton.parents)
        else:
            ids = np.asarray(vertices, dtype=np.int64)
            if ids.ndim != 1 or not ((ids >= 0) & (ids < N)).all():
                raise ValueError(f"vertices: expected places of 0..{N - 1}, got {np.shape(vertices)} {ids.ravel()[:5]}")
            self.n_points = len(ids)
            self.points = _points_layer(body.points(ids), skeleton.parents)
        # joints: a chain, points of their own, or combinations of all vertices that are computed anyway
        self.joints: _Points | None = None
        if isinstance(self.points, _BlendedPoints) and not self.points.held:
            self.joints = _ChainedJoints(self.points)
        elif vertices is not None:
            self.joints = _points_layer(body.points(*_pad_regressor(regressor)), skeleton.parents)
        else:
            ring = np.unique(regressor.indices)
            self.register_buffer("ring", torch.from_numpy(ring.astype(np.int64)))
            self.register_buffer("regressor", torch.from_numpy(regressor[:, ring].toarray()))

        self.register_buffer("mix", torch.from_numpy(features.mix.reshape(-1, features.count).copy()))
        self.register_buffer("constant", torch.from_numpy(features.constant.copy()))
        self.register_buffer("faces", torch.from_numpy(np.array(body.template.faces)), persistent=False)
        self.n_betas = self.points.n_betas
        self.to(dtype)

    def forward(self, poses: Tensor | None = None, betas: Tensor | None = None, trans: Tensor | None = None
                ) -> tuple[Tensor, Tensor]:
        """Compute vertices and joints of a batch of bodies, or of one body where poses and betas have no batch.

        Parameters
        ----------
        poses : (B, J, 3), (J, 3) or (B, 3J) tensor, radians, optional
            Zero where none is given.
        betas : (B, k), (1, k) or (k,) tensor, k ≤ K, standard deviations, optional
            None is the template's own body; zeros are the mean person.
        trans : (B, 3) or (3,) tensor, metres, optional
            Travel of the root's joint; zero where none is given.

        Returns
        -------
        vertices : (B, N, 3) or (N, 3) tensor, metres
        joints : (B, J, 3) or (J, 3) tensor, metres

        Raises
        ------
        ValueError
            Shapes that do not fit.
        """
        # arguments whose shapes fit
        like = self.mix
        pose = like.new_zeros(self.n_joints, 3) if poses is None else poses
        if pose.shape[-1] == 3 * self.n_joints:
            pose = pose.unflatten(-1, (self.n_joints, 3))
        shapes = {"poses": (pose, 3, (self.n_joints, 3)), "betas": (betas, 2, None), "trans": (trans, 2, (3,))}
        for name, (value, most, last) in shapes.items():
            if value is not None and (value.ndim not in (most - 1, most) or (last and value.shape[1 - most:] != last)):
                raise ValueError(f"{name}: expected shape (B, {', '.join(map(str, last or ('k',)))}) or without B, "
                                 f"got {tuple(value.shape)}")
        if betas is not None and betas.shape[-1] > self.n_betas:
            raise ValueError(f"betas: expected at most {self.n_betas} numbers, got shape {tuple(betas.shape)}")

        # one batch size for all: what has size 1 is repeated
        batched = pose.ndim == 3 or any(x is not None and x.ndim == 2 for x in (betas, trans))
        pose = pose if pose.ndim == 3 else pose[None]
        betas, trans = (x if x is None or x.ndim == 2 else x[None] for x in (betas, trans))
        B = pose.shape[0]
        for name, value in (("betas", betas), ("trans", trans)):
            if value is not None and value.shape[0] != 1:
                if B not in (1, value.shape[0]):
                    raise ValueError(f"{name}: expected one batch size, got {value.shape[0]} beside {B}")
                B = value.shape[0]
        pose = pose.expand(B, self.n_joints, 3)

        # rotations, features, surface
        R, lifted = self._rotations(pose), self.lift(wrap_twists(pose))
        features = lifted.flatten(1) @ self.mix + self.constant
        y = self.points(R, features, lifted, betas)
        joints = self.regressor @ y.index_select(1, self.ring) if self.joints is None else \
            self.joints(R, features, lifted, betas)
        if trans is not None:
            y, joints = y + trans[:, None], joints + trans[:, None]
        return (y, joints) if batched else (y[0], joints[0])

    def _rotations(self, pose: Tensor) -> Tensor:
        """Compute the world rotations (B, J, 3, 3) of the parts: `R_j = R_parent(j) exp(pose_j)`."""
        relative = rotation_matrices(pose)
        by_depth = [relative[:, self.depths[0]]]
        for parts, above in zip(self.depths[1:], self.above, strict=True):
            by_depth.append(by_depth[-1][:, above] @ relative[:, parts])
        return torch.cat(by_depth, 1)[:, self.back]


def _features_of(operator: PointOperator) -> PoseFeatures:
    """Return the pose features of a subject's operator."""
    if isinstance(operator, Blended):
        return operator.features
    assert isinstance(operator, Condensed | Products), "no other operator has a layer"
    return operator.terms.features


def _pad_regressor(regressor: csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Convert a regressor (J, N) to vertices (J, k) and weights (J, k), filled up with weights of zero."""
    counts = np.diff(regressor.indptr)
    ids, weights = np.zeros((2, len(counts), counts.max()))
    for j, (start, count) in enumerate(zip(regressor.indptr, counts, strict=False)):
        ids[j, :count] = regressor.indices[start:start + count]
        weights[j, :count] = regressor.data[start:start + count]
        ids[j, count:] = ids[j, 0]
    return ids.astype(np.int64), weights


def write_onnx(layer: BodyLayer, path: str | Path) -> None:
    """Write a layer as an ONNX graph: inputs `poses` (B, J, 3), `betas` (B, K) and `trans` (B, 3), any B from 2 on.

    Outputs are `vertices` (B, N, 3) and `joints` (B, J, 3), metres. A person of fixed shape has no `betas`.

    Raises
    ------
    ValueError
        The file is not called `.onnx`.
    ImportError
        `pip install "scapekit[onnx]"` brings what is missing.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"path: expected a file called .onnx, got {path}")
    like = layer.mix
    inputs = {"poses": like.new_zeros(2, layer.n_joints, 3), "betas": like.new_zeros(2, layer.n_betas),
              "trans": like.new_zeros(2, 3)}
    if not layer.n_betas:
        del inputs["betas"]
    count = torch.export.Dim("B")
    with storage.writing(path) as beside:
        torch.onnx.export(layer, (), str(beside), kwargs=inputs, input_names=list(inputs), dynamo=True, verbose=False,
                          external_data=False, output_names=["vertices", "joints"],
                          dynamic_shapes={name: {0: count} for name in inputs})
