"""What a statue is worth: by its finished surface and by the places of its joints, at any size of the figure."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import NAMED, Judgement
from scanprep.skeleton.roles import in_words

from .control.files import humanoid
from .control.model import FOLDED, HOLE, MEASURED, ControlModel
from .detail.displacement import coverage_shares
from .detail.reconstruction import Level, coverage_at
from .detail.subdivision import subdivide_uniform
from .fit import FittedStatue
from .report import parts_without_data

MISSED = 0.005               # share of the height, 8 mm on a person: scan that lies farther off is not in the statue
# Bones of a limb, upper to lower: people have 0.9 to 1.2; an elbow at the wrist has 2.2, knees too high 0.3.
UPPER_TO_LOWER = (0.5, 2.0)
BACKWARD = 0.7               # reach of a foot ahead of the ankle to that behind: 1.3 to 3.7, 0.3 for left as right


def judge_statue(statue: FittedStatue, scan: Mesh, finest: Level, left_out: Sequence[str] = ()) -> Judgement:
    """Judge a statue, with the likely cause where it is not good; `left_out` are doubts of the cleaning.

    `finest` is the finest level that was measured against the scan. Lengths count relative to the figure's height.
    """
    posed, shares, control = statue.posed, coverage_shares(statue.control, statue.map), statue.control
    assert posed is not None, "made by fit_statue"
    height = float(np.ptp(scan.vertices, axis=0).max())
    of_humanoid = control.skeleton.names == humanoid().skeleton.names
    rig = rig_doubts(statue, finest.mesh) if of_humanoid else []
    failed, check = [], [*rig, *left_out]
    summary = (f"{100 * shares['folded']:.0f}% of the control mesh is folded against the scan, "
               f"{100 * shares['measured']:.0f}% has data one-to-one")
    # shares of the control mesh. Where all joints are right, armpits, fingers, hair and clothes fold up to 0.15.
    most_folded = 0.06 if rig else 0.18
    if shares["measured"] < 0.4 or (rig and shares["folded"] > 0.25):
        failed.append(f"{summary}; a part of a person only, or the control model is not where the person is: joints "
                      "given by hand (--features) may help")
    elif shares["folded"] > most_folded or shares["measured"] < 0.75:
        check.append(f"{summary}; clothes and hair, a part of a person, or joints in wrong places: look at the page")
    missed = share_missed(scan, finest.mesh, MISSED * height)
    # right figures have up to 0.002, one with hair over its shoulders 0.05, in a wide skirt 0.10; an arm on the trunk
    # has 0.02, upside down 0.11
    if missed > (0.015 if rig else 0.06):
        (failed if missed > 0.25 else check).append(
            f"{100 * missed:.0f}% of the scan lies off the statue: joints in wrong places, or more than a person?")
    # mean distance, shares of the height: right figures have 0.0001, in loose clothes 0.001; an arm on the trunk 0.0014
    if finest.mean > 0.0012 * height:
        check.append(f"the detailed surface lies {1000 * finest.mean / height:.1f} thousandths of the height off the "
                     "scan on average; folds, or a limb lies in another's place")
    misfit = np.fmax(posed.features.joint_rms, posed.features.point_rms) / height
    # right ones have up to 0.012, coats 0.025; clicks with left and right exchanged 0.036. Nobody exchanges those that
    # are found; toons have up to 0.044, as their limbs are not alike.
    if misfit > (0.05 if posed.searched else 0.03):
        check.insert(0, f"features lie {100 * misfit:.1f}% of the height from those of the posed control model, "
                        f"{posed.features.worst}: left and right exchanged, one in a wrong place, or clothes?")
    # a joint that was not found at first is no doubt where the finished surface has data around it
    empty, measured = parts_without_data(statue), part_shares(statue)[MEASURED]
    lacking = [in_words(name) for name, share in zip(control.skeleton.names, measured, strict=True)
               if name in empty or (name in posed.missing and share < 0.5)]
    check += [f"the scan has no data on {', '.join(lacking[:NAMED])}"] if lacking else []
    check += [posed.problem] if posed.problem else []
    return Judgement.of(failed, check)


def share_missed(scan: Mesh, surface: Mesh, far: float) -> float:
    """Compute the share of a scan's area that lies outside a closed surface, and farther than `far` metres from it.

    Linings of sleeves and shoes lie inside.
    """
    import igl

    points = scan.sample(10_000, np.random.default_rng(0))[0]
    off = points[Surface(surface).closest(points).distances > far]
    if not len(off):
        return 0.0
    within = np.asarray(igl.fast_winding_number(surface.vertices, surface.faces, off)).ravel() > 0.5
    return float((~within).sum() / len(points))


def part_shares(statue: FittedStatue, towards: np.ndarray | None = None) -> dict[int, np.ndarray]:
    """Compute the share (J,) of each part's area that is MEASURED, FOLDED or a HOLE.

    With directions (J, 3), of the side of each part that faces there.
    """
    control = statue.control
    fine = subdivide_uniform(control.mesh, control.chart, 3)
    kind, area = coverage_at(control, statue.map, fine.parent, fine.bary), fine.mesh(control.mesh).vertex_areas
    part = control.skeleton.part_of_face[fine.parent]
    if towards is not None:
        area = area * (np.einsum("nd,nd->n", control.mesh.face_normals[fine.parent], towards[part]) > 0.5)
    count = len(control.skeleton.names)
    whole = np.maximum(np.bincount(part, area, count), 1e-12)
    return {value: np.bincount(part, area * (kind == value), count) / whole for value in (MEASURED, FOLDED, HOLE)}


def rig_doubts(statue: FittedStatue, surface: Mesh) -> list[str]:
    """Explain which joints of a humanoid are in wrong places, whatever the surface looks like at rest."""
    import igl

    control, names = statue.control, statue.control.skeleton.names
    at = dict(zip(names, control.skeleton.joints, strict=True))
    left, front = side_and_front(control)
    doubts = []
    within = np.asarray(igl.fast_winding_number(surface.vertices, surface.faces, control.skeleton.joints)).ravel() > 0.5
    # inner ends of the collar bones of toons with thin necks lie outside, and no limb turns about them
    outside = [in_words(name) for name, inside in zip(names[1:], within[1:], strict=True)
               if not inside and not name.endswith("sternoclavicular")]
    if outside:
        doubts.append(f"the joint of {', '.join(outside[:NAMED])} lies outside the body: in a wrong place?")
    for side in ("l", "r"):
        for first, second, third in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
            a, b, c = (at[f"{side}_{name}"] for name in (first, second, third))
            ratio = np.linalg.norm(b - a) / max(float(np.linalg.norm(c - b)), 1e-12)
            if not UPPER_TO_LOWER[0] < ratio < UPPER_TO_LOWER[1]:
                doubts.append(f"the {in_words(f'{side}_{second}')} divides its limb {ratio:.1f} to 1: in a wrong "
                               "place?")
    crossed = [name for name in ("knee", "ankle") if (at[f"l_{name}"] - at[f"r_{name}"]) @ left < 0]
    if crossed:
        doubts.append(f"left and right {crossed[0]} are crossed: exchanged?")
    # how far the feet reach ahead of the ankles, and behind
    part = control.skeleton.part_of_vertex(control.mesh)
    reach = np.concatenate([(control.mesh.vertices[part == names.index(name)] - at[name]) @ front
                            for name in ("l_ankle", "r_ankle")])
    if reach.max() < BACKWARD * -reach.min():
        doubts.append("the feet point backward: left and right exchanged, or the back taken for the front?")
    shares = part_shares(statue)
    # share of the skin of a part of a limb, hands aside, that lies on data: right figures have 0.85 or more, a leg on
    # another's place 0.31 to 0.75, feet in a plinth 0.74
    limbs = [j for j, name in enumerate(names) if name[1] == "_" and name[2:] not in ("sternoclavicular", "wrist")]
    bad = [in_words(names[j]) for j in limbs if shares[MEASURED][j] < 0.76 and shares[HOLE][j] < 0.5]
    # the inner sides of left parts face right, those of right parts left
    inner = part_shares(statue, np.array([{"l_": -1, "r_": 1}.get(name[:2], 0) * left for name in names]))
    joined = [j for j in limbs if names[j][2:] in ("hip", "knee") and inner[MEASURED][j] < 0.5]
    if len(joined) > 1 and shares[MEASURED][joined].min() > 0.4:
        doubts.append("clothes join the legs, which move as one: the joints of the legs are a guess")
    elif bad:
        doubts.append(f"the skin of {', '.join(bad[:NAMED])} does not lie on the scan: a limb in another's place?")
    return doubts


def side_and_front(control: ControlModel) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit vectors (3,) to the left and to the front of a humanoid, by its hips and the base of its skull."""
    at = dict(zip(control.skeleton.names, control.skeleton.joints, strict=True))
    left = at["l_hip"] - at["r_hip"]
    front = np.cross(left, at["skullbase"] - 0.5 * (at["l_hip"] + at["r_hip"]))
    return left / np.linalg.norm(left), front / np.linalg.norm(front)
