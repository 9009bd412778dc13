"""Names of landmarks, with the synonyms that people and other programs use."""
from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from .sides import split_side

# Our name of a landmark, in the middle of the body or, without its side, on either side; then its synonyms in lower
# case without side and punctuation: what people write, the SCAPE and SPRING meshes, CAESAR, ISO 7250.
MIDDLE = {
    "top of head": ("crown", "head top", "head", "vertex", "apex"), "navel": ("belly button", "omphalion", "cornea"),
    "back": ("cornea on the back similar position",), "crotch": ("between two legs", "perineum"),
    "neck front": ("suprasternale", "throat"), "neck back": ("cervicale", "c7", "nape"),
    "nose tip": ("tip of nose", "nose", "pronasale"), "mouth": ("mouse middle",), "chin": ("menton",)}
PAIRED = {
    "toe": ("foot", "toes", "toe tip", "big toe", "toe in leg", "digit ii", "foot tip"),
    "heel": ("heel in leg", "calcaneous post", "heel back"), "ankle": ("lateral malleolus", "ankle outside"),
    "knee": ("knee in leg", "knee front", "knee outside", "kneecap", "patella", "femoral lateral epicn"),
    "knee inside": ("knee inside in leg", "femoral medial epicn"),
    "waist": ("waist side", "10th rib"), "hip": ("trochanterion",),
    "middle finger": ("hand", "middle finger hand", "middle finger tip", "fingertip", "finger", "hand tip",
                      "dactylion"),
    "thumb": ("thumb tip",), "wrist": ("radial styloid",),
    "elbow outside": ("elbow", "elbow outside arm", "olecranon", "elbow back"),
    "elbow inside": ("elbow inside arm", "humeral medial epicn"),
    "shoulder": ("shoulder upper side", "acromion", "shoulder top"),
    "armpit": ("shoulder bottom side", "axilla ant", "axilla"),
    "nipple": ("tit", "thelion bustpoint", "breast"), "eye": ("ectocanthus",), "ear": ("tragion",)}
# the ten landmarks that the README asks for: ends and bends of limbs, easy to find
TEN = ("top of head", "navel", *(f"{side} {name}" for name in ("middle finger", "toe", "elbow outside", "knee")
                                 for side in ("left", "right")))
# points of the surface of a head, from the front to the back
FACE = ("nose tip", "mouth", "chin", "left eye", "right eye", "left ear", "right ear", "top of head")
_KNOWN = {form: name for names in (MIDDLE, PAIRED) for name, forms in names.items() for form in (name, *forms)}


def landmark_name(name: str) -> str:
    """Return our name of a landmark, for any case, spacing, spelling of the side, and synonym.

    Examples
    --------
    >>> [landmark_name(name) for name in ("LeftHand", "l_hand", "hand left", "Hand_L", "Middle finger, left hand")]
    ['left middle finger', 'left middle finger', 'left middle finger', 'left middle finger', 'left middle finger']
    >>> landmark_name("crown"), landmark_name("scar 3")
    ('top of head', 'scar 3')
    """
    plain, side = split_side(name.strip())
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain).lower()
    words = " ".join(re.sub(r"[\W_]+", " ", words).split())
    known = _KNOWN.get(words, words)
    if bool(side) != (known in PAIRED) and known in {**MIDDLE, **PAIRED}:       # "left navel", or an elbow of no side
        known = words
    return f"{side} {known}".strip()


def translate_landmarks(landmarks: Mapping[str, Any]) -> dict[str, Any]:
    """Rename landmarks to our names: `left knee` for `knee in left leg` or `Lt. Femoral Lateral Epicn.`.

    Of several names of one place, our spelling counts, else the first.
    """
    out: dict[str, Any] = {}
    for name, value in landmarks.items():
        our_name = landmark_name(name)
        if our_name not in out or name == our_name:
            out[our_name] = value
    return out


def pair_names(ours: Iterable[str], theirs: Iterable[str]) -> list[tuple[str, str]]:
    """Pair names (ours, theirs) of the same places, in our order; equal names before synonyms."""
    theirs = list(theirs)
    same = set(ours) & set(theirs)
    by_meaning: dict[str, str] = {}
    for name in theirs:
        if name not in same:
            by_meaning.setdefault(landmark_name(name), name)
    pairs = []
    for name in ours:
        other = name if name in same else by_meaning.pop(landmark_name(name), None)
        if other is not None:
            pairs.append((name, other))
    return pairs
