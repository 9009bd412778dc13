"""Elbows and knees that bend the wrong way are turned back where the markers agree."""
import numpy as np
import pytest

from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.hinges import Hinges
from completion.mocap.pose.marked_body import AnimateConfig, MarkedBody
from model import load_built_in_model

MODEL = load_built_in_model()
NAMES = list(MODEL.skeleton.names)
LAYOUT = load_layout("cmu41", MODEL.template, np.array(MODEL.info["people_vertices"]))
BODY = MarkedBody(MODEL.subject(), LAYOUT, 0.3, 0.3)
CONFIG = AnimateConfig()


def bent(part, degrees):
    """Unknowns (3, P) of a person who bends a joint about the left-right axis."""
    poses = np.zeros((3, len(NAMES), 3))
    poses[:, NAMES.index(part), 0] = np.radians(degrees)
    return BODY.body.join(poses, np.zeros((3, 3)))


@pytest.mark.parametrize(("part", "upper", "degrees", "name"), [
    ("shin_left", "thigh_left", 60, "knee_angle_l"), ("forearm_right", "upper_arm_right", -70, "elbow_flex_r")])
def test_a_limb_that_turned_over_is_turned_back(part, upper, degrees, name):
    hinges, right = Hinges(BODY), bent(part, degrees)
    targets = BODY.positions(right)
    limb = ["thigh_l", "shank_l"] if "knee" in name else ["humerus_r", "forearm_r"]
    wrong = hinges.roll(right, limb, hinges.segments)
    column = [angle for joint in hinges.segments.joints() for angle in joint.angles].index(name)
    bend, flipped = (hinges.measure(x, hinges.segments)[0, column] for x in (right, wrong))
    assert bend > 45 and flipped < -30                      # the same limb, and a joint that bends backwards
    np.testing.assert_allclose(hinges.roll(wrong, limb, hinges.segments), right, atol=1e-6)
    # one frame of three is wrong
    x = np.stack([right[0], wrong[1], right[2]])
    mended = hinges.turn_back(x, targets, CONFIG)
    assert np.linalg.norm(BODY.positions(mended) - targets, axis=2).max() < 0.005
    np.testing.assert_allclose(hinges.measure(mended, hinges.segments)[:, column], bend, atol=3)
    np.testing.assert_array_equal(mended[[0, 2]], right[[0, 2]])
    assert hinges.turned == 1
    # a limb with less than two markers of its own stays: either bend is a guess
    own = np.isin(BODY.part_of_marker, [NAMES.index(one) for one in (part, upper)]) | np.isin(
        BODY.part_of_marker, np.flatnonzero(MODEL.skeleton.parents == NAMES.index(part)))
    few = np.where((own & (np.cumsum(own) > 1))[:, None], np.nan, targets)
    np.testing.assert_array_equal(hinges.turn_back(x, few, CONFIG), x)


def test_a_limb_stays_where_the_markers_say_so():
    """Markers of an elbow that truly bends backwards, as in a drawing: turned back it would fit worse."""
    hinges, broken = Hinges(BODY), bent("forearm_right", 50)
    column = [angle for joint in hinges.segments.joints() for angle in joint.angles].index("elbow_flex_r")
    assert hinges.measure(broken, hinges.segments)[0, column] < -20
    np.testing.assert_array_equal(hinges.turn_back(broken, BODY.positions(broken), CONFIG), broken)
