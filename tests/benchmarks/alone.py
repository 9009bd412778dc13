"""A call in a process of its own, with a limit on its time: what it returned, how long it took, or why it did not."""
from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any


class Missing(Exception):
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

    value: Any
    seconds: float
    cpu_s: float
    why: dict[str, Any]


def processor_seconds() -> float:
    """Of this process and of the programs it started that have ended."""
    return sum(os.times()[:4])


def alone(limit: float, call: Callable[..., Any], *args: Any) -> Outcome:
    """Call a function of a module with arguments that can be pickled; it is stopped after `limit` seconds."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(theirs, call, args))
    process.start()
    theirs.close()
    try:
        if not ours.poll(limit):
            return Outcome(None, limit, float("nan"), {"stopped": limit})
        return Outcome(*ours.recv())
    except EOFError:
        process.join()
        return Outcome(None, 0.0, 0.0, {"failed": f"the process ended with code {process.exitcode}"})
    finally:
        _end(process)


def _run(out: Connection, call: Callable[..., Any], args: tuple[Any, ...]) -> None:
    if hasattr(os, "setsid"):
        os.setsid()                              # so that the programs it starts are stopped with it
    value, why = None, {}
    wall, cpu = time.perf_counter(), processor_seconds()
    try:
        value = call(*args)
    except Missing as missing:
        why = {"missing": str(missing)}
    except Exception as error:                   # one tool that fails must not end the run
        why = {"failed": f"{type(error).__name__}: {error}"}
    out.send((value, time.perf_counter() - wall, processor_seconds() - cpu, why))


def _end(process: Any) -> None:
    if not process.is_alive():
        process.join()
        return
    process.join(5)
    if process.is_alive():
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.join()
