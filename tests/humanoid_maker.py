"""How the generic humanoid is brought to the built-in people: done once, its result is stored in the package.

Its triangles, chart and blend weights stay what they are: `python tests/humanoid_maker.py` slides its vertices over the
average body, fingers and toes in one and without ears, and writes both files anew, in a minute.
"""
from __future__ import annotations

import json
from dataclasses import replace

import igl
import numpy as np
from implicit_surface import Field, Group, Mirrored, project
from scipy.interpolate import RBFInterpolator
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array, diags_array
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import cdist

from model.statue.control.files import STORED, humanoid, humanoid_markers, write_control
from model.statue.control.model import ControlModel
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.anatomy import RestFrames
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.topology import load_topology

NAMES = ("humanoid_root", "vl5", "skullbase", "l_sternoclavicular", "l_shoulder", "l_elbow", "l_wrist",
         "r_sternoclavicular", "r_shoulder", "r_elbow", "r_wrist", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee",
         "r_ankle")
PARENTS = np.array([-1, 0, 1, 1, 3, 4, 5, 1, 7, 8, 9, 0, 11, 12, 0, 14, 15])
SEGMENTS = ("spine", "head", "clavicle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot")
SEGMENT_OF_PART = np.array([0, 0, 1, 2, 3, 4, 5, 2, 3, 4, 5, 6, 7, 8, 6, 7, 8])
SLACK = 0.012                        # metres that a vertex may lie beside its mark, for even triangles
FREE = (-360, 360)
# degrees from the default pose about the axes of `freedom`, of the left side
LIMITS = {"humanoid_root": (FREE, FREE, FREE),
          "vl5": ((-40, 80), (-40, 40), (-50, 50)),                          # forwards, sideways, turn
          "skullbase": ((-65, 60), (-45, 45), (-80, 80)),
          "l_sternoclavicular": ((-12, 45), (-30, 35)),                      # up, forwards
          "l_shoulder": ((-75, 160), (-100, 180), (-100, 100)),              # aside, forwards, twist
          "l_elbow": ((-20, 138),), "l_wrist": ((-75, 85), (-40, 30)),       # bent; to the palm, to the thumb
          "l_hip": ((-35, 65), (-35, 130), (-50, 50)), "l_knee": ((-8, 155),), "l_ankle": ((-35, 55),)}


def coarse_body(a: RestFrames) -> Field:
    """The surface of the people without toes, fingers and ears, which few triangles cannot follow."""
    people = load_topology()
    x, part = people.mesh.vertices.copy(), people.part_of_vertex
    # ears are laid flat: the skin is spanned anew over the side of the head, a quarter of the ear is left
    ear = a.vertices[landmarks()["left ear"]] + [0, 0.012, 0.012]
    inside = np.linalg.norm(np.abs(x * [1, 0, 0]) + x * [0, 1, 1] - ear, axis=1) < 0.055
    A = people.mesh.vertex_adjacency
    mean = csr_array(diags_array(1 / A.sum(axis=1)) @ A)
    for _ in range(3000):
        x[inside] = (mean @ x)[inside]
    x += 0.25 * (people.mesh.vertices - x)
    # a web between fingers, the thumb apart, and between toes
    hand, foot = ((x - a.joints[k]) @ frame.T for k, frame in ((6, a.forearm_frame), (12, a.foot_frame)))
    fingers = x[(part == 6) & (hand[:, 2] > 0.075) & (hand[:, 0] > -0.025)]
    toes = x[(part == 12) & (foot[:, 2] > 0.11)]
    body = Solid(Mesh(x, people.mesh.faces))
    return Mirrored(Group([(body, 0), (hull(fingers), 0.012), (hull(toes), 0.012)]))


class Solid:
    """Signed distance to a closed mesh, metres, negative inside."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(igl.signed_distance(
            np.ascontiguousarray(points), self.mesh.vertices, self.mesh.faces,
            igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER)[0])


def hull(points: np.ndarray) -> Solid:
    """The convex hull of some points."""
    found = ConvexHull(points)
    corners = points[found.simplices]
    inward = np.einsum("fd,fd->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                       found.equations[:, :3]) < 0
    faces = np.where(inward[:, None], found.simplices[:, ::-1], found.simplices)
    used, faces = np.unique(faces, return_inverse=True)
    return Solid(Mesh(points[used], faces.reshape(-1, 3)))


def at(side: float, front: float, up: float) -> np.ndarray:
    """A place (3,), metres."""
    return np.array([side, -front, up])


def joint_places(a: RestFrames) -> np.ndarray:
    """(17, 3) the centres of the joints; the sternoclavicular ones lie beside the notch above the breastbone."""
    of_people = np.array([0, 1, 3, 4, 4, 5, 6, 7, 7, 8, 9, 10, 11, 12, 13, 14, 15])
    joints = a.joints[of_people]
    joints[3] = at(0.026 * a.scale, 0.035 * a.scale, a.at(1.03))
    joints[7] = joints[3] * [-1, 1, 1]
    return np.where(np.abs(joints) < 1e-12, 0.0, joints)


def slide(control: ControlModel, anatomy: RestFrames, rounds: int = 12) -> Mesh:
    """The mesh slid over the surface of the people until each landmark and marker lies at theirs."""
    mesh, field = control.mesh, coarse_body(anatomy)
    twin = mirrored_vertices(mesh)
    # first as marks and joints tell
    x, mine, theirs = mesh.vertices, [*control.skeleton.joints], [*joint_places(anatomy)]
    goals = np.zeros((0, 3))
    for vertices, marks in ((control.landmarks, landmarks()), (humanoid_markers(), markers())):
        places = project(field, load_topology().mesh.vertices[[marks[name] for name in vertices]], 6)
        mine += [*x[list(vertices.values())]]
        theirs += [*places]
        # a marker beside a landmark shares its vertex, in the middle between them
        for place in np.abs(places * [1, 0, 0]) + places * [0, 1, 1]:
            near = np.linalg.norm(goals - place, axis=1) < 0.024
            goals[near] = 0.5 * (goals[near] + place)
            goals = goals if near.any() else np.vstack([goals, place])
    _, first = np.unique(np.round(mine, 6), axis=0, return_index=True)
    x = RBFInterpolator(np.array(mine)[first], np.array(theirs)[first], kernel="linear")(x)
    x = 0.5 * (x + x[twin] * [-1, 1, 1])
    # then over the surface, the nearest vertices at the marks
    goals[goals[:, 0] < 0.004, 0] = 0
    far = np.where((x[:, :1] > 1e-6) != (goals[:, 0] > 0), 1.0, np.minimum(cdist(x, goals), 1.0))
    pinned, at_goal = linear_sum_assignment(far**2)
    pinned, goals = np.r_[pinned, twin[pinned]], np.vstack([goals[at_goal], goals[at_goal] * [-1, 1, 1]])
    A = mesh.vertex_adjacency
    mean = csr_array(diags_array(1 / A.sum(axis=1)) @ A)
    wanted = x - mean @ x                        # as even as the triangles were
    for _ in range(rounds):
        normal = mesh.with_vertices(x).vertex_normals
        for _ in range(8):
            step = mean @ x + 0.9 * wanted - x
            step -= np.einsum("nd,nd->n", step, normal)[:, None] * normal
            x += 0.25 * step
            off = x[pinned] - goals
            x[pinned] = goals + off * np.minimum(1, SLACK / np.maximum(np.linalg.norm(off, axis=1), 1e-9))[:, None]
        x = project(field, x, 2)
        x = 0.5 * (x + x[twin] * [-1, 1, 1])
    return mesh.with_vertices(x)


def nearest_marks(mesh: Mesh, marks: dict[str, int]) -> dict[str, int]:
    """The vertices nearest to marked vertices of the people; left and right are mirror images."""
    twin, people = mirrored_vertices(mesh), load_topology()
    on_middle = twin == np.arange(len(twin))

    def nearest(vertex: int) -> int:
        point = people.mesh.vertices[vertex]
        if point[0] < -1e-4:
            return int(twin[nearest(int(people.mirror[vertex]))])
        far = np.linalg.norm(mesh.vertices - point, axis=1)
        return int((far if point[0] > 1e-4 else np.where(on_middle, far, np.inf)).argmin())

    return {name: nearest(vertex) for name, vertex in marks.items()}


def mirrored_vertices(mesh: Mesh) -> np.ndarray:
    """(N,) the vertex at the mirrored place."""
    return cKDTree(mesh.vertices).query(mesh.vertices * [-1, 1, 1])[1].astype(np.int64)


def build() -> ControlModel:
    """The stored humanoid, brought to the people."""
    anatomy, old = load_topology().anatomy, humanoid()
    mesh = slide(old, anatomy)
    joints = joint_places(anatomy)
    joints[0] = mesh.vertices[old.skeleton.part_of_vertex(mesh) == 0].mean(axis=0)
    axes, limits = freedom(anatomy)
    return replace(old, mesh=mesh, skeleton=replace(old.skeleton, joints=joints), axes=axes, limits=limits,
                   landmarks=nearest_marks(mesh, landmarks()))


def freedom(anatomy: RestFrames) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Axes and limits of every joint, anatomical in the default pose; those of the right mirror those of the left.

    The axes of elbow and knee are square to the limb, and a positive angle bends it. Shoulder and hip have three axes
    at right angles, the third along the limb.
    """
    (arm_out, arm_front, arm), (hand_out, thumb, hand) = anatomy.upper_arm_frame, anatomy.forearm_frame
    (leg_out, leg_front, leg), (_, instep, toes) = anatomy.leg_frame, anatomy.foot_frame
    side, front, up = np.diag([1.0, -1.0, 1.0])

    def turning(*pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """The axes (k, 3) about which the first of each pair turns towards the second."""
        return np.cross(*np.array(pairs).swapaxes(0, 1))

    trunk = np.vstack([turning((up, front), (up, side)), up])
    left = {"humanoid_root": np.eye(3), "vl5": trunk, "skullbase": trunk,
            "l_sternoclavicular": turning((side, up), (side, front)),
            "l_shoulder": np.vstack([turning((arm, arm_out), (arm, arm_front)), arm]),
            "l_elbow": turning((arm, arm_front)), "l_wrist": turning((hand, -hand_out), (hand, thumb)),
            "l_hip": np.vstack([turning((leg, leg_out), (leg, leg_front)), leg]),
            "l_knee": turning((leg, -leg_front)), "l_ankle": turning((toes, -instep))}
    axes, limits = [], []
    for name in NAMES:
        twin = name if name in left else "l_" + name[2:]
        axes.append(left[twin] * (1.0 if twin == name else np.array([1.0, -1.0, -1.0])))
        limits.append(np.radians(LIMITS[twin]))
    return tuple(axes), tuple(limits)


if __name__ == "__main__":
    made = build()
    write_control(made, STORED)
    STORED.with_name("humanoid_markers.json").write_text(json.dumps(nearest_marks(made.mesh, markers())) + "\n")
