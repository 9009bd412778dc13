"""The command `scape completion`: the script with which a shell completes commands and flags."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from scanprep.arguments import Argument, Place
from scanprep.command_line import Arguments, load_command
from scanprep.console import Outcome

ShellArg = Annotated[Literal["bash", "zsh", "tcsh"], Place("SHELL")]


def write_shell(shell: ShellArg) -> Outcome:
    """Print the script by which a shell completes `scape`, all its commands and their flags.

    Example: scape completion bash > ~/.local/share/bash-completion/completions/scape

    Args:
        shell: bash, zsh or tcsh. For zsh the file is _scape in a folder of $fpath.
    """
    import shtab

    from .__main__ import COMMANDS

    parser = argparse.ArgumentParser(prog="scape")
    _add(parser, COMMANDS, "scape")
    sys.stdout.write(shtab.complete(parser, shell) + "\n")
    return Outcome(None, [], judgement=None)


def _add(parser: argparse.ArgumentParser, commands: Mapping[str, tuple[str, str]], prog: str) -> None:
    """Add the commands of a group, and everything below, as subparsers."""
    below = parser.add_subparsers()
    for name, (text, target) in commands.items():
        function, path = load_command(target), f"{prog} {name}"
        if function.__name__ == "group":
            _add(below.add_parser(name, help=text, prog=path), sys.modules[function.__module__].COMMANDS, path)
        else:
            made = Arguments(function, path, []).parser(_offer)
            below.add_parser(name, help=text, prog=path, parents=[made], add_help=False)


def _offer(argument: Argument, action: argparse.Action) -> None:
    """Set what the shell offers as value of an argument: its choices, or files."""
    import shtab

    if argument.choices:
        action.choices = argument.choices
    elif Path in (argument.type, *argument.parts):
        action.complete = shtab.FILE            # type: ignore[attr-defined]
