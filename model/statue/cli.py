"""`scape statue`: its commands, which are imported when they are called, so that help answers at once."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from scanprep.arguments import Place
from scanprep.command_line import dispatch

StatueArg = Annotated[Path, Place("STATUE")]
MotionArg = Annotated[Path, Place("MOTION")]
LevelArg = Literal[0, 1, 2, 3, 4]

COMMANDS = {
    "fit": ("A scan -> control model, displacement map and texture.", "model.statue.commands:fit"),
    "reconstruct": ("The detailed surface of a statue at any level, of an edited map too.",
                    "model.statue.commands:reconstruct"),
    "animate": ("A statue in motion: of markers, BVH, or key poses.", "model.statue.commands:animate"),
}


def group(argv: list[str]) -> int:
    """The commands of `scape statue`."""
    return dispatch(COMMANDS, "scape statue", argv,
                    "One scan of one person becomes a layered character that moves, with all its detail.")
