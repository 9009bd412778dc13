"""Whether tests notice small mistakes in the mathematics: a wrong sign, weight, unit or order, one at a time.

    python tests/benchmarks/mutations.py [-o FILE] [--only WORDS ...] [--show]

The checkout is copied, and each mutation is made in the copy alone: a text that stands once in its file is replaced,
and the tests of that module run until one fails. Tests that fail without any mutation notice nothing, so they run
unchanged first. A mutation that survives is a test that is missing, or code without effect.
"""
from __future__ import annotations

import argparse
import ast
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import igl  # noqa: F401 -- these are loaded once for all processes, which takes longer than most tests
import numpy  # noqa: F401
import pytest
import scipy.ndimage
import scipy.optimize
import scipy.sparse.linalg
import scipy.spatial.transform
import scipy.stats  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
LONGEST = 600                        # seconds for a file of tests: a mutation that hangs is noticed


@dataclass(frozen=True)
class Mutation:
    """One mistake: the text `before`, which stands once in the file, becomes `after`; `tests` are to notice it."""

    path: str
    tests: str
    name: str
    before: str
    after: str


def of(path: str, tests: str, *mistakes: tuple[str, str, str]) -> tuple[Mutation, ...]:
    """Mutations (name, before, after) of one module, whose tests are words for pytest without folder and ending."""
    return tuple(Mutation(path, tests, *each) for each in mistakes)


# Signs, weights, units and orders; the first of the module's tests that has to fail stands first.
MUTATIONS = (
    # scans: registered meshes and a skeleton
    *of("scanprep/geometry/rotations.py", "scanprep_geometry_rotations",
        ("right Jacobian of the other side", "np.eye(3) - first * K + second", "np.eye(3) + first * K + second"),
        ("inverse of the left Jacobian", "np.eye(3) + 0.5 * K + second", "np.eye(3) - 0.5 * K + second"),
        ("inverse Jacobian near zero, second order", "1 / 12 + angle**2 / 720", "1 / 6 + angle**2 / 720"),
        ("right Jacobian near zero, first order", "0.5 - angle**2 / 24", "0.25 - angle**2 / 24"),
        ("product of quaternions in the other order", "p[..., 1] * q[..., 2] - p[..., 2] * q[..., 1]",
         "p[..., 2] * q[..., 1] - p[..., 1] * q[..., 2]"),
        ("reflections among the rotations", "U[flip, :, 2] *= -1", "U[flip, :, 2] *= 1"),
        ("Procrustes from target to source", '"...ni,...nj->...ij", target', '"...nj,...ni->...ij", target')),
    *of("scanprep/geometry/least_squares.py", "scanprep_geometry_least_squares",
        ("what frames share gets their pull twice", "slope - back[..., -1].sum(axis=0))",
         "slope + back[..., -1].sum(axis=0))"),
        ("gradient of what frames share left out", "slope + self.common.gradient[0]",
         "slope + 0 * self.common.gradient[0]"),
        ("expected gain with the gradient's sign", "ridge * step - gradient, step)", "ridge * step + gradient, step)"),
        ("damping grows with success", "np.maximum(factor / 5, 1e-9), factor * 8)",
         "factor * 8, np.maximum(factor / 5, 1e-9))"),
        ("small rotations by the forward Jacobian", "rotations.inverse_right_jacobian(x[:, :angles]",
         "rotations.right_jacobian(x[:, :angles]"),
        ("steps from the left", "rotations.compose(first, second).reshape", "rotations.compose(second, first).reshape"),
        ("damping without the diagonal", "damping[:, None] * diagonal + FLOOR", "damping[:, None] + FLOOR")),
    *of("scanprep/geometry/sparse.py", "scanprep_geometry_sparse",
        ("first differences for second ones", "D = np.array([1.0, -2.0, 1.0])", "D = np.array([0.0, -1.0, 1.0])"),
        ("harmonic values with the sign turned", "(-L[:, fixed] @ out[fixed])", "(L[:, fixed] @ out[fixed])"),
        ("conjugate directions weighed upside down", "p = z + rz / last * p", "p = z + last / rz * p")),
    *of("scanprep/alignment/icp.py", "scanprep_alignment_icp",
        ("borders of the target count", " & ~goal.border[near]", ""),
        ("only borders of the target count", "& ~goal.border[near]", "& goal.border[near]"),
        ("lever arm about the origin", "np.cross(x - middle, n), n]", "np.cross(x, n), n]"),
        ("steps away from the target", "step = -np.linalg.solve(H", "step = np.linalg.solve(H"),
        ("scale of landmarks turned over", "np.sum(b * (a @ R.T)) / np.sum(a * a)",
         "np.sum(a * a) / np.sum(b * (a @ R.T))"),
        ("the farthest matches kept", "distance <= np.quantile", "distance >= np.quantile")),
    *of("scanprep/decimation/quadrics.py", "scanprep_decimation",
        ("QEM without areas", "plane_quadrics(normal, corners[:, 0], area)",
         "plane_quadrics(normal, corners[:, 0], np.full_like(area, area.mean()))"),
        ("QEM by areas squared", "plane_quadrics(normal, corners[:, 0], area)",
         "plane_quadrics(normal, corners[:, 0], area * area / area.mean())"),
        ("planes on the other side of the origin", "d = -np.einsum", "d = np.einsum"),
        ("walls without their edge's length", "weights[:, None] * np.einsum(\"...d,...d->...\", along, along)",
         "weights[:, None] * np.ones_like(along[..., 0])"),
        ("least error mirrored at the origin", "return -np.stack([c0 * bx", "return np.stack([c0 * bx"),
        ("mixed terms once", "2 * (Q[..., 1] * x1", "1 * (Q[..., 1] * x1")),
    *of("scanprep/decimation/edge_collapse.py", "scanprep_decimation scanprep_decimation_set",
        ("the vertex of greater error kept", "self.points[b]).sum(axis=1) < value",
         "self.points[b]).sum(axis=1) > value"),
        ("curves may leave their place", "anchored = (self.kinds[a] != self.kinds[b]) | ", "anchored = "),
        ("dearest edges first", "rows = rows[np.argsort(cost[rows])]", "rows = rows[np.argsort(-cost[rows])]"),
        ("triangles may turn over", "bad = _dot(n_old, n_new) < 0.3", "bad = _dot(n_old, n_new) < -2")),
    *of("scanprep/repair/volumetric_diffusion.py", "scanprep_repair_diffusion scanprep_repair_holes",
        ("inside out", "points - at.points, normal) < 0, -1.0, 1.0)", "points - at.points, normal) < 0, 1.0, -1.0)"),
        ("diffusion of first order", "csr_array(laplacian @ laplacian)", "csr_array(laplacian)"),
        ("empty space counts as inside", "np.where(wrong, voxel, distance)", "np.where(wrong, -voxel, distance)")),
    *of("scanprep/repair/hole_patch.py", "scanprep_repair_holes",
        ("curvature by area, not by its root", "np.sqrt(weight / area)", "np.sqrt(weight * area)"),
        ("patches bend where they are told not to", "1 / np.sqrt(1 + (curvature / large) ** 2)",
         "np.sqrt(1 + (curvature / large) ** 2)"),
        ("new triangles face inwards", "ring = loop[::-1] ", "ring = loop[:] "),
        ("new triangles twice as fine", "density * np.linalg.norm", "2 * density * np.linalg.norm")),
    *of("scanprep/fusion/tsdf.py", "scanprep_fusion",
        ("views turned inside out", "(hit - depth) * cosine", "(depth - hit) * cosine"),
        ("distance along the line of sight", "(hit - depth) * cosine", "(hit - depth)"),
        ("the opposite side of a limb disturbed", "np.clip(2 + 2 * ahead / reach, 0, 1)", "1.0"),
        ("sum for mean", "total[which[use]] += w[use] * np.clip", "total[which[use]] += np.clip")),
    *of("scanprep/correspondence/potentials.py", "scanprep_correspondence_correlated",
        ("mirrored directions", "np.cross(gradient[a], gradient[b])",
         "np.cross(gradient[a], -gradient[b]) * np.sign(at)[:, None]"),
        ("directions of no weight", "ANGLES / len(a) * w[:, None]", "0 * w[:, None]"),
        ("robust cost without a limit", "squared / (1 + squared / limit**2)", "squared"),
        ("seeds lie on the other end", "nearer = scan.to_seeds[edges[:, 1]] - scan.to_seeds[edges[:, 0]]",
         "nearer = scan.to_seeds[edges[:, 0]] - scan.to_seeds[edges[:, 1]]")),
    *of("scanprep/correspondence/belief_propagation.py", "scanprep_correspondence_beliefs",
        ("a message comes back to its sender", "_normalise(belief[i] - back)", "_normalise(belief[i])"),
        ("energies as probabilities", "belief = -np.asarray(field.unary", "belief = np.asarray(field.unary"),
        ("tables transposed", "onward = np.exp(-np.ascontiguousarray(field.pairwise.transpose(0, 2, 1)",
         "onward = np.exp(-np.ascontiguousarray(field.pairwise")),
    *of("scanprep/registration/matches.py",
        "scanprep_registration_start scanprep_registration_hahnel scanprep_registration_repair",
        ("force along and across exchanged", "slide * A + (1 - slide) * normals", "(1 - slide) * A + slide * normals"),
        ("Tukey's weight not squared", "np.maximum(1 - (distances / reach) ** 2, 0) ** 2",
         "np.maximum(1 - (distances / reach) ** 2, 0)"),
        ("linear part once", "- 2 * np.sum(self.b * x)", "- np.sum(self.b * x)")),
    *of("scanprep/registration/graph_energy.py",
        "scanprep_registration_hahnel scanprep_registration_nonrigid scanprep_registration_repair",
        ("rotations of nodes turned round", "Ji[..., 4:], Jj[..., 4:] = -rotations.hat(y)",
         "Ji[..., 4:], Jj[..., 4:] = rotations.hat(y)"),
        ("arms of nodes turned round", "J[..., :3] = -rotations.hat(y)", "J[..., :3] = rotations.hat(y)"),
        ("bending measured the wrong way", "rotations.log(motion.R[j] @ motion.R[i].transpose(0, 2, 1))",
         "rotations.log(motion.R[i] @ motion.R[j].transpose(0, 2, 1))"),
        ("strain by length, not squared length", "stiffness**2 * graph.edge_area / squared,",
         "stiffness**2 * graph.edge_area / np.sqrt(squared),")),
    *of("scanprep/registration/final_fit.py", "scanprep_registration_final_fit",
        ("normals tilted the other way", "n - fit[:, 1] * axes[:, 0] - fit[:, 2] * axes[:, 1]",
         "n + fit[:, 1] * axes[:, 0] + fit[:, 2] * axes[:, 1]"),
        ("noise in widths, not metres", "square = width**2 * np.sum", "square = np.sum"),
        ("data beyond the edge of a hole", "(~scan.border[found.index] | (beside <= scan.spacing))",
         "(beside < np.inf)"),
        ("stiffness of a tension, not squared", "(tension * self.size)**2", "(tension * self.size)")),
    *of("scanprep/registration/stretches.py", "scanprep_registration_final_fit",
        ("mean stretch is the area", "0.5 * np.log(area)", "np.log(area)"),
        ("hats turned round", "np.cross(n[:, None], e) / (2 *", "np.cross(e, n[:, None]) / (2 *"),
        ("smoothing by length, not squared", "length**2 * self.stiffness", "length * self.stiffness")),
    *of("scanprep/registration/ground.py", "scanprep_registration_ground",
        ("soles pressed through the floor", "((1 - pressed) * below)", "(-(1 - pressed) * below)"),
        ("a foot of the other kind decides", "against * min(0.0015 / below.max(), 1.0)",
         "against * min(below.max() / 0.0015, 1.0)"),
        ("floor of the side away", "normal *= np.sign(normal @ up)", "normal *= -np.sign(normal @ up)")),
    *of("scanprep/skeleton/parts.py", "scanprep_skeleton_moves scanprep_skeleton_search",
        ("borders between parts at twice the price", "self.width = 0.01 /", "self.width = 0.02 /"),
        ("borders between parts at half the price", "self.width = 0.01 /", "self.width = 0.005 /"),
        ("borders between parts for nothing", "self.width = 0.01 /", "self.width = 0 * 0.01 /"),
        ("price by the number of borders' triangles", "/ share, self.floor)", "* share, self.floor)"),
        ("the parts most apart join first", "[np.argsort(extra[open_], kind=\"stable\")]",
         "[np.argsort(-extra[open_], kind=\"stable\")]"),
        ("how far apart, not its root", "np.sqrt((1 + extra / base) * extra / gain)",
         "(1 + extra / base) * extra / gain")),
    *of("scanprep/skeleton/sides.py", "scanprep_skeleton_search scanprep_skeleton_moves",
        ("borders of one side alone", "(2 if self.tied else 1)", "(1 if self.tied else 1)"),
        ("borders over the middle for nothing", "both += price * self.middle", "both += 0 * self.middle")),
    *of("scanprep/skeleton/labels.py", "scanprep_skeleton_moves",
        ("gain of the label that is left", "costs[:, alpha] - costs[np.arange(len(label)), label]",
         "costs[np.arange(len(label)), label] - costs[:, alpha]"),
        ("prices of a border twice", "(j_turns + i_turns - keep_cost) / unit)",
         "(j_turns + i_turns + keep_cost) / unit)")),
    *of("scanprep/geometry/format_glb.py", "scanprep_geometry_files model_export_conventions",
        ("static GLB turned the other way", "contents.vertices @ turn_up(up).T", "contents.vertices @ turn_up(up)"),
        ("static GLB read the other way", "np.concatenate(vertices) @ turn_up(up_of(tree))",
         "np.concatenate(vertices) @ turn_up(up_of(tree)).T"),
        ("GLB upside down, written and read", "[[1, 0, 0], [0, 0, 1], [0, -1, 0]]]",
         "[[1, 0, 0], [0, 0, -1], [0, 1, 0]]]"),
        ("GLB of what stands along x upside down", "[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]",
         "[[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]")),
    *of("scanprep/geometry/format_common.py", "scanprep_geometry_points scanprep_geometry_files",
        ("inches ten times too long", '"in": 0.0254', '"in": 0.254'),
        ("centimetres as decimetres", '"cm": 1e-2', '"cm": 1e-1')),
    *of("scanprep/plausible.py", "judgement",
        ("betas of one standard deviation only", "2 * gammainccinv", "gammainccinv"),
        ("likely betas fail", "length > TOO_LONG * most", "length < TOO_LONG * most"),
        ("usual betas by their number", "USUAL**2 * count", "USUAL**2 * count**2"),
        ("giants pass", "ANYBODY = (0.65, 2.30)", "ANYBODY = (0.65, 4.60)"),
        ("build by stature, not squared", "build = volume / stature**2", "build = volume / stature"),
        ("a unit wrong by ten", "most: float = 2.5)", "most: float = 25.0)")),
    *of("scanprep/depth_camera/picture.py", "scanprep_depth_camera",
        ("pictures upside down", "(row - K[1, 2]) / K[1, 1]", "(K[1, 2] - row) / K[1, 1]"),
        ("normals away from the camera", "n = -np.linalg.solve", "n = np.linalg.solve"),
        ("middle of a halved picture", "K[:2, 2] -= 0.25", "K[:2, 2] += 0.25")),
    # models: pose and shape
    *of("model/stitching.py", "model_stitching",
        ("edges from the second vertex", "np.r_[one, -one]", "np.r_[one, one]"),
        ("adjoint without the root's place", "pick - np.outer(", "pick + np.outer(")),
    *of("model/gradients.py", "model_gradients model_learning",
        ("w_s of Eq. 5 ten times", "smoothness: float = 0.001", "smoothness: float = 0.01"),
        ("w_s of Eq. 5 half", "smoothness: float = 0.001", "smoothness: float = 0.0005"),
        ("w_s without the edge's length", "self.smoothness * self.template.mean_edge", "self.smoothness"),
        ("w_s by the squared edge", "self.smoothness * self.template.mean_edge",
         "self.smoothness * self.template.mean_edge**2"),
        ("Q smoothed across parts", "self.parts[pairs[:, 0]] == self.parts[pairs[:, 1]]",
         "self.parts[pairs[:, 0]] >= 0"),
        ("transposed Q", "x.reshape(F, 3, -1, 3).transpose(2, 0, 3, 1)",
         "x.reshape(F, 3, -1, 3).transpose(2, 0, 1, 3)"),
        ("neighbours pushed apart", "coo_array((-np.ones(2 * len(a))", "coo_array((np.ones(2 * len(a))")),
    *of("model/shape_space.py", "model_shape_space",
        ("betas not in standard deviations", "@ rows / np.sqrt(count)", "@ rows"),
        ("heavier people have less of it", "modes[:, :K] < 0, -1, 1)", "modes[:, :K] < 0, 1, -1)"),
        ("smallest components first", "np.maximum(variances[::-1], 0), modes[:, ::-1]",
         "np.maximum(variances, 0), modes"),
        ("betas found without their size", "/ (flat**2).sum(axis=1)", "/ np.sqrt((flat**2).sum(axis=1))")),
    *of("model/pose_space.py", "model_pose_space",
        ("the farthest joints", "np.argsort(far, axis=1", "np.argsort(-far, axis=1"),
        ("axes of least variance", "axes[:, ::-1][:, variance[::-1]", "axes[:, variance[::-1]"),
        ("standard deviation for variance", "variance[::-1] >= max(threshold",
         "np.sqrt(variance[::-1]) >= max(threshold")),
    *of("model/learning/regression.py", "model_regression",
        ("ridge that fades with the poses", "M * design.ridge", "design.ridge"),
        ("constant of the wrong side", "(mean - centre @ slope)", "(mean + centre @ slope)"),
        ("left-out poses know their own mean", "+ 1 / len(X)", "+ 0 / len(X)"),
        ("SVR with the penalty turned over", "C=1 / max(M * ridge, 1e-12)", "C=M * ridge")),
    *of("model/features.py", "model_features",
        ("derivative of quaternions", "by_turn = np.concatenate([w * np.eye(3) + rotations.hat(v)",
         "by_turn = np.concatenate([w * np.eye(3) - rotations.hat(v)"),
        ("squares counted twice", "t[..., _FIRST] * t[..., _SECOND]",
         "t[..., _FIRST] * t[..., _SECOND] * (1 + (_FIRST == _SECOND))")),
    *of("model/fitting/vertices.py", "model_fitting",
        ("weights for their roots", "if weights is None else np.sqrt(weights)", "if weights is None else weights"),
        ("pose pulled away", "np.concatenate([by_pose, force", "np.concatenate([-by_pose, force"),
        ("place pulled away", "force.sum(axis=0), by_betas", "-force.sum(axis=0), by_betas")),
    *of("model/priors.py", "completion_priors completion_energy model_posing completion_partial",
        ("covariance shrunk the other way", "(1 - shrinkage) * inner + np.diag(shrinkage *",
         "shrinkage * inner + np.diag((1 - shrinkage) *"),
        ("floor as a variance", "np.diag(inner) + FLOOR**2)", "np.diag(inner) + FLOOR)"),
        ("covariance for precision", "np.linalg.inv(np.linalg.cholesky(safe))", "np.linalg.cholesky(safe)")),
    *of("model/products.py", "model_scape model_conformance",
        ("turn per parameter without its Jacobian", "turn = R @ rotations.right_jacobian(pose)", "turn = R"),
        ("turned the other way", "columns += rotations.hat(", "columns -= rotations.hat(")),
    *of("model/skinning.py", "model_conformance model_learning_skin",
        ("joints turned the other way", "turns = R[self.skeleton.parents] - R", "turns = R - R[self.skeleton.parents]"),
        ("bones in the axes of the child", "R[parent] @ (joints[j] - joints[parent])",
         "R[j] @ (joints[j] - joints[parent])")),
    *of("model/motion/bvh.py", "model_motions_foreign model_motions model_export_bvh",
        ("turns about fixed axes", '"XYZ"[channels[k][1]]', '"xyz"[channels[k][1]]'),
        ("the child's turn first", "R[:, p] @ own", "own @ R[:, p]"),
        ("bones in the axes of the child", "R[:, p], steps[:, j])", "R[:, j], steps[:, j])"),
        ("units turned over", "metre = metres_of(unit)", "metre = 1 / metres_of(unit)"),
        ("channels that mean the other thing", "changes = off[1] < off[0]", "changes = off[1] > off[0]")),
    *of("model/export/bvh.py", "model_export_bvh",
        ("degrees of another order", "axis=0, period=360)", "axis=0, period=180)"),
        ("offsets of the parent", "joints[j] - joints[parent] if j", "joints[parent] - joints[j] if j")),
    *of("model/export/glb.py", "model_export_files model_export_conventions",
        ("inverse bind matrices of the other side", "inverse[:, 3, :3] = -np.einsum", "inverse[:, 3, :3] = np.einsum"),
        ("axes transposed", "inverse[:, :3, :3] = rig.axes", "inverse[:, :3, :3] = rig.axes.swapaxes(1, 2)"),
        ("clock turned over", "np.arange(len(poses)) / rate", "np.arange(len(poses)) * rate")),
    *of("model/measurement/section.py", "model_measurement",
        ("a tape shorter than its chord", "bend**2 / 24", "-bend**2 / 24"),
        ("bulge inwards", "return -t * (1 - t) * mixed", "return t * (1 - t) * mixed"),
        ("places from the other end", "share = first / (first - second)", "share = second / (second - first)"),
        ("centroid by points", "(2 * steps.sum())", "(2 * len(steps) * steps) * 0 + 1 / len(steps)")),
    *of("model/measurement/reading.py", "model_measurement",
        ("plane that stands still", "on_edge = pull - out[:, None] * cut.normal", "on_edge = pull"),
        ("plane that turns the other way", "by_normal = -(out @", "by_normal = (out @"),
        ("height below the floor", "float(place @ up) - floor + longer", "float(place @ up) + floor + longer")),
    *of("model/measurement/measure.py", "model_measurement",
        ("errors of one direction", "reading.force / np.sqrt(3)", "reading.force"),
        ("reach of what errors have in common, twice", "REACH = 0.15", "REACH = 0.30"),
        ("reach of what errors have in common, half", "REACH = 0.15", "REACH = 0.075"),
        ("place adds", "(PLACE * reading.slope)**2", "(PLACE * reading.slope)")),
    *of("model/measurement/wanted.py", "model_measurement",
        ("norm without conditions", "_not_too_far(S, off + S @ z)", "_not_too_far(S, off - S @ z)"),
        ("rarer by one too few", "chi2.sf(far**2, free)", "chi2.sf(far, free)")),
    *of("model/statue/detail/subdivision.py", "model_statue_displacement",
        ("level of detail of edges alone", "bent[edge[inside]] = True", "bent[edge[inside]] |= False"),
        ("level of detail of triangles alone", "along, displaced) > tolerance", "along, displaced) > np.inf"),
        ("three places inside a triangle not looked at", "[(2, 2, 2), (4, 1, 1), (1, 4, 1), (1, 1, 4)]", "[(2, 2, 2)]"),
        ("longer diagonals", "8 * (other < one)", "8 * (other > one)"),
        ("tolerance by the mean", "axis=2).max(axis=1)", "axis=2).mean(axis=1)")),
    *of("model/statue/detail/normal_volume.py", "model_statue_displacement",
        ("below for above", "p + heights[:, None] * n", "p - heights[:, None] * n"),
        ("cubic of Eq. 19, one term", "det(p, b, c) + det(a, q, c) + det(a, b, r)",
         "det(p, b, c) + det(a, q, c) - det(a, b, r)"),
        ("the greatest height", 'order = np.argsort(np.abs(d), kind="stable")',
         'order = np.argsort(-np.abs(d), kind="stable")'),
        ("sheets met from inside", "outside = found.cosines > 0", "outside = found.cosines < 0"),
        ("heights through the other side", "0.75 * np.nan_to_num", "1.5 * np.nan_to_num"),
        ("triangles inverted by half their height", "(0.25, 0.5, 0.75, 1.0)", "(0.25, 0.5)")),
    *of("model/statue/detail/displacement.py", "model_statue_displacement",
        ("tears three times finer", "np.maximum(3.0 * apart, 0.003)", "np.maximum(1.0 * apart, 0.001)"),
        ("heights outside of the scan are folds", "(~inside & (nearest.distances > 0.01))",
         "(inside & (nearest.distances > 0.01))"),
        ("holes filled with what is there", "filled[rest] = lattice.sample(values",
         "filled[rest] = 0 * lattice.sample(values")),
    *of("model/statue/detail/texels.py", "model_statue_displacement model_statue_control model_statue_files",
        ("seams as borders of the mesh", "== 1, other[face, side], -1)", "== 1, -1, -1)"),
        ("the place beyond a seam from the other end", "place[rows, t] = along - share * foot",
         "place[rows, t] = 1 - along - share * foot"),
        ("holes known from half of their pixels", "bilinear(sure, uv) > 1 - 1e-9", "bilinear(sure, uv) > 0.4"),
        ("relief with y down", "B = np.cross(N, T) * side", "B = np.cross(T, N) * side")),
    *of("model/statue/registration/soft_assignment.py", "model_statue_surface",
        ("the farther the surer", "log_k = -squared[known] / temperature", "log_k = squared[known] / temperature"),
        ("distances for their squares", "apart, order, axis=1) ** 2, np.inf", "apart, order, axis=1), np.inf")),
    *of("model/statue/registration/local_shape.py", "model_statue_surface",
        ("force of Eq. 12 turned round", "return -self._sum_rows(self.held", "return self._sum_rows(self.held"),
        ("vertices of many frames count more", "1 / np.bincount(self.held, minlength=self.count)[self.held]",
         "np.ones(len(self.held))"),
        ("heights by the area", "/ size**1.5", "/ size**2"),
        ("slope of the height", "/ (2 * size**2), 0.0)", "/ size**2, 0.0)")),
    *of("model/statue/registration/surface_fit.py", "model_statue_surface",
        ("data and shape exchanged", "+ (self.shape.paper_force(x) if self.published else -0.5",
         "- (self.shape.paper_force(x) if self.published else -0.5"),
        ("points of the scan weigh by their number", "COVER * len(x) / len(found.faces)", "COVER"),
        ("data pull along the edge of a hole", 'np.einsum("ni,nj->nij", n, n), np.eye(3))', "np.eye(3), np.eye(3))")),
    # completion, motion capture
    *of("model/fitting/energy.py", "completion_energy completion_mosh_terms completion_priors",
        ("markers below the skin", "p[..., 0, :] + lift * n, J", "p[..., 0, :] - lift * n, J"),
        ("leaning turned round", "J[..., :3] = -rotations.hat(axis)", "J[..., :3] = rotations.hat(axis)"),
        ("outliers lose by the first power", "(scale**2 / (scale**2 + distance**2))**2",
         "scale**2 / (scale**2 + distance**2)"),
        ("weights of priors not rooted", "r = np.sqrt(weight) * x[..., first:]", "r = weight * x[..., first:]"),
        ("twists from the wrong side", "Residual(root * (x - expected)", "Residual(root * (x + expected)")),
    *of("completion/smoothing.py", "completion_animation",
        ("velocity for acceleration", "enumerate((1.0, -2.0, 1.0))", "enumerate((1.0, -1.0, 0.0))"),
        ("inertia by the rate, not squared", "return (rate**2 / sd)**2", "return (rate / sd)**2"),
        ("places with the weight of angles", "sd[-3:] = place", "sd[:3] = place")),
    *of("completion/partial/alternation.py", "completion_alternation",
        ("w_T of Eq. 11 twice", "sign * w_T * np.eye(3)", "2 * sign * w_T * np.eye(3)"),
        ("w_T of Eq. 11 half", "sign * w_T * np.eye(3)", "0.5 * sign * w_T * np.eye(3)"),
        ("w_T of Eq. 11 left out", "sign * w_T * np.eye(3)", "0 * sign * w_T * np.eye(3)"),
        ("neighbours turned against each other", "(j, p, -1), (p, j, -1)", "(j, p, 1), (p, j, 1)"),
        ("twists turned round", "right = np.cross(e, v)", "right = np.cross(v, e)"),
        ("w_Z of one landmark for all", "w_Z / one * np.concatenate", "np.concatenate")),
    *of("model/fitting/scan_fit.py", "completion_search completion_results completion_partial completion_depth_picture",
        ("w_T of joints left out", "held = np.full(len(x), self.config.twist_weight)",
         "held = np.full(len(x), 0 * self.config.twist_weight)"),
        ("w_T of joints twice", "held = np.full(len(x), self.config.twist_weight)",
         "held = np.full(len(x), 2 * self.config.twist_weight)"),
        ("shape gives way after pose", "stiff = max(1.0, reach / 0.04)", "stiff = 1.0"),
        ("landmarks by sd, not variance",
         "free = self.skin(x), np.full(len(self.vertices), self.config.landmark_sd**-2)",
         "free = self.skin(x), np.full(len(self.vertices), 1 / self.config.landmark_sd)"),
        ("matches of far points count the same", "energy.geman_mcclure(distance, max(reach / 2, 0.015))", "1.0"),
        ("skin over clothes for under", "skin.places[ids] - target) < 0", "skin.places[ids] - target) > 0"),
        ("borders of the scan match", "back.valid & ~self.cloud.border[hit] &", "back.valid &")),
    *of("model/fitting/free_space.py", "completion_scan completion_partial completion_masks completion_views",
        ("behind for in front", "np.isfinite(front), front - far, 0.0)", "np.isfinite(front), far - front, 0.0)"),
        ("pushed towards the camera", "[:, None], -away / far[:, None])", "[:, None], away / far[:, None])"),
        ("skin pressed twice as deep", "PRESSED = 0.12, 0.015", "PRESSED = 0.12, 0.030"),
        ("clothing inside the body", "np.maximum(out - NOISE, 0), 0.0)", "np.maximum(-out - NOISE, 0), 0.0)"),
        ("the camera that objects least", "worst, each = np.argmax(", "worst, each = np.argmin(")),
    *of("model/fitting/hems.py", "model_not_skin",
        ("hems step outward", "for sign in (1, -1))", "for sign in (-1, 1))"),
        ("a hem of one limb is enough", "np.minimum(steps[0]", "np.maximum(steps[0]"),
        ("clothes below their hems", "limb.along < place for", "limb.along > place for"),
        ("shoes for boots", "limb.length - ANKLE for", "limb.length + ANKLE for")),
    *of("model/fitting/inside.py", "model_not_skin",
        ("what hangs together with nothing", "if (piece & worn.vertices).any()", "if not piece[worn.vertices].any()"),
        ("bare parts are masked", "masked[cloud.index[bare]] = False", "masked[cloud.index[~bare]] = False")),
    *of("model/fitting/not_skin.py", "model_not_skin",
        ("backs for fronts", "(trunk | head) & (ahead < 0)", "(trunk | head) & (ahead > 0)"),
        ("inside for outside", "near.distances, -near.distances)", "-near.distances, near.distances)"),
        ("every piece a core", "areas[piece & (out > core)].sum() > PIECE_CORE", "areas[piece].sum() > PIECE_CORE")),
    *of("model/fitting/confidence.py", "completion_confidence",
        ("errors set in twice as far", "np.exp(-away / 0.014)", "np.exp(-away / 0.028)"),
        ("errors set in half as far", "np.exp(-away / 0.014)", "np.exp(-away / 0.007)"),
        ("errors add without squares", "(1.4 * posterior)**2 + beyond**2", "(1.4 * posterior + beyond)**2"),
        ("errors of one direction", "gammainc(1.5, 1.5 * (tolerance", "gammainc(0.5, 0.5 * (tolerance"),
        ("what the fit believes taken for true", "(1.4 * posterior)", "(1.0 * posterior)"),
        ("far from data as sure as the model's left-out poses", "left_out_share = 0.85", "left_out_share = 0.425")),
    *of("model/fitting/scale.py", "completion_views",
        ("scale turned over", "factor = float(np.exp(LOOSE * x[-1]))", "factor = float(np.exp(-LOOSE * x[-1]))"),
        ("slope of the scale", "-LOOSE * off[..., None]", "LOOSE * off[..., None]")),
    *of("completion/mocap/subject/attachment.py", "completion_mosh_terms",
        ("sign of Eq. 18", "off, normal) < 0, -best, best)", "off, normal) < 0, best, -best)"),
        ("Eq. 18 without a sign", "off, normal) < 0, -best, best)", "off, normal) < 0, best, best)"),
        ("normal by the edges exchanged", "-tangent @ rotations.hat(b), tangent @ rotations.hat(a)",
         "tangent @ rotations.hat(b), -tangent @ rotations.hat(a)"),
        ("Eq. 18 does not move its triangle", "-share[..., None] * direction[:, None]",
         "0 * share[..., None] * direction[:, None]")),
    *of("completion/mocap/subject/latent_fit.py", "completion_mosh_terms completion_mosh_person",
        ("E_theta not annealed", "factor * self.config.pose)", "self.config.pose)"),
        ("E_beta not annealed", "factor * c.shape)", "c.shape)"),
        ("E_I not annealed", "factor * self.place_weight)", "self.place_weight)"),
        ("E_S annealed", "state.greatest, c.surface)", "state.greatest, factor * c.surface)"),
        ("weights per square metre", "CENTIMETRES = 100.0", "CENTIMETRES = 1.0"),
        ("published weight of E_S", "surface=100.0, initial=0.25", "surface=10.0, initial=0.25"),
        ("published weight of E_beta", "initial=0.25, published=True", "initial=0.25, shape=0.5, published=True"),
        ("wands inwards", "np.where(free, distances + wand, distances)", "np.where(free, distances - wand, distances)"),
        ("bars never on the skin", "np.where(free, np.minimum(distances, DISTANCE), distances)", "distances"),
        ("wands of every marker", "np.isin(layout.labels, layout.wands) |", "np.isfinite(distances) |"),
        ("both sides of a pair by one", "(r + r[pairs]) / 2", "r"),
        ("loose markers held as the others", "np.where(self.loose, min(0.0025, config.initial)",
         "np.where(self.loose, max(0.0025, config.initial)")),
    *of("completion/mocap/subject/person.py", "completion_mosh_person",
        ("a hand's width doubled", "if moved > 0.08", "if moved > 0.16"),
        ("frames that differ least", "count, np.argmin((apart**2)", "count, np.argmax((apart**2)")),
    *of("completion/mocap/soft_tissue/follow.py", "completion_mosh_soft",
        ("lambda_u not rooted", "RATE**2 / np.sqrt(config.velocity)", "RATE**2 / config.velocity"),
        ("lambda_u turned over", "RATE**2 / np.sqrt(config.velocity)", "RATE**2 * np.sqrt(config.velocity)"),
        ("weights per square metre", "self.weight = config.data * 1e4", "self.weight = config.data * 1e2"),
        ("shares for their roots", "S, one = np.sqrt(share)", "S, one = share"),
        ("published lambda_u half", "velocity=6.25", "velocity=3.125"),
        ("published lambda_Delta twice", "shape_change=0.25)", "shape_change=0.5)"),
        ("published lambda_theta half", "pose=1.0, velocity", "pose=0.5, velocity"),
        ("smoothness that depends on the rate", "(markers.rate / RATE)**4", "(markers.rate / RATE)**2"),
        ("soft tissue as large as the prior", "LOOSE = 3.0", "LOOSE = 1.0"),
        ("variance of one coordinate", "/ (3 * np.maximum(share", "/ (1 * np.maximum(share"),
        ("noise not taken off", "variances(off, share) - sd**2", "variances(off, share) + sd**2")),
    *of("completion/mocap/soft_tissue/soft_tissue.py", "completion_mosh_soft",
        ("root turned the other way", "moved @ np.swapaxes(rotations.exp(poses[:, 0]), -1, -2)",
         "moved @ rotations.exp(poses[:, 0])"),
        ("bell of another width", "np.exp(-0.5 * (distances / reach)**2)", "np.exp(-(distances / reach)**2)")),
    *of("completion/mocap/pose/marked_body.py", "completion_stream completion_mosh_artefacts completion_animation",
        ("sd for variance", "return share / sd**2, share > 0.25", "return share / sd, share > 0.25")),
    *of("completion/mocap/pose/judgement.py", "completion_stream",
        ("speed by steps", "* markers.rate / step if len", "/ markers.rate * step if len")),
    *of("completion/mocap/pose/foot_contact.py", "completion_stream",
        ("a foot held still in the air", "(self.floor.above(calm) < self.TOUCH) & (speed < 0.2)", "(speed < 0.2)"),
        ("a foot held while it slides", "(self.floor.above(calm) < self.TOUCH) & (speed < 0.2)",
         "(self.floor.above(calm) < self.TOUCH)"),
        ("speed by frames", "axis=2) * rate", "axis=2)"),
        ("sunk points sink more", "points - height[..., None] * self.floor.normal",
         "points + height[..., None] * self.floor.normal"),
        ("standing points by sd", "0.002**-2", "0.002**-1")),
    *of("completion/mocap/pose/stream.py", "completion_stream",
        ("prediction without velocity", "self.body.retract(self.x, m * self.velocity)",
         "self.body.retract(self.x, 0 * self.velocity)"),
        ("velocity turned round", "self.body.step_to(self._expected, x) @ gain",
         "self.body.step_to(x, self._expected) @ gain"),
        ("noise for information", "self.noise = 1 / config.inertia", "self.noise = config.inertia"),
        ("velocity as sure as if it had been measured twice", "cross.T @ gain + gain.T @ known",
         "cross.T @ gain - gain.T @ known")),
    *of("completion/mocap/pose/follow.py", "completion_stream completion_animation",
        ("filter of first order", "butter(2, cutoff, fs=rate", "butter(1, cutoff, fs=rate"),
        ("cutoff against half the rate", "butter(2, cutoff, fs=rate", "butter(2, cutoff, fs=2 * rate"),
        ("signs of quaternions not followed", "np.cumsum(turned, axis=0) % 2, -1.0, 1.0)", "turned, -1.0, 1.0)")),
    *of("completion/mocap/pose/swaps.py", "completion_mosh_tracks completion_mosh_artefacts completion_stream",
        ("swaps of a stream without hysteresis, late", "ENTER, LEAVE = 0.5, 1.0", "ENTER, LEAVE = 0.5, 0.5"),
        ("swaps of a stream without hysteresis, early", "ENTER, LEAVE = 0.5, 1.0", "ENTER, LEAVE = 1.0, 1.0"),
        ("changes of a label for nothing", "CHANGE = 4.0", "CHANGE = 0.0"),
        ("distances not squared", "squared / (2 * deviation**2)", "np.sqrt(squared) / (2 * deviation**2)"),
        ("gap without acceleration", "0.5 * acceleration * ((gap - 1) / self.rate)**2", "0.0"),
        ("swaps that lose", "own[:, a] + own[:, b] - (0.0 if", "-own[:, a] - own[:, b] + (0.0 if")),
    *of("completion/mocap/pose/coverage.py", "completion_coverage",
        ("all markers but eight", "len(self.used) < fewest", "len(self.used) > fewest"),
        ("half of the markers", "0.5 * self.count", "self.count / 0.5"),
        ("parts that were seen", "area[~told].sum() / area.sum()", "area[told].sum() / area.sum()"),
        ("one neighbour tells", "told | (count >= 2)", "told | (count >= 1)")),
    *of("completion/mocap/files/c3d.py", "completion_markers_c3d completion_markers_files completion_markers_foreign",
        ("DEC numbers four times too large", "astype(np.float64) / 4", "astype(np.float64)"),
        ("whole numbers without scale", "(1.0 if table.kind == \"f4\" else table.scale)\n    positions[",
         "1.0\n    positions["),
        ("written in metres", "1000 * positions.transpose(2, 1, 0)", "positions.transpose(2, 1, 0)"),
        ("computed points taken for missing", "(words[..., 3] < 0) |", "(words[..., 3] <= 0) |")),
    *of("completion/mocap/files/text.py", "completion_markers_files completion_markers_foreign",
        ("TRC written in metres", "(1000 * positions).reshape", "(1 * positions).reshape"),
        ("rate turned over", "round(1 / typical, 6)", "round(typical, 6)")),
    *of("completion/mocap/joint_angles.py", "completion_opensim",
        ("left limbs as right ones", "relative = _MIRROR @ relative @ _MIRROR", "relative = _MIRROR @ relative"),
        ("forearms turned the other way", 'np.pi / 2 if side == "r" else -np.pi / 2',
         '-np.pi / 2 if side == "r" else np.pi / 2'),
        ("angles of the inverse", "proximal.swapaxes(1, 2) @ axes[joint.distal]", "proximal @ axes[joint.distal]"),
        ("a break goes on", "> 2 * np.pi / 3) + 1", "> 20 * np.pi / 3) + 1"),
        ("limbs along their parts only", "axes[moved] = turn @ axes[moved]", "turn @ axes[moved]"),
        ("radians for degrees", "np.degrees(np.concatenate(columns", "np.asarray(np.concatenate(columns")),
    *of("completion/mocap/retargeting/soft_tissue.py", "completion_mosh_characters",
        ("soles below the ground", "trans[:, up] += sign * (fixed", "trans[:, up] -= sign * (fixed"),
        ("deformation of the least stretch", "np.abs(stretches - 1).max(axis=0)", "np.abs(stretches - 1).min(axis=0)")),
)


def stands_once(mutation: Mutation, root: Path = ROOT) -> bool:
    """Whether the text of a mutation stands exactly once in its file."""
    return (root / mutation.path).read_text(encoding="utf-8").count(mutation.before) == 1


def _run_pytest(root: Path, name: str, said: Path) -> None:
    """In a process of its own, which has the libraries but nothing of the packages yet: a file of tests of a copy."""
    os.chdir(root)
    sys.path[:0] = paths = [str(root), str(root / "tests")]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)            # of processes that tests start
    os.environ.pop("SCAPEKIT_DATA", None)
    with said.open("w") as out:
        os.dup2(out.fileno(), 1)
        os.dup2(out.fileno(), 2)
    code = pytest.main(["-x", "-n0", "-q", "-p", "no:cacheprovider", "--tb=line", name])
    sys.stdout.flush()
    os._exit(int(code))


class Copy:
    """A copy of the checkout, in which mutations are made."""

    def __init__(self, folder: Path) -> None:
        self.root, self._passes = folder / "checkout", dict[str, tuple[bool, str]]()
        shutil.copytree(ROOT, self.root, ignore=shutil.ignore_patterns(".*", "*.egg-info", "build", "results",
                                                                       "__pycache__"))

    def run(self, tests: str) -> tuple[bool, str]:
        """Whether all of some tests pass, file by file in this order, and the first that does not."""
        for word in tests.split():
            passed, failing = self._run_file(f"tests/test_{word}.py")
            if not passed:
                return False, failing
        return True, ""

    def _run_file(self, name: str) -> tuple[bool, str]:
        said = self.root.parent / "said.txt"
        process = multiprocessing.get_context("fork").Process(target=_run_pytest, args=(self.root, name, said))
        process.start()
        process.join(LONGEST)
        if process.is_alive():
            process.kill()
            process.join()
            return False, f"{name}: more than {LONGEST} s"
        text = said.read_text(errors="replace")
        found = re.search(r"^(?:FAILED|ERROR) (\S+)", text, re.MULTILINE)
        return process.exitcode == 0, found[1] if found else "" if process.exitcode == 0 else text[-300:]

    def noticed(self, mutation: Mutation) -> dict[str, object]:
        """What the tests of a mutation say of it."""
        if mutation.tests not in self._passes:
            self._passes[mutation.tests] = self.run(mutation.tests)
        whole, failing = self._passes[mutation.tests]
        row: dict[str, object] = {"file": mutation.path, "mutation": mutation.name}
        if not whole:
            return {**row, "noticed": None, "test": f"fails without it: {failing}"}
        begin, text = time.perf_counter(), (self.root / mutation.path).read_text(encoding="utf-8")
        assert text.count(mutation.before) == 1, f"{mutation.path}: {mutation.before!r} does not stand there once"
        changed = text.replace(mutation.before, mutation.after)
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text)), f"{mutation.name}: no other program"
        try:
            self._write(mutation.path, changed)
            passed, test = self.run(mutation.tests)
        finally:
            self._write(mutation.path, text)
        return {**row, "noticed": not passed, "test": test, "seconds": time.perf_counter() - begin}

    def _write(self, name: str, text: str) -> None:
        """Write a module, whose compiled form tells the age of its source in whole seconds only and so has to go."""
        path = self.root / name
        path.write_text(text, encoding="utf-8")
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], help="words of which file or name of a mutation have one")
    parser.add_argument("--show", action="store_true", help="print the table of mutations and end")
    parser.add_argument("-o", "--output", help="JSON file")
    args = parser.parse_args()
    chosen = [m for m in MUTATIONS if not args.only or any(word in f"{m.path}: {m.name}" for word in args.only)]
    if args.show:
        print(*(f"{m.path}: {m.name}\n  - {m.before}\n  + {m.after}" for m in chosen), sep="\n")
        return
    # the checkout's own packages must not be there when processes load those of the copy
    sys.path[:] = [path for path in sys.path if Path(path or ".").resolve() not in (ROOT, ROOT / "tests")]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for mutation in chosen:
            rows.append(copy.noticed(mutation))
            print(*rows[-1].values(), sep=" | ", flush=True)
    known = [row for row in rows if row["noticed"] is not None]
    survived = [f"{row['file']}: {row['mutation']}" for row in known if not row["noticed"]]
    print(f"{len(known) - len(survived)} of {len(known)} noticed; survived: {'; '.join(survived) or 'none'}")
    if args.output:
        sys.path.insert(0, str(ROOT))
        from protocols import machine, write_report

        write_report(args.output, {"protocol": "mutations of the mathematics, each against the tests of its module",
                                   "machine": machine(), "noticed": len(known) - len(survived), "of": len(known),
                                   "survived": survived, "rows": rows})


if __name__ == "__main__":
    main()
