"""Keypoints: joint centres that programs find in videos and depth pictures. They are no markers on skin."""
from __future__ import annotations

import re
from collections.abc import Collection, Iterable

import numpy as np

from ..files.markers import MarkerSequence

# Words of COCO, HALPE_26, BODY_25, MediaPipe, Human3.6M, SMPL and Kinect. Sets of skin markers have those of JOINTS and
# ENDS too, but not three of VIDEO
JOINTS = "hip|knee|ankle|shoulder|elbow|wrist"
ENDS = "heel|toe|foot|hand|thumb|head|neck|collar|clavicle|chin"
VIDEO = ("nose|eye|eyeinner|eyeouter|ear|mouth|bigtoe|smalltoe|footindex|pinky|index|handtip|headtop|upperneck|thorax|"
         "pelvis|root|midhip|hipcent(er|re)|shouldercent(er|re)|spine(base|mid|shoulder|navel|chest|[0-9])?|"
         r"(hip|knee|ankle|shoulder|elbow|wrist)(joint|cent(er|re)|jointcent(er|re))|[hkasew]jc")
SIDED = re.compile(rf"(?P<front>left|right|l|r)?(?P<word>{JOINTS}|{ENDS}|{VIDEO})(?P<back>left|right|l|r)?"
                   r"(?P<joint>joint)?")
# Hips apart, in lengths of the thigh: joint centres of 42 synthetic people had 0.44 to 0.66, and 0.80 once; trochanters
# of 18 had 0.72 to 1.15, markers at the front of the pelvis 0.52 to 0.76. Above WIDEST are trochanters, below NARROW is
# no marker; between them names must tell
WIDEST, NARROW = 0.70, 0.50
CENTRES = "joint centres of a video, not markers on skin"
REMEDY = "for a body, record markers on skin (scape layout list)"
# what eleven synthetic people in a video were off, taken for people with markers of helenhayes29; one knee 33 degrees
USE = f"{CENTRES}. Girths and volume are a guess, stature may be 10 cm, angles 10 degrees and more off: {REMEDY}"


def parse_keypoint(label: str) -> tuple[str, str] | None:
    """Return the word of a joint or of a part of the face, and its side "l", "r" or ""; None for other labels.

    Examples
    --------
    >>> [parse_keypoint(label) for label in ("RHip", "LEFT_SHOULDER", "KneeLeft", "left eye", "MidHip", "LKNE")]
    [('hip', 'r'), ('shoulder', 'l'), ('knee', 'l'), ('eye', 'l'), ('midhip', ''), None]
    """
    parts = SIDED.fullmatch(re.sub("[^a-z0-9]", "", label.lower()))
    if parts is None:
        return None
    word = f"{parts['word']}{parts['joint'] or ''}"
    return word, (parts["front"] or parts["back"] or "")[:1]


def find_keypoints(labels: Collection[str], used: Collection[str] = (), hips: float | None = None) -> tuple[str, ...]:
    """Return the labels that tell that a set is of joint centres, not of markers on skin; none where it is not.

    Parameters
    ----------
    labels : collection of str
        All labels of the recordings.
    used : collection of str, optional
        Those that a marker layout knows; without them all.
    hips : float, optional
        Distance of the hips in lengths of the thigh, see `measure_hips`.

    Returns
    -------
    tuple of str
        At most three, the clearest first.
    """
    # words of a video and of joints on both sides, each with its first label; a Hip without a side is in the middle
    plain, video, sided = set[str](), dict[str, str](), dict[str, str]()
    for label in labels:
        word, side = parse_keypoint(label) or ("", "")
        if word:
            plain.add(label)
        if re.fullmatch(VIDEO, word) or (word == "hip" and not side):
            video.setdefault(word, label)
        elif side and re.fullmatch(JOINTS, word):
            sided.setdefault(word, label)
    counted = set(used or labels)
    share = len(counted & plain) / max(len(counted), 1)
    if share < 0.75 or len(video) + len(sided) < 3:
        return ()
    # three words of a video are enough, fewer need hips that are not as far apart as trochanters; names of joints alone
    # need hips nearer to each other than any marker is
    if len(video) >= 3 or (hips is not None and hips < (WIDEST if video else NARROW)):
        return tuple([*video.values(), *sided.values()][:3])
    return ()


def measure_hips(markers: Iterable[MarkerSequence]) -> float | None:
    """Measure the distance of points that are named as hips, in lengths of the thigh; None without hips and knees."""
    ratios = [np.zeros(0)]
    for sequence in markers:
        place = {word: sequence.positions[:, i] for i, label in enumerate(sequence.labels)
                 if (word := parse_keypoint(label)) is not None}
        if not {("hip", "l"), ("hip", "r"), ("knee", "l"), ("knee", "r")} <= place.keys():
            continue
        thighs = sum(np.linalg.norm(place["hip", side] - place["knee", side], axis=1) for side in "lr") / 2
        ratios.append(np.linalg.norm(place["hip", "l"] - place["hip", "r"], axis=1)[thighs > 0] / thighs[thighs > 0])
    known = np.concatenate(ratios)
    return float(np.median(known)) if len(known) else None
