"""The pelvis follows its measured bony landmarks, where it is worn with them."""
import numpy as np
import pytest
from people_bodies import kept, small_people

from completion import Motion, load_layout
from completion.mocap.angle_conventions import pelvis_axes
from completion.mocap.files.markers import MarkerSequence
from completion.mocap.joint_angles import Known, anatomical_angles
from completion.mocap.marker_sets.named import fitting_layout
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
    # the angles of the pelvis are those of the bone, which the line of the hip centres misses
    centres = subject.joints(motion.poses, motion.trans)
    measured, bone, line = (anatomical_angles(motion, subject, centres, known).degrees[:, :3]
                            for known in (Known(pelvis=found), Known(pelvis=TURNS), Known()))
    np.testing.assert_allclose(measured, bone, atol=1e-2)
    assert np.ptp(bone[:, 1]) > 5 and np.abs(line - bone).max() > 0.5


def test_a_sacral_marker_stands_for_both_psis():
    """It is of another set than the others; its place is that of the middle of both PSIS."""
    model = small_people()
    labels = [label for label in load_layout("plugingait39", model.template, kept()).labels if "PSI" not in label]
    layout, name = fitting_layout([*labels, "SACR"], model.template, kept())
    assert name == "plugingait39" and "SACR" in layout.labels
    subject = model.subject(np.zeros(4))
    rest = model.template.with_vertices(subject.vertices(np.zeros((16, 3))))
    worn = layout.select([*labels, "SACR"])
    still = Motion(np.zeros((3, 16, 3)), np.zeros((3, 3)), None, 60.0, np.zeros((3, len(labels) + 1)), worn.labels)
    places = MarkerSequence(worn.place(rest) @ TURNS[:3].swapaxes(1, 2), worn.labels, 60.0)
    np.testing.assert_allclose(follow_pelvis(still, subject, worn, places), TURNS[:3], atol=1e-5)
    at = {"LASI": np.array([1.0, 0, -1]), "RASI": np.array([1.0, 0, 1]), "SACR": np.zeros(3)}
    np.testing.assert_allclose(pelvis_axes(at), np.eye(3), atol=1e-12)


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
