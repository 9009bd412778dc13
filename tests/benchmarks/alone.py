"""A call in a process of its own, with a limit on its time: what it returned, how long it took, or why it did not.

The process imports the function's module before anything else, so that a package whose C++ library must be loaded first
is; it is this file, run as a program.
"""
from __future__ import annotations

import importlib
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


class MissingError(Exception):
    """A tool that is not installed."""


@dataclass(frozen=True)
class Outcome:
    """What became of a call.

    Attributes
    ----------
    value : what it returned, or None
    seconds : of the clock
    cpu_s : of the processor, all its threads and the programs it started
    why : {str: str or float}
        Empty where it returned; else one of "missing": what, "stopped": the limit, "failed": the error.
    """

    value: Any = None
    seconds: float = 0.0
    cpu_s: float = 0.0
    why: dict[str, Any] = field(default_factory=dict)


def processor_seconds() -> float:
    """Of this process, all its threads, and of the programs it started that have ended."""
    return sum(os.times()[:4])


def alone(limit: float, call: Callable[..., Any], *args: Any) -> Outcome:
    """Call a function of a module beside this one with arguments that can be pickled.

    It is stopped after `limit` seconds, with the programs that it started. What it prints is dropped.
    """
    module = call.__module__
    if module == "__main__":
        module = Path(sys.modules["__main__"].__file__ or "").stem
    with subprocess.Popen([sys.executable, __file__, module, call.__name__], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, start_new_session=True) as process:
        try:
            answer, _ = process.communicate(pickle.dumps(args), timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return Outcome(why={"stopped": limit})
    if not answer:
        return Outcome(why={"failed": f"the process ended with code {process.returncode}"})
    return Outcome(*pickle.loads(answer))


def main() -> None:
    """The other process: module and function on the command line, arguments by stdin, the outcome by stdout."""
    with os.fdopen(os.dup(1), "wb") as out, open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)             # progress bars
        value, why, wall, cpu = None, {}, time.perf_counter(), processor_seconds()
        try:
            call = getattr(importlib.import_module(sys.argv[1]), sys.argv[2])
            args = pickle.load(sys.stdin.buffer)
            wall, cpu = time.perf_counter(), processor_seconds()
            value = call(*args)
        except Exception as error:               # one tool that fails must not end the run
            kind = type(error).__name__          # by its name: this file is another module here
            why = {"missing": str(error)} if kind == "MissingError" else {"failed": f"{kind}: {error}"}
        pickle.dump((value, time.perf_counter() - wall, processor_seconds() - cpu, why), out)


if __name__ == "__main__":
    main()
