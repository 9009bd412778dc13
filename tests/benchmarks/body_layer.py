"""The PyTorch layer beside NumPy, a plain layer of linear blend skinning, and anny: meshes a second, memory, accuracy.

    python tests/benchmarks/body_layer.py [MODEL.npz ...] -o body_layer.json [--batches 1 64 1024] [--threads 1]

Every model file, or the built-in people, is timed with other betas for each body (`forward`), with gradients of poses
and betas (`gradients`), and NumPy with the betas of one person (`subject.vertices`), for which the layer is timed too
(`one person`). The skinned reference is written here from the formula of Loper et al. 2015 as smplx users know it, with
random arrays of as many vertices, joints, betas and pose directions. anny is measured with its own model if it is
installed. `half` are the largest errors if all large arrays, or all but those of the mean person at rest, were float16.
"""
from __future__ import annotations

import argparse
import importlib.util
import resource
import time
from collections.abc import Callable

import numpy as np
import torch
from protocols import machine, write_report
from torch import Tensor, nn

from model.body import BodyModel
from model.files import load_model
from model.priors import sample_poses
from model.torch import BodyLayer, rotation_matrices


class Skinned(nn.Module):
    """Linear blend skinning with shape and pose directions: the reference."""

    def __init__(self, model: BodyModel) -> None:
        super().__init__()
        N, J, K = len(model.template.vertices), len(model.skeleton.parents), model.n_betas
        rng = np.random.default_rng(0)
        self.parents = model.skeleton.parents.tolist()
        for name, value in (("rest", model.template.vertices), ("shapes", rng.normal(0, 0.01, (K, 3 * N))),
                            ("bends", rng.normal(0, 0.001, (9 * (J - 1), 3 * N))), ("weights", model.skin_weights),
                            ("regressor", model.joint_regressor.toarray())):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float32))

    def forward(self, poses: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
        B = len(poses)
        x = self.rest + (betas @ self.shapes).view(B, -1, 3)
        joints = self.regressor @ x
        relative = rotation_matrices(poses)
        x = x + ((relative[:, 1:] - torch.eye(3)).flatten(1) @ self.bends).view(B, -1, 3)
        R, t = [relative[:, 0]], [joints[:, 0]]
        for j in range(1, len(self.parents)):
            p = self.parents[j]
            R.append(R[p] @ relative[:, j])
            t.append(t[p] + (R[p] @ (joints[:, j] - joints[:, p])[..., None])[..., 0])
        R, posed = torch.stack(R, 1), torch.stack(t, 1)
        follow = posed - (R @ joints[..., None])[..., 0]
        motion = (self.weights @ torch.cat([R, follow[..., None]], -1).flatten(2)).unflatten(-1, (3, 4))
        return (motion[..., :3] @ x[..., None])[..., 0] + motion[..., 3], posed


def rate(work: Callable[[], object], bodies: int, seconds: float = 1.5) -> float:
    """Bodies a second of processor time, the best of rounds."""
    work()
    best, until = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < until:
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return bodies / best


def backward(layer: nn.Module, poses: Tensor, betas: Tensor) -> None:
    poses, betas = poses.clone().requires_grad_(), betas.clone().requires_grad_()
    y, joints = layer(poses, betas)
    (y.sum() + joints.sum()).backward()


def accuracy(model: BodyModel) -> dict[str, float]:
    """Largest differences from the exact body in 20 poses, metres."""
    rng = np.random.default_rng(0)
    poses, betas = sample_poses(model, 20, rng), rng.normal(size=(20, model.n_betas))
    exact, out = model.vertices(poses, betas), {}
    for dtype in (torch.float32, torch.float64):
        layer = BodyLayer(model, dtype=dtype)
        inputs = torch.tensor(poses, dtype=dtype), torch.tensor(betas, dtype=dtype)
        out[str(dtype).split(".")[1]] = float(np.abs(layer(*inputs)[0].numpy() - exact).max())
    for name, kept in (("half", ("faces", "mix", "constant", "ring", "origin")),
                       ("half, mean person in float32", ("faces", "mix", "constant", "ring", "origin", "mean"))):
        layer = BodyLayer(model, dtype=torch.float64)
        for key, buffer in layer.named_buffers():
            if buffer.is_floating_point() and not any(part in key for part in kept):
                rounded = buffer.half().double()
                if "mean" in kept and "table" in key and buffer.ndim == 3:
                    rounded[0, 0] = buffer[0, 0]                       # the constant feature of the mean person
                if "mean" in kept and ("answer" in key or "spread" in key):
                    rounded = buffer
                buffer.copy_(rounded)
        out[name] = float(np.abs(layer(torch.tensor(poses), torch.tensor(betas))[0].numpy() - exact).max())
    return out


def measured(model: BodyModel, batches: list[int]) -> dict[str, dict[str, float]]:
    rng, out = np.random.default_rng(0), {}
    layer, skinned = BodyLayer(model), Skinned(model)
    subject, exact = model.subject(np.zeros(model.n_betas), np.float32), model.subject(np.zeros(model.n_betas))
    for B in batches:
        poses = sample_poses(model, B, rng)
        P = torch.tensor(poses, dtype=torch.float32)
        betas = torch.randn(B, model.n_betas)
        with torch.no_grad():
            row = {"layer, forward": rate(lambda P=P, b=betas: layer(P, b), B),
                   "layer, one person": rate(lambda P=P, b=betas: layer(P, b[:1]), B),
                   "skinned, forward": rate(lambda P=P, b=betas: skinned(P, b), B)}
        row["layer, gradients"] = rate(lambda P=P, b=betas: backward(layer, P, b), B)
        row["skinned, gradients"] = rate(lambda P=P, b=betas: backward(skinned, P, b), B)
        row["NumPy, one person"] = rate(lambda p=poses: subject.vertices(p), B)
        row["NumPy, one person, float64"] = rate(lambda p=poses: exact.vertices(p), B)
        row["memory so far, MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        out[str(B)] = row
    return out


def of_anny(batches: list[int]) -> dict[str, dict[str, float]]:
    """anny's own model, whole."""
    import anny

    model, out = anny.create_fullbody_model(), {}
    phenotypes = {name: 0.5 for name in model.phenotype_labels}
    for B in batches:
        J = len(model.bone_labels)
        poses = torch.eye(4).expand(B, J, 4, 4).contiguous()
        given = {name: torch.full((B,), value) for name, value in phenotypes.items()}
        with torch.no_grad():
            def work(poses: Tensor = poses, given: dict[str, Tensor] = given) -> object:
                return model(pose_parameters=poses, phenotype_kwargs=given)
            out[str(B)] = {"forward": rate(work, B), "vertices": int(model.template_vertices.shape[0]), "bones": J}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=["people"])
    parser.add_argument("-o", "--output", required=True)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    report = {"machine": machine(), "torch": torch.__version__, "threads": given.threads, "models": {}}
    for path in given.models:
        model = load_model(path)
        report["models"][f"{model.kind}, {len(model.template.vertices)} vertices"] = {
            "error, m": accuracy(model), "meshes a second": measured(model, given.batches)}
    if importlib.util.find_spec("anny"):
        try:
            report["anny"] = of_anny(given.batches)
        except Exception as problem:                # its interface changes; the report says why it has no figures
            report["anny"] = {"not measured": repr(problem)}
    write_report(given.output, report)


if __name__ == "__main__":
    main()
