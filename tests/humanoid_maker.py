"""How the generic humanoid is made from the synthetic people: done once, its result is stored in the package.

`python tests/humanoid_maker.py` makes both files anew, in a minute.
"""
from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from implicit_surface import Field, Group, Loft, Mirrored, RoundCone, project
from people_maker import mirror, remesh
from polygonise import polygonise
from scanprep.synthetic.body_parts import cross_sections
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from model.blend_weights import strongest
from model.statue.control.chart import make_chart
from model.statue.control.files import STORED, write_control
from model.statue.control.model import ControlModel
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic import body_parts as people_parts
from scanprep.synthetic.anatomy import Anatomy, tables
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.topology import CANONICAL, blending, load

NAMES = ("humanoid_root", "vl5", "skullbase", "l_sternoclavicular", "l_shoulder", "l_elbow", "l_wrist",
         "r_sternoclavicular", "r_shoulder", "r_elbow", "r_wrist", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee",
         "r_ankle")
PARENTS = np.array([-1, 0, 1, 1, 3, 4, 5, 1, 7, 8, 9, 0, 11, 12, 0, 14, 15])
SEGMENTS = ("spine", "head", "clavicle", "upper_arm", "forearm", "hand", "thigh", "shank", "foot")
SEGMENT_OF_PART = np.array([0, 0, 1, 2, 3, 4, 5, 2, 3, 4, 5, 6, 7, 8, 6, 7, 8])
FREE = (-360, 360)
# degrees from the default pose about the axes of `freedom`, of the left side
LIMITS = {"humanoid_root": (FREE, FREE, FREE),
          "vl5": ((-40, 80), (-40, 40), (-50, 50)),                          # forwards, sideways, turn
          "skullbase": ((-65, 60), (-45, 45), (-80, 80)),
          "l_sternoclavicular": ((-12, 45), (-30, 35)),                      # up, forwards
          "l_shoulder": ((-75, 160), (-100, 180), (-100, 100)),              # aside, forwards, twist
          "l_elbow": ((-20, 138),), "l_wrist": ((-75, 85), (-40, 30)),       # bent; to the palm, to the thumb
          "l_hip": ((-35, 65), (-35, 130), (-50, 50)), "l_knee": ((-8, 155),), "l_ankle": ((-35, 55),)}
BODY, LIMB, HEAD, FACE, HAND, FOOT = 0.074, 0.048, 0.042, 0.0215, 0.0175, 0.0275     # metres, wanted edges
# of the 16 parts of the people, pelvis first, the part here
PART_OF_PEOPLE = np.array([0, 1, 1, 2, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14, 15, 16])


def build_mesh(anatomy: Anatomy, step: float = 0.006) -> Mesh:
    """The control mesh, the same on either side of x = 0."""
    field = coarse_body(anatomy)
    high = np.array([anatomy.ends[6, 0] + 0.08, 0.22, CANONICAL.stature + 0.03])
    half = polygonise(field, np.array([0.0, -0.30, -0.02]), high, step)
    half = half.submesh(half.vertex_component[half.faces[:, 0]] == 0)[0]
    mesh, _ = mirror(remesh(half, field, sizing(anatomy), 30))
    mesh = with_marks(mesh, field)
    order = np.lexsort((np.round(mesh.vertices[:, 0], 4), np.round(mesh.vertices[:, 2], 3)))
    place = np.argsort(order)
    return Mesh(mesh.vertices[order], place[mesh.faces])


def coarse_body(a: Anatomy) -> Field:
    """The surface of the people without toes, fingers and ears, which few triangles cannot follow."""
    g = a.scale
    torso, shoulders = people_parts.trunk(a)
    leg, head = people_parts.leg(a), people_parts.head(a)
    assert isinstance(leg, Group) and isinstance(head, Group)
    leg = Group([leg.members[0], (shoe(a), leg.members[1][1])], leg.bumps, leg.bounds)
    nose = RoundCone(a.eye + a.front(0, 0.084, 0.012), a.eye + a.front(0, 0.101, -0.036), 0.008, 0.0125)
    head = Group([*head.members[:2], (nose, 0.008)], bounds=head.bounds)              # skull and face, eyes
    left = Group([(Group([*torso, (leg, 0.035 * g)]), 0), *shoulders, (people_parts.arm(a), 0.048 * g)],
                 people_parts.trunk_bumps(a))
    return Mirrored(Group([(left, 0), (head, 0.012), (mitten(a), 0.012)]))


def mitten(a: Anatomy) -> Field:
    """Palm and fingers as one flat volume, and the thumb."""
    L = a.width["hand"] / 0.19
    f, wrist = a.forearm_frame, a.joints[6]
    t = np.array([-0.012, 0.015, 0.04, 0.07, 0.10, 0.14, 0.168]) * L
    thick = np.array([0.0195, 0.0185, 0.0170, 0.0155, 0.0130, 0.0110, 0.0090]) * L
    fore = np.array([0.0275, 0.031, 0.037, 0.041, 0.041, 0.037, 0.029]) * L
    bent = -np.array([0, 0, 0, 0, 0.002, 0.008, 0.014]) * L
    flat = Loft(wrist, f, cross_sections(t, thick, thick, fore, fore, 2.5, bent), (0.006 * L, 0.016 * L))
    thumb = [wrist + f.T @ (np.array(p) * L) for p in ((-0.006, 0.018, 0.022), (-0.013, 0.044, 0.056),
                                                       (-0.017, 0.061, 0.104))]
    return Group([(flat, 0), (RoundCone(thumb[0], thumb[1], 0.0175 * L, 0.0140 * L), 0.016 * L),
                  (RoundCone(thumb[1], thumb[2], 0.0140 * L, 0.0115 * L), 0.006 * L)],
                 bounds=(wrist + f.T @ [0, 0, 0.03 * L], wrist + f.T @ [0, 0, 0.15 * L], 0.15 * L))


def shoe(a: Anatomy) -> Field:
    """The foot with its toes in one."""

    length, frame, ankle = a.width["foot"], a.foot_frame, a.joints[12]
    toes = np.array([[0.66, -0.020, 0.150, -0.045, 0.138], [0.72, -0.045, 0.110, -0.055, 0.136]])
    t, shift, half, top, bottom = (np.vstack([tables.foot, toes]) * length).T
    origin = np.array([ankle[0], ankle[1], 0.140 * length])
    keys = cross_sections(t, half, half, (top + bottom) / 2, (top + bottom) / 2, 2.8, shift, (top - bottom) / 2)
    return Group([(Loft(origin, frame, keys, (0.018 * length, 0.03 * length)), 0)],
                 bounds=(origin, origin + frame.T @ np.array([0, 0, 0.5]) * length, 0.55 * length))


def sizing(a: Anatomy) -> Callable[[np.ndarray], np.ndarray]:
    """Wanted edge length in metres at points (n, 3), of either side."""
    j, e = a.joints, a.ends
    face = a.eye + np.array([0, -0.095, -0.035])
    spots = [(RoundCone(j[6], e[6], 0.035, 0.06), HAND), (RoundCone(j[12], e[12] - [0, 0, 0.05], 0.04, 0.08), FOOT),
             (RoundCone(j[4], j[5], 0.02, 0.08), LIMB), (RoundCone(j[5], j[6], 0.08, 0.05), 0.8 * LIMB),
             (RoundCone(j[10] - [0, 0, 0.1], j[11], 0.12, 0.10), 1.1 * BODY),
             (RoundCone(j[11], j[12], 0.10, 0.08), LIMB),
             (RoundCone(e[12] - [0, 0, 0.05], a.front(0.13, 0.15, 0.03), 0.04, 0.04), 0.85 * FOOT),
             (RoundCone(a.front(0, 0, a.at(-0.22)), a.front(0, 0, a.at(-0.20)), 0.05, 0.05), 0.7 * BODY),
             (RoundCone(face, face + 1e-3, 0.045, 0.045), FACE), (RoundCone(j[3], e[3], 0.08, 0.12), HEAD)]

    def size(points: np.ndarray) -> np.ndarray:
        folded = np.abs(points * [1, 0, 0]) + points * [0, 1, 1]
        wanted = np.full(len(points), BODY)
        for place, fine in spots:
            wanted = np.minimum(wanted, fine + 0.30 * np.maximum(place(folded), 0))
        return wanted

    return size


def joint_places(a: Anatomy) -> np.ndarray:
    """(17, 3) the centres of the joints; the sternoclavicular ones lie beside the notch above the breastbone."""
    of_people = np.array([0, 1, 3, 4, 4, 5, 6, 7, 7, 8, 9, 10, 11, 12, 13, 14, 15])
    joints = a.joints[of_people]
    joints[3] = a.front(0.026 * a.scale, 0.035 * a.scale, a.at(0.975))
    joints[7] = joints[3] * [-1, 1, 1]
    return joints


def part_weights(mesh: Mesh, a: Anatomy) -> np.ndarray:
    """(N, 17) the weights of the people at the nearest places of their surface, a share of the chest for the clavicles.

    A clavicle carries the top of the chest from the middle out to the shoulder, and where people blend chest and upper
    arm the chest's part of it.
    """
    people = Surface(load().mesh).closest(mesh.vertices)
    found = np.einsum("nc,ncp->np", people.bary, blending()[1][load().mesh.faces[people.faces]])
    weights = np.zeros((len(mesh.vertices), 17))
    np.add.at(weights.T, PART_OF_PEOPLE, found.T)
    shoulder = a.joints[4]
    high = _smoothstep((mesh.vertices[:, 2] - shoulder[2] + 0.19) / 0.17)
    for part, side in ((3, 1), (7, -1)):
        out = _smoothstep((side * mesh.vertices[:, 0] - 0.015) / (0.85 * shoulder[0]))
        weights[:, part] = weights[:, 1] * high * out
    weights[:, 1] -= weights[:, 3] + weights[:, 7]
    weights[weights < 0.004] = 0
    return strongest(weights)


def with_marks(mesh: Mesh, field: Field, rounds: int = 12) -> Mesh:
    """The mesh slid over the surface until a vertex lies at every landmark and marker of the people."""
    people, twin = load(), mirrored_vertices(mesh)
    marks = [v if people.mesh.vertices[v, 0] > -1e-4 else people.mirror[v] for v in (*landmarks().values(),
                                                                                     *markers().values())]
    goals = project(field, people.mesh.vertices[np.unique(marks)], 6)
    goals[np.abs(goals[:, 0]) < 0.004, 0] = 0
    far = np.linalg.norm(mesh.vertices[:, None] - goals, axis=2)
    far[(mesh.vertices[:, 0] > 0)[:, None] != (goals[:, 0] > 0)] = np.inf
    pinned, at = linear_sum_assignment(np.minimum(far, 1.0)**2)
    free = np.setdiff1d(np.arange(len(twin)), np.r_[pinned, twin[pinned]])
    x, A = mesh.vertices, mesh.vertex_adjacency
    mean = csr_array(diags_array(1 / A.sum(axis=1)) @ A)
    wanted = x - mean @ x
    for done in range(1, rounds + 1):
        x = x.copy()
        x[pinned] += (goals[at] - x[pinned]) * done / rounds
        x[twin[pinned]] = x[pinned] * [-1, 1, 1]
        normal = mesh.with_vertices(x).vertex_normals
        for _ in range(8):
            step = mean @ x + 0.7 * wanted - x
            step -= np.einsum("nd,nd->n", step, normal)[:, None] * normal
            x[free] += 0.5 * step[free]
        x[free] = project(field, x[free], 2)
        x = 0.5 * (x + x[twin] * [-1, 1, 1])
    return mesh.with_vertices(x)


def nearest_marks(mesh: Mesh, marks: dict[str, int]) -> dict[str, int]:
    """The vertices nearest to marked vertices of the people; left and right are mirror images."""
    twin, people = mirrored_vertices(mesh), load()
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


def _smoothstep(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


def hidden_seams(mesh: Mesh, a: Anatomy) -> list[np.ndarray]:
    """Seams out of sight: crown to crotch behind, under the arms and round the hand to the thumb, inside of the legs to
    the heel and round the sole; the right side mirrors the left."""
    g, j = a.scale, a.joints
    fu, ff, fl, ft = a.upper_arm_frame, a.forearm_frame, a.leg_frame, a.foot_frame
    L, foot = a.width["hand"] / 0.19, a.width["foot"]

    def hand(out: float, front: float, along: float) -> np.ndarray:
        return j[6] + L * (ff.T @ np.array([out, front, along]))

    def sole(side: float, ahead: float, up: float) -> np.ndarray:
        return j[12] + foot * (side * ft[0] + ahead * ft[2]) * [1, 1, 0] + [0, 0, foot * up - j[12, 2]]

    spine = [a.eye + [0, -0.02, 0.12], a.eye + [0, 0.12, 0.02], a.front(0, -0.13 * g, a.at(1.05)),
             a.front(0, -0.13 * g, a.at(0.6)), a.front(0, -0.13 * g, a.at(0.05)), a.front(0, -0.02, a.at(-0.25))]
    arm = [a.front(0, -0.13 * g, a.at(0.72)), j[4] + 0.3 * (j[5] - j[4]) - 0.05 * fu[0] - 0.03 * fu[1],
           j[5] - 0.045 * fu[0] - 0.02 * fu[1], j[6] - 0.02 * ff[0] - 0.025 * ff[1],
           hand(0, -0.042, 0.07), hand(-0.01, -0.03, 0.16), hand(-0.014, 0, 0.186), hand(-0.01, 0.03, 0.16),
           hand(0, 0.043, 0.10), hand(-0.017, 0.062, 0.112)]
    leg = [a.front(0, -0.02, a.at(-0.25)), j[11] - 0.055 * fl[0], j[12] - 0.035 * fl[0] - 0.02 * fl[1],
           sole(-0.02, -0.24, 0.10), sole(0.10, -0.10, 0), sole(0.13, 0.2, 0.02), sole(0.15, 0.50, 0.02),
           sole(-0.03, 0.75, 0.03), sole(-0.14, 0.62, 0.03)]
    twin = mirrored_vertices(mesh)
    tree = [_path(mesh, spine, np.abs(mesh.vertices[:, 0]) > 1e-6)]
    for way in (arm, leg):
        taken = np.zeros(len(mesh.vertices), dtype=bool)
        taken[np.concatenate(tree)] = True
        left = _path(mesh, way, taken | (mesh.vertices[:, 0] < 1e-6))
        tree += [left, twin[left]]
    return tree


def _path(mesh: Mesh, way: list[np.ndarray], costly: np.ndarray) -> np.ndarray:
    """The shortest simple path (k,) over edges past the vertices nearest to some points, round `costly` vertices."""
    stops = [int(np.linalg.norm(mesh.vertices - point, axis=1).argmin()) for point in way]
    out, blocked = stops[:1], np.array(costly)
    for last in stops[1:]:
        x, y = mesh.edges.T
        cost = mesh.edge_lengths * (1 + 1e3 * (blocked[x] | blocked[y]))
        graph = coo_array((cost, (x, y)), shape=2 * (len(mesh.vertices),)).tocsr()
        before = dijkstra(graph, directed=False, indices=out[-1], return_predecessors=True)[1]
        back = [last]
        while back[-1] != out[-1]:
            back.append(int(before[back[-1]]))
        out += back[-2::-1]
        blocked[out] = True
    return np.array(out)


def build() -> ControlModel:
    """The humanoid from scratch, a minute."""
    anatomy = Anatomy(CANONICAL)
    mesh = build_mesh(anatomy)
    weights = part_weights(mesh, anatomy)
    part_of_face = weights[mesh.faces].mean(axis=1).argmax(axis=1)
    skeleton = Skeleton(part_of_face, PARENTS, joint_places(anatomy), NAMES)
    joints = skeleton.joints.copy()
    joints[0] = mesh.vertices[skeleton.part_of_vertex(mesh) == 0].mean(axis=0)
    chart = make_chart(mesh, hidden_seams(mesh, anatomy))
    axes, limits = freedom(anatomy)
    return ControlModel(mesh, replace(skeleton, joints=joints), weights, chart,
                        nearest_marks(mesh, landmarks()), axes, limits, SEGMENTS, SEGMENT_OF_PART)


def freedom(anatomy: Anatomy) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
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
