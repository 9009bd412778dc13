"""USD files as usd-core itself poses them."""
import numpy as np
import pytest

pytest.importorskip("pxr", reason="usd-core, the library of USD, is not installed")
from pxr import Usd, UsdGeom, UsdSkel, UsdUtils, Vt


def complaints(path):
    """What USD's own checker has against a file: the validators of new versions, the ComplianceChecker of old ones."""
    if hasattr(UsdUtils, "ComplianceChecker"):
        checker = UsdUtils.ComplianceChecker()
        checker.CheckCompliance(str(path))
        return [*checker.GetErrors(), *checker.GetFailedChecks(), *checker.GetWarnings()]
    from pxr import UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [f"{error.GetName()}: {error.GetMessage()}" for error in found]


def shown(path, times):
    """(n, N, 3) the mesh of a file at some time codes, skinned or not."""
    stage = Usd.Stage.Open(str(path))
    if stage.GetDefaultPrim().IsA(UsdSkel.Root):
        return skinned(path, times)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/body/mesh"))
    return np.array([mesh.GetPointsAttr().Get(float(time)) for time in times])


def skinned(path, times):
    """(n, N, 3) the mesh of a file at some time codes, by UsdSkel's own queries for skinning and blend shapes."""
    stage = Usd.Stage.Open(str(path))
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    skeleton, skin = cache.GetSkelQuery(binding.GetSkeleton()), binding.GetSkinningTargets()[0]
    mesh = UsdGeom.Mesh(skin.GetPrim())
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(skin.GetPrim())) if skin.HasBlendShapes() else None
    out = []
    for time in map(float, times):
        points = mesh.GetPointsAttr().Get(time)
        motion = skeleton.GetAnimQuery()
        if shapes and motion:
            weights = motion.ComputeBlendShapeWeights(time)
            weights = skin.GetBlendShapeMapper().Remap(weights) if skin.GetBlendShapeMapper() else weights
            sub = shapes.ComputeSubShapeWeights(weights)
            shapes.ComputeDeformedPoints(*sub, shapes.ComputeBlendShapePointIndices(),
                                         shapes.ComputeSubShapePointOffsets(), points)
        skin.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(time), points, time)
        out.append(np.array(points))
    return np.array(out)


def morphed(path, weights):
    """(N, 3) the mesh at rest with these weights of its blend shapes by name."""
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/body/mesh")
    binding = UsdSkel.BindingAPI(prim)
    shapes, names = UsdSkel.BlendShapeQuery(binding), binding.GetBlendShapesAttr().Get()
    points = UsdGeom.Mesh(prim).GetPointsAttr().Get()
    assert set(weights) <= set(names)
    sub = shapes.ComputeSubShapeWeights(Vt.FloatArray([weights.get(name, 0.0) for name in names]))
    shapes.ComputeDeformedPoints(*sub, shapes.ComputeBlendShapePointIndices(), shapes.ComputeSubShapePointOffsets(),
                                 points)
    return np.array(points)
