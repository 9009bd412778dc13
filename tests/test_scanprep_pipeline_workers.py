"""The workers of a folder of scans: killed, in processes or on a cluster, they change nothing."""
import dataclasses
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from scan_folders import MARKS, QUICK, contents, write_scans
from test_scanprep_pipeline import ball_template, three_scans  # noqa: F401 -- fixtures

from scanprep.batch import cluster
from scanprep.batch.ownership import HOME
from scanprep.batch.pool import Workers, run_jobs
from scanprep.batch.room import Failure, Job
from scanprep.pipeline.prepare import RegisterScan, prepare
from scanprep.pipeline.scans import find_scans


@pytest.fixture(scope="module")
def six(tmp_path_factory, template):
    """Six scans, one of them broken, and the set that a single process makes of them without being disturbed."""
    place = tmp_path_factory.mktemp("six")
    scans = write_scans(place / "scans", template, 6)
    (scans / "body3.ply").write_bytes((scans / "body3.ply").read_bytes()[:-50])
    done = prepare(find_scans(scans), template, MARKS, place / "one" / "set", QUICK)
    assert len(done.figures) == 5 and len(done.failures) == 1
    return scans, place / "one" / "set"


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGINT])
def test_killed_in_the_middle_and_started_again(six, template, tmp_path, sign):
    scans, whole = six
    command = [sys.executable, str(Path(__file__).with_name("scan_folders.py")), str(scans), str(tmp_path / "set")]
    run = subprocess.Popen([*command, "2"], start_new_session=True)
    deadline = time.monotonic() + 120
    while len(done := finished(tmp_path / "set")) < 2:
        assert run.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    os.killpg(run.pid, sign)                    # as Ctrl-C does in a terminal: the workers too
    assert run.wait(60) == (130 if sign == signal.SIGINT else -sign)
    done = finished(tmp_path / "set")
    assert 2 <= len(done) < 5, "killed too late to show anything"
    if sign == signal.SIGINT:
        assert '<section class="scan ' in (tmp_path / "set" / "report.html").read_text()
    stamps = {name: (tmp_path / "set" / "meshes" / f"{name}.ply").stat().st_mtime_ns for name in done}
    again = prepare(find_scans(scans), template, MARKS, tmp_path / "set", QUICK)
    assert again.fresh == 5 - len(done)
    assert {name: (tmp_path / "set" / "meshes" / f"{name}.ply").stat().st_mtime_ns for name in done} == stamps
    assert contents(tmp_path / "set") == contents(whole)


def finished(folder):
    return [p.name.removeprefix("scans%2F").removesuffix(".npz") for p in (folder / HOME / "done").glob("scans*.npz")]


@pytest.mark.slow
@pytest.mark.parametrize("processes, seen", [(True, True), (False, False)])
def test_a_cluster_changes_nothing(six, template, tmp_path, processes, seen, monkeypatch):
    """Nor one whose workers do not see the files, which then travel along."""
    distributed = pytest.importorskip("distributed", reason='Dask is not installed: pip install "scapekit[cluster]"')
    scans, whole = six
    layout = {"n_workers": 2, "threads_per_worker": 1} if processes else {"n_workers": 1, "threads_per_worker": 3}
    with distributed.LocalCluster(processes=processes, dashboard_address=None, **layout) as local:
        if not seen:
            monkeypatch.setattr(cluster, "_has_same_files", lambda client, given: False)
        config = dataclasses.replace(QUICK, workers=Workers(local.scheduler_address))
        prepare(find_scans(scans), template, MARKS, tmp_path / "set", config)
    assert contents(tmp_path / "set") == contents(whole)


def test_no_scheduler(scans, template, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason='Dask is not installed: pip install "scapekit[cluster]"')
    monkeypatch.setattr(cluster, "ANSWER", 1)
    config = dataclasses.replace(QUICK, workers=Workers("tcp://127.0.0.1:1"))
    with pytest.raises(ValueError, match=r"none answers at tcp://127\.0\.0\.1:1"):
        prepare(find_scans(scans), template, MARKS, tmp_path / "set", config)


def test_a_scheduler_without_dask_is_told_in_a_line(scans, template, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    config = dataclasses.replace(QUICK, workers=Workers("tcp://127.0.0.1:1"))
    with pytest.raises(ValueError, match=r'which needs: pip install "scapekit\[cluster\]"'):
        prepare(find_scans(scans), template, MARKS, tmp_path / "set", config)


def test_workers_of_another_version(scans, template):
    shared = pickle.dumps((RegisterScan(template, MARKS, QUICK.scan), {"scapekit": "0.0.0", "numpy": "1"}))
    with pytest.raises(RuntimeError, match=r"the worker has scapekit .*sources [0-9a-f]{12} and numpy"):
        cluster.do_there(shared, pickle.dumps(("body0", "", find_scans(scans)[0], None)))


@dataclasses.dataclass(frozen=True)
class Deadly:
    """Dies of the second job."""

    def __call__(self, given, room):
        if given == 1:
            os._exit(9)
        return given


@pytest.mark.slow
def test_a_process_that_dies_stops_no_other_job(tmp_path):
    jobs = [Job(f"body{k}", k, tmp_path / str(k)) for k in range(3)]
    outcomes = {job.given: outcome for job, outcome in run_jobs(Deadly(), jobs, Workers(2))}
    assert outcomes[0] == 0 and outcomes[2] == 2
    assert isinstance(outcomes[1], Failure) and outcomes[1].reason.startswith("body1: the process at work on it died")
