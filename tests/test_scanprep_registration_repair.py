from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from animal_bodies import Animal

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.registration.graph_fit import start_fit
from scanprep.registration.limbs import angle_excess, find_exchanged_sides, frames, limb_doubts, part_angles
from scanprep.registration.matches import prepare_problem
from scanprep.registration.nonrigid import measure_fit
from scanprep.registration.person import PersonParts, average_person, has_limbs, is_no_person, person_parts
from scanprep.registration.repair import better, repair_limbs
from scanprep.registration.rolls import CHANGE, LIMBS, STEPS, best_rolls, other_rolls
from scanprep.registration.schedule import GraphStage, RegistrationConfig
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.anatomy import MIRROR_PART
from scanprep.synthetic.people import PARENTS, PARTS, BodyShape, SyntheticPerson, find_pose, random_pose

FOREARM, SHIN, HEAD = (PARTS.index(name) for name in ("forearm_left", "shin_right", "head"))
QUICK = RegistrationConfig((GraphStage(300, 0.09, 0.7, 0.01, 0.08, 0.0, rounds=3),
                            GraphStage(300, 0.02, 0.7, 0.01, 0.05, 0.0, rounds=4)), final_fit=False)


@pytest.fixture(scope="module")
def person():
    return average_person()


@pytest.fixture(scope="module")
def parts(person):
    skeleton = Skeleton(person.part_of_face, person.parents, person.joints, PARTS)
    return PersonParts(skeleton, np.broadcast_to(np.eye(3), (len(PARTS), 3, 3)))


def registration(person, scan, x):
    """What a registration with vertices (N, 3) says of itself."""
    fit = replace(start_fit(person.mesh, np.eye(4), 300), x=x, moved=0.0)
    return measure_fit(prepare_problem(person.mesh, scan), fit, scan)


def with_rolled_skin(person, body, part, angle):
    """Vertices of a body with the skin of a limb, and what hangs on it, taken round its bone while the bone stays."""
    R = person.skeleton.fit_rotations(person.mesh, body)[part]
    joint, bone = (person.skeleton.joint_regressor(person.mesh) @ body)[part], R @ frames()[part, 0]
    mine = person.skeleton.descends[person.part_of_vertex, part]
    out = body.copy()
    turned = (body[mine] - joint) @ rotations.exp(angle * bone).T + joint
    out[mine] = Surface(person.mesh.with_vertices(body)).closest(turned).points
    return out


def test_rolls_are_the_best_of_all():
    """The tree of one leg against all that could be; the joints of the rest are content."""
    rng = np.random.default_rng(0)
    thigh, shin, foot = (PARTS.index(f"{name}_right") for name in ("thigh", "shin", "foot"))
    costs = np.zeros((len(PARTS), STEPS, STEPS))
    costs[[thigh, shin, foot]] = rng.uniform(0, 2, (3, STEPS, STEPS))
    turned = CHANGE * np.minimum(np.arange(STEPS), STEPS - np.arange(STEPS)) / (STEPS / 2)
    every = (costs[thigh, 0][:, None, None] + costs[shin][:, :, None] + costs[foot][None]
             + turned[:, None, None] + turned[:, None] + turned)
    free = {thigh, shin, foot}
    cost, rolls = best_rolls(costs, free)
    assert np.isclose(cost, every.min())
    assert tuple(rolls[[thigh, shin, foot]]) == np.unravel_index(every.argmin(), every.shape)
    assert not np.delete(rolls, [thigh, shin, foot]).any()
    cost, rolls = best_rolls(costs, free, shin, 7)
    assert np.isclose(cost, every[:, 7].min()) and rolls[shin] == 7
    cost, rolls = best_rolls(costs, {shin, foot})
    assert np.isclose(cost, every[0].min()) and not rolls[thigh]


@pytest.mark.slow
@pytest.mark.parametrize("part, angle", [*product((FOREARM, SHIN, HEAD), (150, -120))])
def test_a_rolled_limb_is_asked_to_roll_back(person, parts, part, angle):
    """What hangs on it came along, and needs to roll back as well; all bones lie where they should."""
    R = person.part_rotations(find_pose("run"))
    below = person.skeleton.descends[:, part]
    for p in np.flatnonzero(below):
        R[p] = R[p] @ rotations.exp(np.radians(angle) * frames()[p, 0])
    first = other_rolls(parts, R, [part], 4)[0]
    touched = np.flatnonzero(below | (np.arange(len(PARTS)) == PARENTS[part]))
    assert set(np.flatnonzero(first)) <= set(touched) & set(LIMBS)
    assert np.cos(first[part] + np.radians(angle)) > 0.2             # joints leave some play
    back = np.stack([R[p] @ rotations.exp(first[p] * frames()[p, 0]) for p in range(len(PARTS))])
    assert angle_excess(part_angles(R)).max() > 40 and angle_excess(part_angles(back)).max() < 5   # degrees


@pytest.mark.slow
@pytest.mark.parametrize("part, angle", [(FOREARM, np.pi), (SHIN, 2.5)])
def test_a_limb_rolled_in_a_registration_is_put_right(person, parts, part, angle):
    body = person.in_pose(find_pose("run"))
    scan = person.mesh.with_vertices(body)
    before = registration(person, scan, with_rolled_skin(person, body, part, angle))
    told = []
    after = repair_limbs(person.mesh, scan, before, parts, config=QUICK, progress=lambda *given: told.append(given))
    mine = person.part_of_vertex == part
    off = [np.linalg.norm(fit.mesh.vertices - body, axis=1)[mine].mean() for fit in (before, after)]
    assert off[0] > 0.05 and off[1] < 0.3 * off[0], off
    assert after.rolled and not limb_doubts(person.mesh, parts, after.mesh.vertices)
    assert after.uncovered <= before.uncovered + 0.001 and told[-1][0] <= told[-1][1]


def test_shins_rolled_on_both_sides_mean_that_left_and_right_are_exchanged(person, parts):
    body = person.in_pose(find_pose("run"))
    one = with_rolled_skin(person, body, SHIN, 2.3)
    both = with_rolled_skin(person, one, MIRROR_PART[SHIN], -2.3)
    assert find_exchanged_sides(person.mesh, parts, body) is find_exchanged_sides(person.mesh, parts, one) is None
    assert "the left shin by" in (told := find_exchanged_sides(person.mesh, parts, both)) and "exchanged" in told


def test_what_needs_no_repair_stays(person, parts):
    body = person.in_pose(find_pose("run"))
    scan = person.mesh.with_vertices(body)
    right, wrong = (registration(person, scan, x) for x in (body, with_rolled_skin(person, body, FOREARM, np.pi)))
    assert repair_limbs(person.mesh, scan, right, parts, config=QUICK) is right
    assert repair_limbs(person.mesh, scan, wrong, None, config=QUICK) is wrong                  # an animal, say
    assert repair_limbs(person.mesh, scan, wrong, parts, config=replace(QUICK, rolls=0)) is wrong
    assert not RegistrationConfig.from_paper().rolls and RegistrationConfig().rolls


def test_fewer_doubts_are_not_bought(person, parts):
    """Not with the scan, the landmarks or the shape of the body."""
    body = person.in_pose(find_pose("run"))
    scan = person.mesh.with_vertices(body)
    right, wrong = (registration(person, scan, x) for x in (body, with_rolled_skin(person, body, FOREARM, np.pi)))
    marked = [replace(fit, landmark_rms=0.002) for fit in (right, wrong)]
    assert better(person.mesh, parts, right, wrong) and better(person.mesh, parts, *marked)
    assert not better(person.mesh, parts, wrong, right) and not better(person.mesh, parts, right, right)
    assert not better(person.mesh, parts, replace(right, uncovered=wrong.uncovered + 0.01), wrong)
    assert not better(person.mesh, parts, replace(marked[0], landmark_rms=0.02), marked[1])
    stretched = scan.with_vertices(1.6 * body)
    assert not limb_doubts(person.mesh, parts, stretched.vertices)
    assert not better(person.mesh, parts, replace(right, mesh=stretched), wrong)


def test_no_person_is_refused_short_or_tall_thin_or_heavy_in_any_pose():
    rng = np.random.default_rng(3)
    people = [SyntheticPerson(BodyShape.like("female", 1.2, 6.0)), SyntheticPerson(BodyShape.like("male", 2.1, -4.0)),
              *(SyntheticPerson(BodyShape.random(rng)) for _ in range(3))]
    bodies = [person.mesh.with_vertices(person.in_pose(random_pose(rng))) for person in people]
    assert not any(is_no_person(body) for body in bodies)


def test_an_animal_is_no_person_and_a_surface_with_a_handle_is_not_judged():
    mesh = Animal().mesh
    assert is_no_person(mesh) and not has_limbs(mesh) and person_parts(mesh) is None
    # a handle as of a hand that is one with the hip: two triangles far apart are cut out and joined by a tube
    centres = mesh.corners.mean(axis=1)
    far = int(np.linalg.norm(centres - centres[0], axis=1).argmax())
    a, b = mesh.faces[0], mesh.faces[far][::-1]
    tube = [side for k in range(3) for side in ([a[k], a[k - 2], b[k]], [a[k - 2], b[k - 2], b[k]])]
    joined = Mesh(mesh.vertices, np.vstack([np.delete(mesh.faces, [0, far], axis=0), tube]))
    assert not len(joined.boundary_loops) and not is_no_person(joined)
