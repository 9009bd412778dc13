"""The verdict of a statue: good where the surface reached the scan and the joints are right, at any size; else why."""
from dataclasses import replace

import numpy as np
import pytest

from model.statue.control.files import humanoid
from model.statue.control.model import FOLDED, HOLE, MEASURED, DisplacementMap
from model.statue.detail.reconstruction import Level, Reconstruction, reconstruction_error
from model.statue.detail.subdivision import subdivide_uniform
from model.statue.fit import FittedStatue, Posed, StatueConfig, fit_statue
from model.statue.registration.features import FeatureFit
from model.statue.verdict import judge_statue
from scanprep import Mesh
from scanprep.geometry import rotations
from scanprep.synthetic.people import SyntheticPerson

NAMES = humanoid().skeleton.names
SIZE = 128


def statue_of(control, parts=(), kind=FOLDED, side=None):
    """A statue of a control model with a flat map, some parts of which are folded or holes."""
    names, skeleton = control.skeleton.names, control.skeleton
    rows, columns, faces, _ = control.chart.texels(SIZE)
    wrong = np.isin(skeleton.part_of_face[faces], [names.index(name) for name in parts])
    if side is not None:
        wrong &= control.mesh.face_normals[faces] @ [1, 0, 0] * np.sign(control.mesh.corners[faces].mean(axis=1)[:, 0]
                                                                         ) < side
    coverage = np.full((SIZE, SIZE), MEASURED, np.uint8)
    coverage[rows[wrong], columns[wrong]] = kind
    pose = np.zeros((len(names), 3))
    fit = FeatureFit(pose, np.ones(9), control.mesh.vertices, skeleton.joints, 0.0, 0.0, True)
    return FittedStatue(control, pose, DisplacementMap(np.zeros((SIZE, SIZE), np.float32), coverage),
                        posed=Posed(fit, fit.vertices, np.zeros(len(fit.vertices), dtype=bool)))


def judge(statue, scan=None):
    fine = subdivide_uniform(humanoid().mesh, humanoid().chart, 1)
    scan, surface = scan or fine.mesh(statue.control.mesh), Reconstruction(statue.control, statue.map, fine).mesh()
    off = reconstruction_error(surface, scan).mean()
    return judge_statue(statue, scan, Level("level 1", surface, off, off, np.ones(len(surface.faces), dtype=bool)))


def with_joints(**moved):
    control = humanoid()
    joints = control.skeleton.joints.copy()
    for name, place in moved.items():
        joints[NAMES.index(name)] = place
    return control.refit(control.mesh.vertices, joints)


def at(name):
    return humanoid().skeleton.joints[NAMES.index(name)]


def exchanged(*names):
    return with_joints(**{f"{a}_{name}": at(f"{b}_{name}") for name in names for a, b in ("lr", "rl")})


@pytest.mark.parametrize("size", [0.02, 1.0, 40.0])
def test_a_right_figure_of_any_size_is_good(size):
    control = humanoid()
    statue = statue_of(control.refit(size * control.mesh.vertices, size * control.skeleton.joints))
    assert judge(statue).verdict == "good"


def test_folds_and_a_coarse_doubt_of_a_part_do_not_make_a_right_figure_doubtful():
    assert judge(statue_of(humanoid(), ("l_wrist", "r_wrist"))).verdict == "good"
    seen = statue_of(humanoid())
    assert judge(replace(seen, posed=replace(seen.posed, missing=("l_wrist", "left toe")))).verdict == "good"


@pytest.mark.parametrize(("control", "why"), [
    (exchanged(*{name[2:] for name in NAMES if name[1] == "_"}), "the feet point backward"),
    (exchanged("knee"), "left and right knee are crossed"),
    (exchanged("ankle"), "left and right ankle are crossed"),
    (with_joints(l_elbow=at("l_wrist") + [0, 0, 0.01]), "the left elbow divides its limb"),
    (with_joints(r_wrist=at("r_wrist") + [-0.2, 0, 0]), "the joint of right wrist lies outside the body"),
    (with_joints(skullbase=at("l_knee") * [0, 1, 1]), "the joint of skullbase lies outside the body"),
])
def test_joints_in_wrong_places_are_told_though_the_surface_is_perfect(control, why):
    judgement = judge(statue_of(control))
    assert judgement.verdict == "check" and why in judgement.why


@pytest.mark.parametrize(("parts", "why"), [
    (("l_shoulder", "l_elbow"), "the skin of left shoulder, left elbow does not lie on the scan"),
    (("r_hip", "r_knee", "r_ankle"), "the skin of right hip, right knee, right ankle does not lie on the scan"),
])
def test_a_limb_in_the_place_of_another_is_told(parts, why):
    judgement = judge(statue_of(humanoid(), parts))
    assert judgement.verdict == "check" and why in judgement.why


def test_clothes_that_join_the_legs_are_told():
    legs = ("l_hip", "r_hip", "l_knee", "r_knee")
    assert "clothes join the legs" in judge(statue_of(humanoid(), legs, side=0)).why
    assert "clothes join" not in judge(statue_of(humanoid(), ("l_hip", "r_hip"), HOLE)).why


def test_what_lies_outside_is_missed_and_a_lining_is_not():
    control = humanoid()
    lining = Mesh(np.vstack([control.mesh.vertices, 0.9 * (control.mesh.vertices - [0, 0, 0.9]) + [0, 0, 0.9]]),
                  np.vstack([control.mesh.faces, control.mesh.faces + len(control.mesh.vertices)]))
    trunk = np.isin(control.skeleton.part_of_face, (0, 1))
    kept = np.concatenate([np.ones(len(trunk), dtype=bool), trunk])
    assert judge(statue_of(control), lining.submesh(kept)[0]).verdict == "good"
    second = control.mesh.with_vertices(control.mesh.vertices + [1.5, 0, 0])
    assert "of the scan lies off the statue" in judge(statue_of(control), Mesh(
        np.vstack([control.mesh.vertices, second.vertices]), lining.faces)).why


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["right", "back to front", "upside down", "an arm on the trunk", "one leg twice"])
def test_clicks_that_are_wrong_are_never_good(wrong):
    """The same body, fitted with right clicks and with wrong ones."""
    person = SyntheticPerson()
    joints = {name: person.joints[number] for number, name in enumerate(
        ("", "vl5", "", "skullbase", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist", "l_hip",
         "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle")) if name}
    middle = person.mesh.vertices.mean(axis=0)
    turn = {"back to front": [0, 0, np.pi], "upside down": [0, np.pi, 0]}.get(wrong, [0, 0, 0])
    joints = {name: middle + rotations.exp(turn) @ (place - middle) for name, place in joints.items()}
    if wrong == "an arm on the trunk":
        joints |= {"l_elbow": joints["l_shoulder"] - [0.1, 0, 0.28], "l_wrist": joints["l_shoulder"] - [0.1, 0, 0.5]}
    if wrong == "one leg twice":
        joints |= {f"r_{name}": joints[f"l_{name}"] - [0.02, 0, 0] for name in ("knee", "ankle")}
    statue = fit_statue(person.mesh, joints, {}, config=StatueConfig(size=256))
    assert (judge(statue, person.mesh).verdict == "good") == (wrong == "right")
