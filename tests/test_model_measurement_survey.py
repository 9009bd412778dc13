"""Percentiles of people who were measured: the table's own quantiles, order, ends, and who it knows."""
import numpy as np
import pytest

from model.measurement.catalogue import CATALOGUE
from model.measurement.survey import ALIKE, WORDS, ordinal, percentiles, survey

SEXES = tuple(WORDS)


@pytest.mark.parametrize("sex", SEXES)
def test_the_table_says_what_it_says(sex):
    """Its quantiles are their own percentiles, its means near the middle, its correlation one."""
    table = survey(sex)
    assert (np.diff(table.quantiles[:-1], axis=1) > 0).all()
    assert np.array_equal(table.correlation, table.correlation.T)
    assert np.linalg.eigvalsh(table.correlation).min() > 0 and np.allclose(np.diag(table.correlation), 1)
    for name in ALIKE:
        quantiles = table.quantiles[table.names.index(name)]
        for share, value in zip(table.shares, quantiles, strict=True):
            assert percentiles({name: value}, sex)[name] == pytest.approx(100 * share, abs=1e-6)
        assert 35 < percentiles({name: table.mean[table.names.index(name)]}, sex)[name] < 65
    assert set(table.names) - {"weight", "knee_height", "age"} <= {
        name.removesuffix("_left").removesuffix("_right") for name in CATALOGUE}


def test_sides_and_what_is_not_known():
    both = percentiles({"calf_girth_left": 0.39, "calf_girth_right": 0.39, "knee_girth_left": 0.4,
                        "waist_girth": np.nan, "hand_length_left": 0.19}, "male")
    assert list(both) == ["calf_girth_left", "calf_girth_right"] and len(set(both.values())) == 1
    with pytest.raises(ValueError, match="sex: expected 'female' or 'male', got 'man'"):
        survey("man")


@pytest.mark.parametrize(("share", "words"), [(51.7, "52nd"), (1.4, "1st"), (3.3, "3rd"), (11, "11th"), (12, "12th"),
                                              (13, "13th"), (21, "21st"), (99.2, "above 99th"), (0.4, "below 1st")])
def test_ordinals(share, words):
    assert ordinal(share) == words
