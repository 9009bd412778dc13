"""The parts of a template that is a person: the average of the synthetic people, brought onto it.

No scan and no pose but the template's own is needed, so a body has named parts, and angles of its joints that can be
compared with those of people, before its first scan is registered.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np

from ..correspondence.correlated import find_correspondences, find_seeds
from ..geometry.mesh import Mesh
from ..geometry.surface import Surface
from ..skeleton.tree import Skeleton
from ..synthetic.people import PARENTS, PARTS, Person
from .nonrigid import register, stretched_share

UNCOVERED, STRETCHED = 0.02, 0.05      # shares of a template and of the person on it beyond which it is no person
MATCHING = 30                          # per cent of the time, before the person is registered
ENDS = 5                               # of limbs: head, hands and feet
NAMES = tuple(f"{part[2:]}_{'left' if part[0] == 'l' else 'right'}" if part[1] == "_" else part for part in PARTS)


@dataclass(frozen=True, eq=False)
class PersonParts:
    """The parts of a template, those of the synthetic people.

    The rotations R_template_rest (16, 3, 3) bring every part of the synthetic people from rest to the template.
    """

    skeleton: Skeleton
    R_template_rest: np.ndarray


def person_parts(template: Mesh, progress: Callable[[int, int], None] | None = None) -> PersonParts | None:
    """The parts of a template; None where the average person does not come to lie on it: an animal, a hand, a half.

    `progress` is called as progress(done, total). What was found is remembered as long as the template lives.
    """
    if template not in _known:
        _known[template] = _found(template, progress or (lambda done, total: None))
    return _known[template]


_known: WeakKeyDictionary[Mesh, PersonParts | None] = WeakKeyDictionary()


def _found(template: Mesh, tell: Callable[[int, int], None]) -> PersonParts | None:
    """The parts of a template that was not seen before."""
    person = average_person()
    try:
        seeds = find_seeds(person.mesh, template)
    except ValueError:                 # it has too few ends of limbs
        return None
    if len(seeds) < ENDS:
        return None
    pairs = find_correspondences(person.mesh, template, (seeds.template_vertices, seeds.scan_points),
                                 progress=lambda done, total: tell(round(MATCHING * done / total), 100))
    fit = register(person.mesh, template, correspondences=pairs,
                   progress=lambda done, total: tell(round(MATCHING + (100 - MATCHING) * done / total), 100))
    if fit.uncovered > UNCOVERED or stretched_share(person.mesh, fit.mesh) > STRETCHED:
        return None
    nearest = Surface(fit.mesh).closest(template.corners.mean(axis=1)).faces
    part_of_face = person.part_of_face[nearest]
    if len(np.unique(part_of_face)) < len(PARTS):
        return None
    joints = person.skeleton.joint_regressor(person.mesh) @ fit.mesh.vertices
    return PersonParts(Skeleton(part_of_face, PARENTS, joints, NAMES),
                       person.skeleton.fit_rotations(person.mesh, fit.mesh.vertices))


@lru_cache(maxsize=1)
def average_person() -> Person:
    """The synthetic person that templates are compared with."""
    return Person()
