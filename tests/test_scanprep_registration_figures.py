"""How sure a registration is, from all its evidence together."""
from dataclasses import replace

import numpy as np
import pytest

from scanprep.registration.figures import EVIDENCE, WEIGHTS, Limits, ScanFigures, evidence_of, probability_right, review
from scanprep.registration.limbs import PlausibilityIssue

FINE = ScanFigures("a", "model people", 0.001, 0.001, 0.9, 0.9, 0.001, 0.002, np.nan, 0, True)
SIZE, FACES = 1.4, 25_000


def judge(figures=FINE, doubts=(), limits=None):
    return review([figures], {}, SIZE, FACES, limits, {"a": doubts}, 0.1)[0]


def test_no_evidence_speaks_for_a_registration():
    """A logistic model: with nothing against it the odds are those of `certain`; each weight only lowers them."""
    best = probability_right({})
    assert np.log(best / (1 - best)) == pytest.approx(WEIGHTS["certain"])
    for name in EVIDENCE:
        odds = [probability_right({name: value}) for value in (0.0, 1.0, 10.0)]
        assert odds[0] == best and odds == sorted(odds, reverse=True)
        # twice and four times of one plus a multiple lower the log-odds by as much
        logits = [np.log(p / (1 - p)) for p in (best, probability_right({name: 1.0}), probability_right({name: 3.0}))]
        assert logits[0] - logits[1] == pytest.approx(logits[1] - logits[2])


def test_evidence_is_told_in_multiples_of_limits():
    worse = ScanFigures("a", "", 2 * Limits().distance * SIZE, 0.001, 0.9 - 3 * Limits().unseen, 0.9,
                        4 * Limits().missed, 5 * Limits().stretch, np.nan, round(6 * Limits().inverted * FACES), False)
    found = evidence_of(worse, SIZE, FACES, 0.1, Limits(),
                        [PlausibilityIssue(1.5, "one"), PlausibilityIssue(2.0, "another")])
    assert found == pytest.approx({"missed": 4, "distance": 2, "unseen": 3, "stretch": 5, "inverted": 6, "landmarks": 0,
                                   "not_converged": 0.5, "limbs": 3.5})


def test_many_small_doubts_need_a_look_together():
    """Each is below its limit; the reason says what all of them leave."""
    assert not judge().suspect and 0.75 < judge().right < 0.85
    doubts = [PlausibilityIssue(0.99, f"limb {k}") for k in range(12)]
    told = judge(doubts=doubts)
    assert told.right < 0.5 and told.badness == 1.0 and told.suspect
    assert told.reasons == (f"all figures together leave {100 * told.right:.0f}% that it is right within 20 mm",)
    assert not judge(doubts=doubts, limits=Limits(right=0.0)).suspect


def test_skin_of_unlike_people_may_be_stretched():
    """Two people that are true to each other, vertex by vertex, have 5% stretched to the double or half; not 10%."""
    assert not judge(replace(FINE, stretch=0.053)).suspect
    why = "10.0% of the surface stretched or shrunk to the double or half"
    assert judge(replace(FINE, stretch=0.1)).reasons == (why,)


def test_of_what_is_no_person_no_probability_is_told():
    assert np.isnan(review([FINE], {}, SIZE, FACES, None, None, 0.1)[0].right)
    assert review([FINE], {"a": "why"}, SIZE, FACES, None, {"a": ()}, 0.1)[0].right == 0
    assert judge(ScanFigures("a", "", np.nan, np.nan, 0.0, 0.0, 1.0, 0.0, np.nan, 0, False)).right == 0


def test_one_view_of_a_person_is_as_usual_and_of_something_else_is_not():
    """Among whole scans: a person's limbs are doubted one by one, a crab's unseen half as a whole."""
    whole = [replace(FINE, name=f"whole{k}", seen=0.95) for k in range(3)]
    figures = [*whole, replace(FINE, name="view", seen=0.34)]
    verdicts = {v.name: v for v in review(figures, {}, SIZE, FACES, doubts={})}
    assert not any(verdict.suspect for verdict in verdicts.values())
    assert review([*whole, replace(FINE, name="feet", seen=0.1)], {}, SIZE, FACES, doubts={})[0].name == "feet"
    crab = review(figures, {}, SIZE, FACES)[0]
    assert crab.name == "view" and crab.reasons[0].startswith("66% without data, 5% is usual")
