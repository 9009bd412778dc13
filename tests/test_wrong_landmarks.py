"""A fault in landmarks is named: exchanged names, exchanged sides, one landmark at another place."""
import numpy as np
import pytest

from completion import CompletionConfig
from completion.partial.wrong_landmarks import complete_named
from model import load_built_in_model
from scanprep import RegistrationConfig, register
from scanprep.registration.verdict import explain_by_landmarks, judge_registration
from scanprep.registration.wrong_landmarks import find_wrong_landmarks

PAIRED = "toe", "knee", "middle finger", "elbow outside"
NAMES = (*(f"{side} {name}" for name in PAIRED for side in ("left", "right")), "top of head", "navel")
FAULTS = {
    "the landmarks 'left knee' and 'right knee' seem exchanged": {"left knee": "right knee", "right knee": "left knee"},
    "left and right of the landmarks seem exchanged, or the scan is a mirror image": {
        name: name.replace("left", "?").replace("right", "left").replace("?", "right") for name in NAMES},
    "the landmark 'left elbow outside' seems to be 30 cm from its place": {},
    None: {}}


@pytest.fixture(scope="module")
def model():
    return load_built_in_model()


def landmarks_with(model, fault):
    """Vertices and places of landmarks on the template, with the fault; of an elbow, as it says."""
    known = model.info["landmarks"]
    vertices = np.array([known[name] for name in NAMES])
    points = model.template.vertices[[known[FAULTS[fault].get(name, name)] for name in NAMES]]
    if fault and "elbow" in fault:
        points[NAMES.index("left elbow outside")] += [0, 0, -0.3]
    return vertices, points


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_landmarks_is_named(model, fault):
    """The body is known: what speaks against landmarks is how far they are from its vertices."""
    body, landmarks = model.template, landmarks_with(model, fault)

    def fit_again(pairs):
        return float(np.linalg.norm(body.vertices[pairs[0]] - pairs[1], axis=1).sum() / 0.02), body.vertices

    found = find_wrong_landmarks(body, body, landmarks, NAMES, fit_again(landmarks)[0], fit_again)
    assert found is None if fault is None else found.startswith(f"{fault}: correct")
    # four landmarks are too few to tell which of them is wrong
    few = landmarks[0][:4], landmarks[1][:4]
    assert find_wrong_landmarks(body, body, few, NAMES[:4], 100.0, fit_again) is None


@pytest.mark.parametrize("fault", ["the landmark 'left elbow outside' seems to be 30 cm from its place", None])
def test_a_completion_names_the_landmark_that_is_wrong_first(model, fault):
    quick = CompletionConfig(rounds=3, scan_points=500, model_points=500)
    marks = {name: int(model.info["landmarks"][name]) for name in NAMES}
    done = complete_named(model, model.template, landmarks_with(model, fault), marks, quick, lambda done, total: None,
                          np.zeros(len(model.template.vertices), dtype=bool))
    assert done.judgement.reasons == () if fault is None else done.judgement.reasons[0].startswith(fault)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_registration_names_the_landmarks_that_are_wrong_first(model, fault):
    body, config = model.template, RegistrationConfig()
    scan, landmarks = body.sample(20_000, np.random.default_rng(0))[0], landmarks_with(model, fault)
    fit, known = register(body, scan, landmarks, config), {n: int(v) for n, v in model.info["landmarks"].items()}
    wrong = explain_by_landmarks(body, scan, fit, landmarks, known, None, config)
    assert wrong is None if fault is None else wrong.startswith(fault)
    reasons = judge_registration("scan", body, scan, fit, landmarks, None, wrong=wrong).reasons
    assert wrong is None or reasons[0] == wrong
