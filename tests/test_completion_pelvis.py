"""The pelvis follows its measured bony landmarks, where it is worn with them."""
import numpy as np
import pytest
from people_bodies import kept, small_people

from completion import Motion, load_layout
from completion.mocap.files.markers import MarkerSequence
from completion.mocap.joint_angles import Known, anatomical_angles
from completion.mocap.pose.pelvis import follow_pelvis
from scanprep.geometry import rotations

FRAMES = np.arange(40)
TURNS = rotations.exp(np.stack([0.1 * np.sin(FRAMES / 5), 0.2 * np.cos(FRAMES / 7), 0.15 * np.sin(FRAMES / 4)], axis=1))


def recorded(name, hidden=()):
    """A body whose thighs swing, and landmarks that only go with the bone of the pelvis, turned by `TURNS`."""
    model = small_people()
    subject, layout = model.subject(np.zeros(4)), load_layout(name, model.template, kept())
    poses = np.zeros((40, 16, 3))
    poses[:, 0] = rotations.log(TURNS)
    for k, side in enumerate(("left", "right")):
        poses[:, model.skeleton.names.index(f"thigh_{side}"), 0] = 0.6 * np.sin(FRAMES / 6 + np.pi * k)
    rest = layout.place(model.template.with_vertices(subject.vertices(poses[0] * 0)))
    trans = np.zeros((40, 3))
    positions = rest @ TURNS.swapaxes(1, 2)
    residuals = np.zeros(positions.shape[:2])
    for label, frames in hidden:
        column = layout.labels.index(label)
        positions[frames, column], residuals[frames, column] = np.nan, np.nan
    motion = Motion(poses, trans, None, 60.0, residuals, layout.labels)
    return motion, subject, layout, MarkerSequence(positions, layout.labels, 60.0)


def off(found):
    """Largest turn between rotations (T, 3, 3) and `TURNS`, degrees."""
    return np.degrees(np.linalg.norm(rotations.log(found @ TURNS.swapaxes(1, 2)), axis=1)).max()


@pytest.mark.parametrize("name", ["plugingait39", "cmu41"])
def test_a_pelvis_goes_with_its_landmarks_and_not_with_the_skin_of_swinging_thighs(name):
    motion, subject, layout, measured = recorded(name)
    found = follow_pelvis(motion, subject, layout, measured)
    assert off(found) < 1e-3
    # the angles say so too: the hip of a thigh that swings in the plane of the body has no adduction of its own
    centres = subject.joints(motion.poses, motion.trans)
    tilt = {which: anatomical_angles(motion, subject, centres, known).degrees[:, :3]
            for which, known in (("measured", Known(pelvis=found)), ("line", Known()))}
    assert np.abs(tilt["measured"] - tilt["line"]).max() < 12 and np.ptp(tilt["measured"][:, 1]) > 5


def test_three_landmarks_are_enough_and_gaps_are_filled_without_a_step():
    assert off(follow_pelvis(*recorded("plugingait39", [("LASI", slice(10, 18)), ("RPSI", slice(0, 6))]))) < 1e-3
    found = follow_pelvis(*recorded("plugingait39", [(label, slice(20, 24)) for label in ("LASI", "LPSI", "RPSI")]))
    apart, steps = (np.degrees(np.linalg.norm(rotations.log(R @ S.swapaxes(1, 2)), axis=1))
                    for R, S in ((found, TURNS), (found[1:], found[:-1])))
    assert np.delete(apart, range(20, 24)).max() < 1e-3 and apart.max() < 4 and steps.max() < 4


def test_without_both_asis_and_one_behind_there_is_no_such_pelvis():
    gone = slice(None)
    for hidden in (["LASI"], ["LPSI", "RPSI"], ["LASI", "RASI", "LPSI", "RPSI"]):
        assert follow_pelvis(*recorded("plugingait39", [(label, gone) for label in hidden])) is None
    assert follow_pelvis(*recorded("plugingait39", [("LPSI", gone)])) is not None
