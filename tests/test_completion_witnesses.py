"""Markers that were seen but not used tell whether the body is where they are."""
import numpy as np

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.pose.witnesses import ask_witnesses, witness_doubts
from completion.motion import Motion
from model import load_built_in_model

BODY = load_built_in_model().subject()
STILL = Motion(np.zeros((4, 16, 3)), np.zeros((4, 3)), None, 50.0, np.zeros((4, 0)))


def test_unused_markers_are_asked_and_used_ones_are_not():
    body = BODY.vertices(np.zeros((16, 3)))
    above = np.array([0.0, 0.02, 0.1, 0.12, 0.3])           # metres over the crown
    places = np.tile(body[body[:, 2].argmax()] + above[:, None] * [0, 0, 1], (4, 1, 1))
    places[:3, 4] = np.nan                                  # hardly seen
    labels = ("A", "B", "C", "D", "E")
    markers = MarkerSequence(places, labels, 50.0)
    found = ask_witnesses(STILL, BODY, markers, {"A"})
    assert list(found) == ["D", "C", "B"] and abs(found["B"] - 0.02) < 0.003 and abs(found["D"] - 0.12) < 0.003
    assert not ask_witnesses(STILL, BODY, markers, labels)


def test_several_far_off_are_a_doubt():
    """Single ones are wands and props."""
    assert not witness_doubts({"A": 0.5, "B": 0.3, "C": 0.02})
    (why,) = witness_doubts({"A": 0.5, "B": 0.3, "C": 0.09, "D": 0.081})
    assert why == ("4 markers that were not used lie off the body (A 500 mm, B 300 mm, C 90 mm): look at the limbs "
                   "there")
