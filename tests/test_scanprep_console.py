"""Commands end with a table and a report, failures with one line and exit code 1, wrong usage with 2."""
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from scanprep import command_line, console
from scanprep.console import Metric, Outcome
from scanprep.judgement import Judgement
from scanprep.ranges import FLAG, Settings


@dataclasses.dataclass(frozen=True)
class Choices(Settings):
    weight: Annotated[float, FLAG] = 0.5


def work(out: Path, times: int = 2, settings: Choices = Choices()) -> Outcome:
    """Do the work."""
    if times > 99:
        raise ValueError(f"times: expected a count,\n got {times}")
    out.write_text("done")
    return Outcome(out, [Metric("distance", 0.00123456, "m"), Metric("times", times)], {"settings": settings},
                   ["scan7: empty"] if times == 7 else [], judgement=Judgement())


def test_done(tmp_path, capsys):
    out = tmp_path / "a.txt"
    assert command_line.run(work, "scape work", ["--out", str(out), "--weight", "0.25"]) == 0
    assert "0.00123" in capsys.readouterr().out
    report = json.loads((tmp_path / "a.txt.report.json").read_text())
    assert report["settings"]["settings"] == {"weight": 0.25}
    assert report["metrics"][0] == {"metric": "distance", "value": 0.00123456, "unit": "m"}
    assert {"numpy", "python", "machine"} <= set(report["versions"])


def test_ctrl_c_before_anything_is_loaded_is_one_line(tmp_path):
    """The first library that is imported interrupts; one that did not stop at once would be seen after a minute."""
    (tmp_path / "lazy_loader.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\n"
                                             "time.sleep(60)\n")
    run = subprocess.run([sys.executable, "-m", "completion", "--help"], capture_output=True, text=True, timeout=120,
                         env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
                         preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "scape: interrupted; nothing was written\n")


def test_a_log_file_gets_a_line_of_progress_now_and_then(capsys, monkeypatch):
    clock = iter(range(0, 10_000, 7))
    monkeypatch.setattr(console.time, "monotonic", lambda: 100.0 + next(clock))
    with console.bar("registering scans") as report_progress:
        for done in range(24):
            report_progress(done, 23)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "registering scans: 0 of 23 after 0 s" and lines[-1] == "registering scans: 23 of 23 after 161 s"
    seconds = [int(line.split()[-2]) for line in lines]
    assert len(lines) == 4 and min(np.diff(seconds[:-1])) > console.LOG_EVERY


# a command with two processes at work, which would end after a minute
WAITING = """
import sys, time
from pathlib import Path
from scanprep import command_line
from scanprep.batch.pool import Workers, run_jobs
from scanprep.batch.room import Job

def wait(name, context):
    Path(name).touch()
    time.sleep(60)

def work(out: Path):
    return list(run_jobs(wait, [Job(name, name, Path("files")) for name in ("a", "b")], Workers(2)))

if __name__ == "__main__":
    import waiting
    sys.exit(command_line.run(waiting.work, "scape work", ["--out", "made.txt"]))
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM")
@pytest.mark.parametrize("whom", ["the command", "its processes, too"])
def test_sigterm_ends_a_command_and_its_processes_with_one_line(tmp_path, whom):
    """A library of the processes warned of its own semaphores instead."""
    (tmp_path / "waiting.py").write_text(WAITING)
    begun = subprocess.Popen([sys.executable, "waiting.py"], cwd=tmp_path, stderr=subprocess.PIPE, text=True,
                             env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, start_new_session=True)
    while not ((tmp_path / "a").exists() and (tmp_path / "b").exists()):
        assert begun.poll() is None
        time.sleep(0.05)
    (os.kill if whom == "the command" else os.killpg)(begun.pid, signal.SIGTERM)
    assert begun.communicate(timeout=30)[1] == "scape work: interrupted; nothing was written\n"
    assert begun.returncode == 130 and not (tmp_path / "made.txt").exists()
