"""Damages files of every kind that the project reads and tries to read them.

    python tests/fuzz.py --count 2000          or        python tests/fuzz.py --hours 1 --seed 7

A damaged file is read, and then what was read is sound; or it is refused by a ValueError or OSError that names it in
one line. Anything else is printed, with the command that makes it again, and the exit code is 1; so is a reader that
takes more than 2 s of processor time or 500 MB. The last line is JSON: read, refused, failed, longest, largest.
"""
from __future__ import annotations

import argparse
import contextlib
import json
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_mutations import mutated
from fuzz_seeds import Seed, make_seeds

SECONDS, MEGABYTES = 2.0, 500.0


class Slow(BaseException):
    """Raised by the alarm: the readers catch no such thing."""


def _alarm(*_: Any) -> None:
    raise Slow


def resident(peak: bool) -> float:
    """Megabytes that the process holds, or the most it held since `forget_peak`."""
    with open("/proc/self/status", encoding="ascii") as lines:
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM" if peak else "VmRSS"))


def forget_peak() -> None:
    with open("/proc/self/clear_refs", "w", encoding="ascii") as out:
        out.write("5")


def try_once(seed: Seed, name: str) -> tuple[str, str]:
    """("read" | "refused" | "failed", what was said) of the file that stands there now."""
    with warnings.catch_warnings(record=True) as said, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        try:
            found = seed.read(seed.path)
            outcome, text = "read", ""
        except (ValueError, OSError) as error:
            outcome, text = "refused", str(error)
            here: BaseException | None = error
            while here is not None:
                if isinstance(here, MemoryError) and "its header is damaged" not in text:      # brackets in brackets
                    return "failed", f"it asked for too much memory: {text}"
                here = here.__context__
        except Slow:
            return "failed", "it took too long"
        except Exception:
            return "failed", traceback.format_exc()
        if outcome == "refused" and (name not in text or "\n" in text or "allow_pickle" in text):
            return "failed", f"refused, but by a message that does not fit: {text[:300]!r}"
        strange = [w for w in said if w.category is UserWarning and name not in str(w.message)]
        if strange:
            return "failed", f"warns of something else: {strange[0].message}"
        if outcome == "read":
            try:
                seed.check(found)
            except Slow:
                return "failed", "the check took too long"
            except Exception:
                return "failed", "read, but not sound: " + traceback.format_exc()
    return outcome, text


def guard() -> None:
    """Let a huge allocation fail at once, instead of being lazy, and set the alarm."""
    size = int((resident(False) + 6000) * 2**20)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_AS, (size, resource.getrlimit(resource.RLIMIT_AS)[1]))
    signal.signal(signal.SIGPROF, _alarm)


def measure(seed: Seed, most_seconds: float, most_megabytes: float) -> tuple[str, str, float, float]:
    """The outcome and text of `try_once`, seconds of the processor, and megabytes; failed where they are too many."""
    forget_peak()
    before, start = resident(False), time.process_time()
    signal.setitimer(signal.ITIMER_PROF, 3 * most_seconds)
    try:
        outcome, text = try_once(seed, seed.path.name)
    except Slow:
        outcome, text = "failed", "it took too long"
    signal.setitimer(signal.ITIMER_PROF, 0)
    seconds, megabytes = time.process_time() - start, resident(True) - before
    if outcome != "failed" and (seconds > most_seconds or megabytes > most_megabytes):
        outcome, text = "failed", f"{seconds:.1f} s, {megabytes:.0f} MB: {text}"
    return outcome, text, seconds, megabytes


def run(count: int, hours: float, first: int, only: str) -> dict[str, Any]:
    """Try `count` damaged files, or as many as fit into some hours; the figures, and what failed."""
    told: dict[str, Any] = {"read": 0, "refused": 0, "failed": 0, "longest_s": 0.0, "largest_MB": 0.0}
    guard()
    end = time.monotonic() + 3600 * hours
    with tempfile.TemporaryDirectory() as folder:
        seeds = [seed for seed in make_seeds(Path(folder)) if only in str(seed.path.relative_to(folder))]
        good = [seed.path.read_bytes() for seed in seeds]
        for seed in seeds:
            assert try_once(seed, seed.path.name)[0] == "read", (seed.path, try_once(seed, seed.path.name))
        number = first
        while number < first + count if not hours else time.monotonic() < end:
            which = number % len(seeds)
            seed, data = seeds[which], mutated(good[which], seeds[which].path.name, np.random.default_rng(number))
            seed.path.write_bytes(data)
            outcome, text, seconds, megabytes = measure(seed, SECONDS, MEGABYTES)
            told[outcome] += 1
            told["longest_s"] = max(told["longest_s"], round(seconds, 2))
            told["largest_MB"] = max(told["largest_MB"], round(megabytes))
            if outcome == "failed":
                print(f"--- {seed.path.relative_to(folder)}: {text.strip()}\n    again: python tests/fuzz.py --count 1 "
                      f"--seed {number}" + (f" --only {only}" if only else ""))
            seed.path.write_bytes(good[which])
            number += 1
    return {**told, "kinds": len(seeds), "next_seed": number}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of the path of a seed, as printed")
    args = parser.parse_args()
    figures = run(args.count, args.hours, args.seed, args.only)
    print(json.dumps(figures))
    sys.exit(1 if figures["failed"] else 0)
