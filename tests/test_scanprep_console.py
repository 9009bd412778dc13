"""Commands end with a table and a report, failures with one line and exit code 1, wrong usage with 2."""
import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np

from scanprep import command_line
from scanprep.console import Metric, Outcome
from scanprep.geometry import storage
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


def test_failed_is_one_line(tmp_path, capsys):
    assert command_line.run(work, "scape work", ["--out", str(tmp_path / "a"), "--times", "100"]) == 1
    shown = capsys.readouterr()
    assert shown.err == "scape work: --times: expected a count, got 100\n" and not shown.out
    assert not list(tmp_path.iterdir())


def test_some_failed(tmp_path, capsys):
    assert command_line.run(work, "scape work", ["--out", str(tmp_path / "a.txt"), "--times", "7"]) == 1
    assert "failed: scan7: empty" in capsys.readouterr().err


def test_wrong_usage(tmp_path):
    assert command_line.run(work, "scape work", ["--no-such"]) == 2
    assert command_line.dispatch({"work": ("Do it.", "nowhere:work")}, "scape", ["nothing"], "lead") == 2
    assert command_line.dispatch({"work": ("Do it.", "nowhere:work")}, "scape", [], "lead") == 2


def test_help_imports_nothing(capsys):
    assert command_line.dispatch({"work": ("Do it.", "nowhere:work")}, "scape", ["--help"], "lead") == 0
    assert "Do it." in capsys.readouterr().out


def test_plain_survives_json():
    value = {"a": np.float64(1.5), "b": np.arange(3), "c": Choices(), "d": (Path("x"), None)}
    assert json.loads(json.dumps(storage.as_json(value))) == {
        "a": 1.5, "b": [0, 1, 2], "c": {"weight": 0.5}, "d": ["x", None]}


def test_ctrl_c_before_anything_is_loaded_is_one_line(tmp_path):
    """The first library that is imported interrupts; one that did not stop at once would be seen after a minute."""
    (tmp_path / "lazy_loader.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\n"
                                             "time.sleep(60)\n")
    run = subprocess.run([sys.executable, "-m", "completion", "--help"], capture_output=True, text=True, timeout=120,
                         env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
                         preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    assert (run.returncode, run.stdout, run.stderr) == (130, "", "scape: interrupted; nothing was written\n")
