"""Registration through a model: a body that is found on a scan takes the template along."""
import json
from dataclasses import replace

import numpy as np
import pytest
from jointed_bodies import bent, crab
from scan_folders import QUICK, ball
from test_scanprep_registration_start import BEND, small

from model.coregistration.lead import model_lead
from scanprep import Mesh, read_mesh, write_mesh
from scanprep.cli import group
from scanprep.decimation.decimate import decimate
from scanprep.geometry.rotations import exp
from scanprep.geometry.surface import Surface
from scanprep.registration.lead import Proposal, lead_of
from scanprep.registration.nonrigid import register
from scanprep.registration.unmarked import Candidate, find_rival, register_by_any, weigh_doubts
from scanprep.registration.verdict import judge_registration
from scanprep.synthetic.people import BodyShape, SyntheticPerson, find_pose


def off(found, truth):
    return float(np.linalg.norm(found - truth, axis=1).mean())


@pytest.fixture(scope="module")
def body():
    return crab(81, 40)


@pytest.fixture(scope="module")
def scan(body):
    return body.with_vertices(bent(body, *BEND) @ exp(np.array([2.5, 0.4, 1.0])).T + [3.0, -1.0, 2.0])


def near(scan):
    return scan.vertices + 0.01 * np.sin(20 * scan.vertices[:, ::-1])


@pytest.mark.slow
def test_a_registration_begins_at_vertices(body, scan):
    found = register(body, scan, config=small(), start=near(scan))
    assert off(found.mesh.vertices, scan.vertices) < 0.008 < off(near(scan), scan.vertices)
    for start in (near(scan)[:-1], np.full(scan.vertices.shape, np.nan)):
        with pytest.raises(ValueError, match=r"start: expected a finite transform \(4, 4\) or vertices"):
            register(body, scan, start=start)


@pytest.mark.slow
@pytest.mark.parametrize("far", [0.0, 4e6])
def test_what_leaves_less_to_doubt_is_kept(body, scan, far):
    """Of two bodies that were found one lies beside the scan; wherever the scan is."""
    there = scan.with_vertices(scan.vertices + far)
    asked = []

    class TwoBodies:
        name, parts = "crabs", None

        def __call__(self, scan, landmarks=None, model=None, up=None):
            asked.append(float(np.abs(scan.vertices).max()))
            middle = scan.vertices.mean(axis=0)
            right = near(scan)
            return [Proposal((right - middle) @ exp(np.array([0, 0, np.pi])).T + middle), Proposal(right)]

    led = register_by_any(body, there, None, TwoBodies(), config=small())
    assert off(led.fit.mesh.vertices, there.vertices) < 0.008 and led.way == "model crabs" and led.rival is None
    assert weigh_doubts(body, None, led.fit) == 0 and max(asked) < 100


@pytest.mark.slow
@pytest.mark.parametrize("far", [0.0, 4e6])
def test_two_bodies_that_explain_a_scan_alike_are_both_kept(far):
    """An egg looks the same when it is turned round; something beside it leaves as much to doubt of both."""
    egg, board = ball(), np.array([[1.5, 0, 0], [1.9, 0, 0], [1.9, 0.4, 0], [1.5, 0.4, 0]])
    back = egg.vertices * [-1, -1, 1]
    faces = np.vstack([egg.faces, len(egg.vertices) + np.array([[0, 1, 2], [0, 2, 3]])])
    scan = Mesh(np.vstack([egg.vertices, board]) + far, faces)

    class Eggs:
        name, parts = "eggs", None

        def __init__(self, *bodies):
            self.bodies = bodies

        def __call__(self, scan, landmarks=None, model=None, up=None):
            middle = scan.vertices[:len(egg.vertices)].mean(axis=0)
            return [Proposal(body + middle) for body in self.bodies]

    def lead_by(*bodies):
        return register_by_any(egg, scan, None, Eggs(*bodies), config=QUICK.scan.registration)

    led = lead_by(egg.vertices, back)
    assert off(led.fit.mesh.vertices, egg.vertices + far) < 0.008 > off(led.rival.fit.mesh.vertices, back + far)
    assert led.rival.way == "model eggs" and led.rival.rival is None
    assert lead_by(egg.vertices, egg.vertices + 0.01).rival is None             # the same body
    # a limb that the scan does not show makes no other body; the same limb, seen, does
    moved = replace(led.fit, mesh=egg.with_vertices(led.fit.mesh.vertices + (egg.vertices[:, 2:] > 0.6) * [0.5, 0, 0]))
    for seen in (True, False):
        hidden = [replace(fit, seen=(egg.vertices[:, 2] < 0.6) | seen) for fit in (led.fit, moved)]
        best, other = (Candidate(0.0, fit, "", scan) for fit in hidden)
        assert find_rival(egg, best, [best, other]) == (other if seen else None)
        assert find_rival(egg, best, [best, replace(other, doubt=0.1)]) is None         # one that leaves more to doubt
    assert lead_by(egg.vertices, back + [0.5, 0, 0]).rival is None              # one that explains less
    fit = register(egg, egg, start=egg.vertices, config=QUICK.scan.registration)
    assert judge_registration("egg", egg, egg, fit, None, None).verdict == "good"
    told = judge_registration("egg", egg, egg, fit, None, None, has_rival=True)
    assert told.verdict == "check" and told.reasons[0].startswith("another body explains the scan as well")


def test_without_a_lead_ends_of_limbs_are_needed(body):
    with pytest.raises(ValueError, match="limbs"):
        register_by_any(body, crab(20, 10).with_vertices(0.01 * np.random.default_rng(0).normal(size=(
            len(crab(20, 10).vertices), 3))))


def test_no_model_where_none_is_wanted_or_known(body, tmp_path):
    assert lead_of(body, "none") is None and lead_of(body, "auto") is None          # a crab has two ends
    with pytest.raises(ValueError, match=r"gone\.npz"):
        lead_of(body, str(tmp_path / "gone.npz"))


@pytest.mark.slow
def test_a_crab_is_no_person(body):
    with pytest.raises(ValueError, match="--through people: the model does not come to lie on the template"):
        model_lead(body, "people")


@pytest.mark.slow
def test_a_person_is_found_in_any_pose_and_lands_on_the_scan(tmp_path):
    """A template of other triangles than the model's; the scan lies on its side, and nobody says which way is up."""
    somebody = SyntheticPerson(BodyShape.like("female", weight=0.8))
    template = decimate(somebody.mesh, 5000)
    place = Surface(somebody.mesh).closest(template.vertices)
    scan = somebody.in_pose(find_pose("lunge_left")) @ exp(np.array([0.3, 1.4, 0.2])).T
    truth = np.einsum("nk,nkd->nd", place.bary, scan[somebody.mesh.faces[place.faces]])
    write_mesh(tmp_path / "scan.ply", somebody.mesh.with_vertices(scan))
    write_mesh(tmp_path / "template.ply", template)
    assert group(["register", str(tmp_path / "scan.ply"), "--template", str(tmp_path / "template.ply"),
                  "-o", str(tmp_path / "found.ply")]) == 0
    rows = {m["metric"]: m["value"] for m in json.loads((tmp_path / "found.ply.report.json").read_text())["metrics"]}
    assert rows["led by"] == "model people"
    assert off(read_mesh(tmp_path / "found.ply").vertices, truth) < 0.01
