"""How many threads work: one for sums, whoever asks; the user's own number above all."""
import os
import subprocess
import sys

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (has an OpenBLAS of its own)
from completion_bodies import worm_with_prior
from threadpoolctl import threadpool_info, threadpool_limits

from completion import MarkerLayout, MarkerSequence, animate
from model import fit_pose, learn_scape
from model.learning.config import LearnConfig
from scanprep import threads
from scanprep.command_line import run
from scanprep.console import Metric, Outcome
from scanprep.threads import VARIABLES, begin_worker, one_thread, search_threads


def pools():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def nothing_asked(monkeypatch):
    """Two threads, as a library that nobody has told anything would take."""
    for name in (*VARIABLES, threads.LIBIGL):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(threads, "_in_worker", False)
    with threadpool_limits(2):
        assert pools() == {2}
        yield


def test_one_thread_while_anyone_needs_it():
    with one_thread():
        with one_thread():
            assert pools() == {1}
        assert pools() == {1}
    assert pools() == {2}
    with pytest.raises(ZeroDivisionError), one_thread():
        raise ZeroDivisionError
    assert pools() == {2}


def test_a_command_has_one_thread_and_leaves_the_settings_as_they_were(monkeypatch):
    seen = []

    def command() -> Outcome:
        """Look."""
        seen.append(pools())
        return Outcome(None, [Metric("nothing", 0)], judgement=None)

    assert run(command, "look", []) == 0 and seen == [{1}] and pools() == {2}
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert run(command, "look", []) == 0 and seen[1:] == [{2}]


def test_importing_the_packages_changes_no_setting():
    code = """
import os, numpy, scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits
threadpool_limits(2)
before = dict(os.environ)
import scanprep.command_line, model, completion
from scanprep import register; from model import learn_scape, fit_pose; from completion import mosh, complete, track
assert {p["num_threads"] for p in threadpool_info()} == {2} and dict(os.environ) == before
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(("asked", "number"), [(None, 1), ("2", 2)])
def test_a_worker_has_one_thread_for_all_it_does_or_the_users_number(monkeypatch, asked, number):
    if asked:
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
    for name in (*VARIABLES, threads.LIBIGL):                        # so that it is taken back after the test
        monkeypatch.setenv(name, os.environ.get(name, ""))
        if not os.environ[name]:
            monkeypatch.delenv(name)
    begin_worker()
    assert pools() == {number} and search_threads(10**6) == number
    assert os.environ[threads.LIBIGL] == os.environ["OMP_NUM_THREADS"] == str(number)


def test_the_same_bytes_whatever_the_threads_of_the_process():
    """The public functions limit themselves: a script gets what the command gets."""
    model = worm_with_prior()
    subject, rng = model.subject(None), np.random.default_rng(0)
    layout = MarkerLayout(tuple(f"M{i}" for i in range(60)), rng.choice(396, 60, replace=False), 0.01)
    poses = np.cumsum(rng.normal(0, 0.02, (60, 4, 3)), axis=0)
    meshes = subject.vertices(poses)
    places = np.stack([layout.place(subject.template.with_vertices(v)) for v in meshes])

    def all_of_them():
        learned = learn_scape(model.template, meshes[::10], meshes[:6], model.skeleton, LearnConfig(refinements=1))
        motion = animate(subject, MarkerSequence(places, layout.labels, 100.0), layout)
        fit = fit_pose(subject, meshes[-1])
        return [learned.pose_mean, learned.pose_covariance, *learned.pose_space.coefficients, motion.poses, fit.pose]

    two = all_of_them()
    with threadpool_limits(1):
        for a, b in zip(two, all_of_them(), strict=True):
            np.testing.assert_array_equal(a, b)
