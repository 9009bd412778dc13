"""Find the body parts of a template that is a person, by registering the average synthetic person to it.

This needs no scan and no other pose. So a template has named parts and joint angles, which can be compared with those
of people, before its first scan is registered.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations
from weakref import WeakKeyDictionary

import numpy as np

from ..correspondence.correlated import find_correspondences, find_path_ends, find_seeds
from ..geometry.format_glb import tallest
from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh
from ..geometry.surface import Surface
from ..skeleton.tree import Skeleton
from ..synthetic.people import PARENTS, PARTS, SyntheticPerson
from .nonrigid import Registration, register, share_stretched
from .schedule import RegistrationConfig

# Log ratios of the ten paths between head, two hands and two feet to those of the average person, apart from the common
# scale: their ranges over 71 SCAPE poses, 57 SPRING people and 124 synthetic ones, from 1.2 to 2.1 m and thin to heavy.
# In turn: head to hands, head to feet, hand to hand, hands to feet, foot to foot.
LEAST = np.array([-0.216] * 2 + [-0.049] * 2 + [-0.251] + [-0.062] * 4 + [-0.145])
MOST = np.array([0.071] * 2 + [0.141] * 2 + [0.063] + [0.167] * 4 + [0.093])
# How far outside them a body is no person. One of these sets of people lies up to 0.11 outside the ranges of the
# others, so with five ends it must be more. No person of them has a sixth end; of the test animals 16 in 20 lie over
# 0.02 outside with theirs, the tail.
BEYOND, BEYOND_WITH_TAIL = 0.2, 0.02


@dataclass(frozen=True, eq=False)
class PersonParts:
    """The parts of a template, those of the synthetic people.

    Rotations R_template_rest (16, 3, 3) take every part of the synthetic people from its rest pose to the template.
    """

    skeleton: Skeleton
    R_template_rest: np.ndarray


def person_parts(template: Mesh, progress: Callable[[int, int], None] | None = None) -> PersonParts | None:
    """Find the parts of a template; None where the average person does not fit it: an animal, a hand, half a body.

    `progress` is called as progress(done, total). The result is cached as long as the template lives.
    """
    if template not in _known:
        _known[template] = _find_parts(template, progress or (lambda done, total: None))
    return _known[template]


_known: WeakKeyDictionary[Mesh, PersonParts | None] = WeakKeyDictionary()


def stature(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> float:
    """Estimate the stature of a person in any pose, metres: the template's, scaled by the total length of the bones.

    `vertices` (N, 3), metres, are those of the registered template.
    """
    regressor, parents = parts.skeleton.joint_regressor(template), parts.skeleton.parents

    def bones(body: np.ndarray) -> float:
        joints = regressor @ body
        return float(np.linalg.norm(joints[1:] - joints[parents[1:]], axis=1).sum())

    height = float(np.ptp(template.vertices[:, tallest(template.vertices)]))
    return height * bones(vertices) / bones(template.vertices)


def _find_parts(template: Mesh, report_progress: Callable[[int, int], None]) -> PersonParts | None:
    """Find the parts of a template that is not in the cache."""
    person = average_person()
    if np.array_equal(template.faces, person.mesh.faces):
        # the template has the triangles of the synthetic people: no registration is needed
        part_of_face, vertices = person.part_of_face, template.vertices
    else:
        fit = _person_on(template, report_progress)
        if fit is None:
            return None
        # each triangle takes the part of the nearest triangle of the registered average person
        nearest = Surface(fit.mesh).closest(template.corners.mean(axis=1)).faces
        part_of_face, vertices = person.part_of_face[nearest], fit.mesh.vertices
    if len(np.unique(part_of_face)) < len(PARTS):
        return None
    joints = person.skeleton.joint_regressor(person.mesh) @ vertices
    return PersonParts(Skeleton(part_of_face, PARENTS, joints, PARTS),
                       person.skeleton.fit_rotations(person.mesh, vertices))


def has_limbs(template: Mesh) -> bool:
    """Test whether a template has five limb ends, as the head, hands and feet of a person, in a person's proportions.

    What is surely no person is told in less than a second, most animals among it.
    """
    if is_no_person(template):
        return False
    try:
        return len(find_seeds(average_person().mesh, template)) >= 5
    except ValueError:             # it has too few ends of limbs
        return False


def is_no_person(template: Mesh) -> bool:
    """Test whether the paths along the surface between the ends of limbs are surely not those of a person.

    Posing hardly changes these paths. False where they tell nothing: fewer than five ends, or a surface with handles,
    as of hands that are one with the hips.
    """
    V, E, F = len(template.vertices), len(template.edges), len(template.faces)
    if V - E + F + len(template.boundary_loops) < 2:
        return False
    paths = _limb_paths(template)
    if len(paths) < 5:
        return False
    # log ratios to the average person, apart from the common scale, of every choice of head, hands and feet
    choices = np.array(list(permutations(range(len(paths)), 5)))
    a, b = np.triu_indices(5, 1)
    ratio = np.log(paths[choices[:, a], choices[:, b]] / _paths_of_person()[a, b])
    ratio -= ratio.mean(axis=1, keepdims=True)
    beyond = np.maximum(LEAST - ratio, ratio - MOST).max(axis=1).min()
    # people have no sixth end; what has one, such as a tail, may lie less far beyond their ranges
    return bool(beyond > (BEYOND if len(paths) == 5 else BEYOND_WITH_TAIL))


@lru_cache(maxsize=4)
def _limb_paths(template: Mesh) -> np.ndarray:
    """Compute path lengths (E, E) between at most seven ends of a template, in units of √area."""
    size = float(np.sqrt(template.face_areas.sum()))
    # ends as of `find_seeds`; 16 samples find those of 64, in a third of the time
    ends, paths = find_path_ends(template.vertices, SurfaceGraph(template).distances, 7, 0.28 * size, 16)
    return paths[:, ends] / size


@lru_cache(maxsize=1)
def _paths_of_person() -> np.ndarray:
    """Compute path lengths (5, 5) between head, hands and feet of the average person."""
    person = average_person()
    size = float(np.sqrt(person.mesh.face_areas.sum()))
    ends, paths = find_path_ends(person.mesh.vertices, SurfaceGraph(person.mesh).distances, 5, 0.28 * size, 16)
    order = np.argsort(person.part_of_vertex[ends])
    return paths[order][:, ends[order]] / size


def _person_on(template: Mesh, report_progress: Callable[[int, int], None]) -> Registration | None:
    """Register the average person to a template by the ends of its limbs; None where it does not fit."""
    if not has_limbs(template):
        return None
    person = average_person().mesh
    matching = 30  # per cent of the progress bar; registration takes the rest
    seeds = find_seeds(person, template)
    pairs = find_correspondences(person, template, (seeds.template_vertices, seeds.scan_points),
                                 progress=lambda done, total: report_progress(round(matching * done / total), 100))
    fit = register(person, template, None, RegistrationConfig(), correspondences=pairs, progress=lambda done,
                   total: report_progress(round(matching + (100 - matching) * done / total), 100))
    # no person: more than 2% of the template uncovered, or more than 5% of the average person stretched to the double
    return None if fit.uncovered > 0.02 or share_stretched(person, fit.mesh) > 0.05 else fit


@lru_cache(maxsize=1)
def average_person() -> SyntheticPerson:
    """Return the average synthetic person, to which templates are compared."""
    return SyntheticPerson()
