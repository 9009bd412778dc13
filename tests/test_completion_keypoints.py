"""Joint centres of a video are told from markers on skin, by their names and by how far the hips are apart."""
import numpy as np
import pytest
from test_completion_coverage import KEPT, LAYOUT, MODEL, NAMES, subject

from completion import Motion, load_layout
from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.keypoints import find_keypoints, measure_hips, parse_keypoint
from completion.mocap.marker_sets.named import fitting_layout, layout_names
from completion.mocap.pose.coverage import find_coverage
from scanprep.skeleton.roles import find_numbered_roles

LIMBS = ("Hip", "Knee", "Ankle", "Shoulder", "Elbow", "Wrist")
KINECT = ("Shoulder", "Elbow", "Wrist", "Hand", "HandTip", "Thumb", "Hip", "Knee", "Ankle", "Foot")


def both(pattern, words):
    return [pattern.format(side, word) for side in "LR" for word in words]


def full(pattern, words, change=str):
    return [change(pattern.format(side, word)) for side in ("left", "right") for word in words]


SMALL = [word.lower() for word in LIMBS]
SETS = {
    "COCO": ["nose", *full("{}_{}", ["eye", "ear", *SMALL])],
    "HALPE_26 of Pose2Sim": ["Hip", "Neck", "Head", "Nose", *both("{}{}", [*LIMBS, "BigToe", "SmallToe", "Heel"])],
    "BODY_25": ["Nose", "Neck", "MidHip", *both("{}{}", ["Eye", "Ear", *LIMBS, "BigToe", "SmallToe", "Heel"])],
    "MediaPipe": ["NOSE", "MOUTH_LEFT", "MOUTH_RIGHT",
                  *full("{}_{}", ["eye_inner", "eye", "eye_outer", "ear", *SMALL, "pinky", "index", "thumb", "heel",
                                  "foot_index"], str.upper)],
    "Human3.6M": ["Hip", "Spine", "Thorax", "Neck", "Head",
                  *both("{}{}", ["Hip", "Knee", "Foot", "Shoulder", "Elbow", "Wrist"])],
    "Kinect": ["SpineBase", "SpineMid", "SpineShoulder", "Neck", "Head",
               *(word + side for side in ("Left", "Right") for word in KINECT)],
    "Azure Kinect": ["PELVIS", "SPINE_NAVEL", "SPINE_CHEST", "NECK", "HEAD", "NOSE",
                     *(f"{word}_{side}".upper() for side in ("Left", "Right") for word in (*KINECT, "Eye", "Ear"))],
    "SMPL": ["pelvis", "spine1", "spine2", "spine3", "neck", "head", 
             *full("{}_{}", [*SMALL, "collar", "foot", "hand"])],
    "joint centres": [f"{side}{joint}JC" for side in "LR" for joint in "HKASEW"],
    "head and above": ["Nose", *both("{}{}", ["Eye", "Ear", "Shoulder", "Elbow", "Wrist"])]}
SKIN = {
    "Plug-in Gait with joint centres": [*LAYOUT.labels, *both("{}{}", ["HJC", "KJC", "AJC"]), "PELO"],
    "CAST": both("{}{}", "IAS IPS FT FLE FME TT FAL TAM FCC FM1 FM2 FM5 A LHE MHE RS US".split()),
    "Stanford": ["C7", "L.ASIS", "R.ASIS",
                 *both("{}_{}", "Shoulder lelbow melbow lwrist mwrist knee mknee ankle mankle toe 5meta calc".split())],
    "Motive": ["HeadTop", "BackTop", "Chest", "WaistLFront",
               *both("{}{}", "ShoulderBack UArmHigh ElbowOut WristIn KneeOut AnkleOut ToeOut ToeIn Heel".split())],
    "words": ["sternum", "C7", *full("{} {}", ["shoulder", "lat elbow", "radial styloid", "front hip", "lat knee",
                                               "lat malleolus", "heel", "toe", "hand"])]}


@pytest.mark.parametrize("name", SETS)
def test_sets_of_joint_centres_are_known_by_their_names(name):
    assert all(map(parse_keypoint, SETS[name])), [label for label in SETS[name] if not parse_keypoint(label)]
    assert 0 < len(find_keypoints(SETS[name])) <= 3


@pytest.mark.parametrize("name", [*layout_names(), *SKIN])
@pytest.mark.parametrize("hips", [None, 0.5])
def test_markers_on_skin_are_never_called_so(name, hips):
    """All sets that come along, under labels and aliases, with a few points of a face beside them, and others' sets."""
    sets = [SKIN[name]] if name in SKIN else [load_layout(name, MODEL.template, KEPT)]
    if name not in SKIN:
        layout, = sets
        other = {label: alias for alias, label in layout.aliases.items()}
        sets = [layout.labels, tuple(layout.aliases), [other.get(label, label) for label in layout.labels],
                [*layout.labels, "Nose", "LEAR", "REAR"]]
    for labels in sets:
        assert find_keypoints(labels, (), hips) == find_keypoints(labels, labels, hips) == ()


def named_as_joints(points):
    """Four frames of points under names of joints, of both sides."""
    labels = tuple(both("{}{}", LIMBS))
    return MarkerSequence(np.stack([[points[label] for label in labels]] * 4), labels, 50.0)


def test_names_of_joints_alone_need_hips_as_near_as_centres():
    """The same names on the trochanters, and the epicondyles, are skin markers."""
    roles = find_numbered_roles(MODEL.skeleton.names, MODEL.skeleton.joints)
    joints = subject().joints(np.zeros((len(NAMES), 3)))
    centres = named_as_joints({f"{side}{word}": joints[roles[f"{side.lower()}_{word.lower()}"]]
                               for side in "LR" for word in LIMBS})
    worn = load_layout("biomech57", MODEL.template, KEPT)
    at = dict(zip(worn.labels, worn.place(MODEL.template), strict=True))
    skin = named_as_joints({f"{side}{word}": at[side + label] for side in "LR" for word, label in
                            zip(LIMBS, ("FTC", "FLE", "FAL", "CAJ", "HLE", "USP"), strict=True)})
    assert measure_hips([centres]) < 0.66 and measure_hips([skin]) > 0.74
    assert find_keypoints(centres.labels, (), measure_hips([centres])) == ("LHip", "LKnee", "LAnkle")
    assert find_keypoints(skin.labels, (), measure_hips([skin])) == ()
    # nor where a fourth of the labels are of other places
    assert find_keypoints([*centres.labels, "C7", "SACR", "LTHI", "RTHI"], (), 0.5) == ()


def coverage_of(labels):
    """Of a recording under these labels, of which helenhayes29 knows some."""
    layout = load_layout("helenhayes29", MODEL.template, KEPT).with_spellings(labels)
    known = layout.match_labels(labels)
    residuals = np.where(np.isin(labels, known), 0.005, np.full((5, len(labels)), np.nan))
    motion = Motion(np.zeros((5, len(NAMES), 3)), np.zeros((5, 3)), None, 50.0, residuals, tuple(labels))
    recorded = MarkerSequence(np.zeros((5, len(labels), 3)), tuple(labels), 50.0)
    return find_coverage(subject(), layout, [motion], [recorded])


@pytest.mark.parametrize("more", [(), ("knee", "ankle", "mknee", "mankle", "calc", "toe")])
def test_a_person_from_joint_centres_is_never_good(more):
    """Also where a program has added markers that it guessed, which no layout knows."""
    judgement = coverage_of([*SETS["HALPE_26 of Pose2Sim"], *both("{}_{}_study", more)]).judgement()
    assert judgement.verdict == "check" and len(judgement.reasons) == 1
    assert judgement.why.startswith("Hip, Nose, LBigToe: joint centres of a video, not markers on skin. ")
    assert "record markers on skin (scape layout list)" in judgement.why


def test_joint_centres_of_which_no_set_knows_three_say_so():
    with pytest.raises(ValueError, match=r"labels: nose, left_eye, left_ear are joint centres of a video"):
        fitting_layout(SETS["COCO"], MODEL.template, KEPT)
