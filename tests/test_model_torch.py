"""The PyTorch layer says what the models say, and its gradients are right; skipped where PyTorch is not installed."""
import importlib

import numpy as np
import pytest
import toy_kind
from conformance_bodies import KINDS
from model_bodies import random_poses

from model import files
from scanprep.geometry import rotations

torch = layers = None


@pytest.fixture(scope="module", autouse=True)
def pytorch():
    """Loaded when the first test runs: it takes 3 s, which collecting all tests need not wait for."""
    global torch, layers
    torch = pytest.importorskip("torch")
    layers = importlib.import_module("model.torch")


@pytest.fixture(scope="module", params=list(KINDS))
def model(request):
    with pytest.MonkeyPatch.context() as patch:
        for kind, line in toy_kind.TABLE.items():
            patch.setitem(files.KINDS, kind, line)
        yield KINDS[request.param]()


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def wanted(model, poses, betas, trans):
    """Vertices and joints as the model says, one by one."""
    each = [None if betas is None else betas[b if len(betas) > 1 else 0] for b in range(len(poses))]
    return (np.stack([model.vertices(*one) for one in zip(poses, each, trans, strict=True)]),
            np.stack([model.subject(b).joints(p, t) for p, b, t in zip(poses, each, trans, strict=True)]))


@pytest.mark.parametrize("people", ["own", "each", "one", "fewer betas"])
@pytest.mark.parametrize("size", [0.0, 0.5, 2.5])                # at rest, usual, and beyond π
def test_it_is_the_model(model, rng, people, size):
    poses, trans = random_poses(model, 3, rng, size), rng.normal(size=(3, 3))
    betas = {"own": None, "each": rng.normal(size=(3, 3)), "one": rng.normal(size=(1, 3)),
             "fewer betas": rng.normal(size=(3, 2))}[people]
    y, joints = wanted(model, poses, betas, trans)
    few = np.arange(0, len(y[0]), 9)
    for dtype, near in ((torch.float64, 1e-10), (torch.float32, 1e-5)):
        inputs = [None if x is None else torch.tensor(x, dtype=dtype) for x in (poses, betas, trans)]
        found, found_joints = layers.BodyLayer(model, dtype=dtype)(*inputs)
        assert found.dtype == dtype
        np.testing.assert_allclose(found, y, rtol=0, atol=near)
        np.testing.assert_allclose(found_joints, joints, rtol=0, atol=near)
        some, some_joints = layers.BodyLayer(model, few, dtype=dtype)(*inputs)
        np.testing.assert_allclose(some, y[:, few], rtol=0, atol=near)
        np.testing.assert_allclose(some_joints, joints, rtol=0, atol=near)


def test_gradients_are_differences(model, rng):
    layer = layers.BodyLayer(model, np.array([0, 7, 30]), dtype=torch.float64)
    poses, betas, trans = (torch.tensor(x, requires_grad=True) for x in
                           (random_poses(model, 2, rng), rng.normal(size=(2, 3)), rng.normal(size=(2, 3))))
    assert torch.autograd.gradcheck(layer, (poses, betas, trans))
    whole = layers.BodyLayer(model, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda *x: whole(*x)[0].square().mean(), (poses, betas, trans))
    assert torch.autograd.gradcheck(lambda b: whole(poses.detach(), b)[1], (betas[:1].detach().requires_grad_(),))


@pytest.mark.parametrize("length", [0.0, 1e-9, np.pi, 2 * np.pi])
def test_gradients_are_finite_where_formulas_divide(model, length):
    layer = layers.BodyLayer(model, dtype=torch.float64)
    poses = torch.zeros(1, 4, 3, dtype=torch.float64)
    poses[..., 0] = length
    poses.requires_grad_()
    y, joints = layer(poses)
    (y.square().sum() + joints.sum()).backward()
    assert y.isfinite().all() and poses.grad.isfinite().all()


def test_rotations_are_those_of_the_package(rng):
    t = np.concatenate([rng.normal(size=(50, 3)) * 3, np.zeros((1, 3)), 1e-2 * rng.normal(size=(5, 3)),
                        [[np.pi, 0, 0], [0, 2 * np.pi, 0], [3.2, 0, 0]]])
    np.testing.assert_allclose(layers.rotation_matrices(torch.tensor(t)), rotations.exp(t), rtol=0, atol=1e-12)
    wrapped = layers.wrap_twists(torch.tensor(t)).numpy()
    assert (np.linalg.norm(wrapped, axis=1) <= np.pi + 1e-12).all()
    np.testing.assert_allclose(rotations.exp(wrapped), rotations.exp(t), rtol=0, atol=1e-12)
    near = torch.tensor([[0.0, 0, 0], [0.03, 0.01, 0], [0.0316, 0, 0], [0.0317, 0, 0]], dtype=torch.float64,
                        requires_grad=True)
    assert torch.autograd.gradcheck(layers.rotation_matrices, (near,))


def test_a_person_of_fixed_shape_has_a_layer(model, rng):
    betas, poses = rng.normal(size=3), random_poses(model, 2, rng)
    subject = model.subject(betas)
    layer = layers.BodyLayer(subject, dtype=torch.float64)
    assert layer.n_betas == 0
    y, joints = layer(torch.tensor(poses))
    np.testing.assert_allclose(y, subject.vertices(poses), rtol=0, atol=1e-10)
    np.testing.assert_allclose(joints, subject.joints(poses), rtol=0, atol=1e-10)


def test_flat_poses_and_missing_batches(model, rng):
    layer, poses = layers.BodyLayer(model), torch.tensor(random_poses(model, 2, rng), dtype=torch.float32)
    betas, trans = torch.randn(2, 3), torch.randn(2, 3)
    plain = layer(poses, betas, trans)
    for a, b in zip(plain, layer(poses.flatten(1), betas, trans), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5)
    one, joints = layer(poses[0], betas[0], trans[0])
    assert one.shape == plain[0].shape[1:] and joints.shape == (4, 3)
    torch.testing.assert_close(one, plain[0][0], rtol=0, atol=1e-5)
    rest, _ = layer(betas=betas)
    torch.testing.assert_close(rest, layer(torch.zeros(2, 4, 3), betas)[0], rtol=0, atol=1e-6)
    assert layer()[0].shape == one.shape


def test_it_maps_compiles_and_is_stored(model, rng):
    layer = layers.BodyLayer(model, dtype=torch.float64)
    poses, betas = torch.tensor(random_poses(model, 3, rng)), torch.tensor(rng.normal(size=(3, 3)))
    plain = layer(poses, betas)
    mapped = torch.func.vmap(lambda p, b: layer(p, b))(poses, betas)
    compiled = torch.compile(layer, backend="eager", fullgraph=True)(poses, betas)
    by_pose = torch.func.vmap(torch.func.jacrev(lambda p: layer(p)[1]))(poses)
    other = layers.BodyLayer(model, dtype=torch.float64)
    for buffer in other.buffers():
        if buffer.is_floating_point():
            buffer.zero_()
    other.load_state_dict(layer.state_dict())
    for found in (mapped, compiled, other(poses, betas)):
        for a, b in zip(plain, found, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=1e-10)
    assert by_pose.shape == (3, 4, 3, 4, 3) and by_pose.isfinite().all()


def test_what_does_not_fit_is_told(model):
    layer = layers.BodyLayer(model)
    for inputs, told in (({"poses": torch.zeros(2, 5, 3)}, "poses: expected shape"),
                         ({"betas": torch.zeros(2, 9)}, "betas: expected at most 3"),
                         ({"poses": torch.zeros(2, 4, 3), "betas": torch.zeros(3, 2)}, "one batch size"),
                         ({"trans": torch.zeros(2, 4)}, "trans: expected shape")):
        with pytest.raises(ValueError, match=told):
            layer(**inputs)
    assert layers.BodyLayer(model, np.zeros(0, dtype=int))()[0].shape == (0, 3)           # joints alone
    with pytest.raises(ValueError, match="expected places of 0"):
        layers.BodyLayer(model, np.array([-1]))


# a kind of each class of points: the others are written as these are, and one takes five seconds
@pytest.mark.parametrize("model", ["scape-quaternion", "skinning-linear", "toy"], indirect=True)
def test_onnx_says_the_same(model, rng, tmp_path):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    layer, path = layers.BodyLayer(model), tmp_path / "body.onnx"
    layers.write_onnx(layer, path)
    assert [file.name for file in tmp_path.iterdir()] == ["body.onnx"]
    poses, betas, trans = (torch.tensor(x, dtype=torch.float32) for x in
                           (random_poses(model, 3, rng), rng.normal(size=(3, 3)), rng.normal(size=(3, 3))))
    session = runtime.InferenceSession(str(path))
    found = session.run(None, {"poses": poses.numpy(), "betas": betas.numpy(), "trans": trans.numpy()})
    for a, b in zip(found, layer(poses, betas, trans), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match=r"called \.onnx"):
        layers.write_onnx(layer, tmp_path / "body.pt")
