"""Work side by side in processes gives what one process gives, also where one dies."""
import os

import numpy as np
import pytest

from scanprep.batch import pool
from scanprep.batch.pool import SideBySide


@pytest.fixture
def two_helpers(monkeypatch):
    monkeypatch.setattr(pool, "helpers", lambda at_most: 2)
    monkeypatch.setattr(SideBySide, "WORTH", -1.0)


def test_side_by_side_gives_what_one_process_gives(two_helpers):
    rng, here = np.random.default_rng(0), os.getpid()
    items = [rng.normal(size=(20, 300)) for _ in range(9)]
    with SideBySide(lambda x: (os.getpid(), np.linalg.inv(x @ x.T)), items) as found:
        made = {number: found(number) for number in range(9) if number != 4}         # what is not wanted does no harm
    for number, (process, value) in made.items():
        assert (process == here) == (number == 0)
        assert value.tobytes() == np.linalg.inv(items[number] @ items[number].T).tobytes()
    assert len({process for process, _ in made.values()}) <= 3


def test_side_by_side_where_processes_die_or_fail(two_helpers):
    here = os.getpid()

    def work(item):
        if item == 3 and os.getpid() != here:
            os.kill(os.getpid(), 9)
        if item == 5:
            raise ValueError("five")
        return os.getpid()

    with SideBySide(work, list(range(6))) as found:
        made = [found(number) for number in range(5)]
        assert made[0] == made[3] == made[4] == here             # from then on in this process
        with pytest.raises(ValueError, match="five"):
            found(5)
