"""The command `scape completion`: the script with which a shell completes commands and flags."""
from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Annotated, Literal

from scanprep.arguments import Place
from scanprep.command_line import Arguments, load_command
from scanprep.console import Outcome

ShellArg = Annotated[Literal["bash", "zsh"], Place("SHELL")]
# zsh runs it by its own emulation of bash; where nothing is offered, both complete names of files
SCRIPT = """_scape() {{
    local at=scape cur="${{COMP_WORDS[COMP_CWORD]}}" words="" word
    for word in "${{COMP_WORDS[@]:1:$((COMP_CWORD - 1))}}"; do
        case "$at $word" in {paths}) at="$at $word";; esac
    done
    case "$at ${{COMP_WORDS[$((COMP_CWORD - 1))]}}" in
{values}
    *) case "$at $cur" in
{words}
    esac;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$cur"))
}}
complete -o default -F _scape scape
"""


def write_shell(shell: ShellArg) -> Outcome:
    """Print the script by which a shell completes `scape`, all its commands and their flags.

    Example: scape completion bash > ~/.local/share/bash-completion/completions/scape

    Args:
        shell: bash, or zsh, in whose .zshrc the line eval "$(scape completion zsh)" stands after compinit.
    """
    from .__main__ import COMMANDS

    paths, values, words = list[str](), list[str](), list[str]()
    _collect("scape", COMMANDS, paths, values, words)
    script = SCRIPT.format(paths="|".join(paths), values="\n".join(values), words="\n".join(words))
    sys.stdout.write(("autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else "") + script)
    return Outcome(None, [], judgement=None)


def _collect(prog: str, commands: Mapping[str, tuple[str, str]], paths: list[str], values: list[str],
             words: list[str]) -> None:
    """Add the lines of the script for the commands of a group, and for everything below."""
    words.append(f'    "{prog} $cur") words="{" ".join(commands)}";;')
    for name, (_, target) in commands.items():
        function, path = load_command(target), f"{prog} {name}"
        paths.append(f'"{path}"')
        if function.__name__ == "group":
            _collect(path, sys.modules[function.__module__].COMMANDS, paths, values, words)
            continue
        listed = Arguments(function, path, []).listed
        flags = [flag for argument in listed for flag in argument.flags]
        words.append(f'    "{path} -"*) words="{" ".join([*flags, "--help"])}";;')
        for argument in listed:
            if argument.choices:
                patterns = "|".join(f'"{path} {flag}"' for flag in argument.flags) or f'"{path} {name}"'
                values.append(f'    {patterns}) words="{" ".join(map(str, argument.choices))}";;')
