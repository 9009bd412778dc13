"""The parts of a template that is a person: the average of the synthetic people, brought onto it.

No scan and no pose but the template's own is needed, so a body has named parts, and angles of its joints that can be
compared with those of people, before its first scan is registered.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import cKDTree

from ..correspondence.correlated import find_correspondences, find_seeds
from ..geometry.format_glb import tallest
from ..geometry.landmark_names import translate_landmarks
from ..geometry.landmarks import match_landmarks
from ..geometry.mesh import Mesh
from ..geometry.surface import Surface
from ..skeleton.tree import Skeleton
from ..synthetic.landmarks import landmarks
from ..synthetic.people import PARENTS, PARTS, SyntheticPerson
from .nonrigid import Registration, register, share_stretched
from .schedule import RegistrationConfig


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
        _known[template] = _find_parts(template, progress or (lambda done, total: None))
    return _known[template]


_known: WeakKeyDictionary[Mesh, PersonParts | None] = WeakKeyDictionary()


def stature(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> float:
    """How tall a person is in whatever pose, metres: as much more than the template as the bones are longer.

    `vertices` (N, 3), metres, are the template's on the person.
    """
    regressor, parents = parts.skeleton.joint_regressor(template), parts.skeleton.parents

    def bones(body: np.ndarray) -> float:
        joints = regressor @ body
        return float(np.linalg.norm(joints[1:] - joints[parents[1:]], axis=1).sum())

    height = float(np.ptp(template.vertices[:, tallest(template.vertices)]))
    return height * bones(vertices) / bones(template.vertices)


def _find_parts(template: Mesh, tell: Callable[[int, int], None]) -> PersonParts | None:
    """The parts of a template that was not seen before."""
    person = average_person()
    if np.array_equal(template.faces, person.mesh.faces):
        # in the triangles of the synthetic people every vertex is known: nothing has to be registered
        part_of_face, vertices = person.part_of_face, template.vertices
    else:
        fit = _person_on(template, None, RegistrationConfig(), tell)
        if fit is None:
            return None
        nearest = Surface(fit.mesh).closest(template.corners.mean(axis=1)).faces
        part_of_face, vertices = person.part_of_face[nearest], fit.mesh.vertices
    if len(np.unique(part_of_face)) < len(PARTS):
        return None
    joints = person.skeleton.joint_regressor(person.mesh) @ vertices
    return PersonParts(Skeleton(part_of_face, PARENTS, joints, PARTS),
                       person.skeleton.fit_rotations(person.mesh, vertices))


def has_limbs(template: Mesh) -> bool:
    """Whether a template has the ends of five limbs, as head, hands and feet of a person."""
    try:
        # head, hands and feet
        return len(find_seeds(average_person().mesh, template)) >= 5
    except ValueError:             # it has too few ends of limbs
        return False


def _person_on(template: Mesh, landmarks: tuple[np.ndarray, np.ndarray] | None, config: RegistrationConfig,
               tell: Callable[[int, int], None]) -> Registration | None:
    """The average person on a template, led by landmarks or by the ends of limbs; None where it does not lie on it."""
    person = average_person().mesh
    matching = 30  # per cent of the time, before the person is registered
    if landmarks is not None:
        fit = register(person, template, landmarks, config, tell)
    else:
        if not has_limbs(template):
            return None
        seeds = find_seeds(person, template)
        pairs = find_correspondences(person, template, (seeds.template_vertices, seeds.scan_points),
                                     progress=lambda done, total: tell(round(matching * done / total), 100))
        fit = register(person, template, None, config, correspondences=pairs, progress=lambda done, total: tell(
            round(matching + (100 - matching) * done / total), 100))
    # shares of a template and of the person on it beyond which it is no person
    return None if fit.uncovered > 0.02 or share_stretched(person, fit.mesh) > 0.05 else fit


def find_landmarks(template: Mesh, known: Mapping[str, int],
                   progress: Callable[[int, int], None] | None = None) -> dict[str, int]:
    """All landmarks of the synthetic people on a template of which some are known, or none.

    The average person is brought onto the template, led by the known ones where these are at least four, and every
    other landmark goes along to the nearest vertex. Somebody who clicks would be a few centimetres off in the middle
    of the trunk and the limbs, nearer at their ends.

    Parameters
    ----------
    template : Mesh
        A person; without landmarks, one who stands.
    known : name to vertex
        In any spelling of `landmark_name`.
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    dict of name to int
        Those that are known, as they are, by our names; then the others. The known ones alone where the average
        person does not come to lie on the template.
    """
    marks, given = landmarks(), translate_landmarks(known)
    names, vertices, places = match_landmarks(marks, given, minimum=0)
    # landmarks from which the average person finds the others
    led = (vertices, template.vertices[places]) if len(names) >= 4 else None
    fit = _person_on(template, led, RegistrationConfig.quick(), progress or (lambda done, total: None))
    if fit is None:
        return given
    nearest = cKDTree(template.vertices).query(fit.mesh.vertices[list(marks.values())])[1]
    return given | {name: int(v) for name, v in zip(marks, nearest, strict=True) if name not in given}


@lru_cache(maxsize=1)
def average_person() -> SyntheticPerson:
    """The synthetic person that templates are compared with."""
    return SyntheticPerson()
