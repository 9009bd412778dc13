"""The condensed body is the stitched one: product by product, for many people, and where parts have no inside."""
import pickle
from dataclasses import replace

import numpy as np
import pytest
from conformance_bodies import blendscape_worm, scape_worm
from model_bodies import random_poses

from model.condensed import Condensed
from model.pose_space import PoseSpace
from model.scape import ScapeModel
from model.shape_space import ShapeSpace
from scanprep.batch.digests import Digests
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

WORMS = pytest.mark.parametrize("model", [scape_worm(), blendscape_worm()], ids=["scape", "blendscape"])


@WORMS
def test_every_product_is_stitched(model):
    """What one product does alone is the solve of its edges, for all vertices and for some in any order."""
    betas = np.array([0.7, -1.2, 0.4])
    condensed, S = model.operator(betas), model.shape_space.gradients(betas)
    assert isinstance(condensed, Condensed)
    m, basis = 0, condensed.products.basis
    few = np.array([17, 3, 300, 3, 250, 0])
    some = condensed.of_vertices(few).basis
    for block in model.parts.blocks:
        faces = model.pose_space.faces_of_part[block.part][block.chosen]
        for a in model.pose_space.coefficients[block.part][:, block.chosen].astype(float):
            edges = np.zeros((len(model.template.faces), 2, 3))
            wanted = model.parts.v_hat[faces] @ np.swapaxes(S[faces] @ a, -1, -2)
            edges[faces] = block.weights[:, None, None] * wanted
            alone = model.stitching.stitch(edges)
            np.testing.assert_allclose(basis[m].T, alone, rtol=0, atol=1e-12)
            np.testing.assert_allclose(some[m].T, alone[few], rtol=0, atol=1e-12)
            m += 1
    assert m == len(basis) == model.terms.count


@WORMS
def test_sums_sizes_and_types(model):
    rng = np.random.default_rng(0)
    pose, (one, other) = random_poses(model, 1, rng)[0], (model.operator(rng.normal(size=3)) for _ in range(2))
    np.testing.assert_allclose(one.plus(-0.5, other).relative_positions(pose),
                               one.relative_positions(pose) - 0.5 * other.relative_positions(pose),
                               rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.scale_by(1.3).relative_positions(pose), 1.3 * one.relative_positions(pose), rtol=0,
                               atol=1e-12)
    half = one.astype(np.float32)
    assert half.relative_positions(pose).dtype == np.float32
    np.testing.assert_allclose(half.relative_positions(pose), one.relative_positions(pose), rtol=0, atol=3e-6)
    mixed = rng.dirichlet(np.ones(5), 4) @ np.eye(one.count)[rng.choice(one.count, 5)]
    for asked in (one, replace(one)):                    # a second one without the products that the first has made
        np.testing.assert_allclose(asked.combine(mixed).relative_positions(pose),
                                   one.relative_positions(pose) @ mixed.T, rtol=0, atol=1e-12)
        assert one.products.count == one.count


def test_parts_without_an_inside():
    """A cube of four parts of three triangles each: every vertex is on a border."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])
    cube, part = Mesh(corners, faces), np.repeat(np.arange(4), 3)
    skeleton = Skeleton(part, [-1, 0, 0, 0], np.tile(corners.mean(axis=0), (4, 1)))
    joints = skeleton.joints.copy()
    joints[0] = cube.vertices[skeleton.part_of_vertex(cube) == 0].mean(axis=0)
    skeleton = Skeleton(part, skeleton.parents, joints)
    model = ScapeModel(cube, skeleton, PoseSpace.identity(skeleton), ShapeSpace.empty(len(faces)), np.zeros((4, 3)),
                       np.zeros((12, 12)))
    assert all(len(one.inside) == 0 for one in model.parts.condensation.parts[1:])
    pose = np.random.default_rng(0).normal(0, 0.5, (4, 3))
    np.testing.assert_allclose(model.subject(None).vertices(pose), model.vertices(pose), rtol=0, atol=1e-12)


def test_a_person_goes_to_other_processes_and_has_a_digest():
    model = scape_worm()
    person, pose = model.subject(np.ones(3)), np.random.default_rng(0).normal(0, 0.5, (4, 3))
    before = Digests().of(person)
    person.operator.products                                     # what is worked out changes nothing
    sent = pickle.loads(pickle.dumps(person))
    np.testing.assert_array_equal(sent.vertices(pose), person.vertices(pose))
    assert Digests().of(person) == Digests().of(sent) == before != Digests().of(model.subject(np.zeros(3)))
