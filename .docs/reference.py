"""The pages of the reference, written when the site is built: help of commands, public names, equations."""
from __future__ import annotations

import ast
import contextlib
import importlib
import io
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mkdocs_gen_files

ROOT = Path(__file__).parents[1]
PACKAGES = ("scanprep", "model", "completion")
sys.path.insert(0, str(ROOT))
os.environ["COLUMNS"] = "110"


def commands(prog: str, listed: dict[str, tuple[str, str]]) -> Iterator[str]:
    """Every command below a group with its help."""
    from scanprep import command_line

    for name, (_, target) in listed.items():
        module, function = target.split(":")
        found = importlib.import_module(module)
        if function == "group":
            yield from commands(f"{prog} {name}", found.COMMANDS)
            continue
        told = said(command_line, getattr(found, function), f"{prog} {name}", "--help")
        yield f"## {prog} {name}\n\n```text\n{told}\n```\n"
        if "--write-config" in told:
            settings = said(command_line, getattr(found, function), f"{prog} {name}", "--write-config")
            yield f"Settings for `--config`:\n\n```toml\n{settings}\n```\n"


def said(command_line: Any, function: Any, prog: str, flag: str) -> str:
    """What a command prints when it is asked for help or settings."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        command_line.run(function, prog, [flag])
    return re.sub(r"\x1b\[[0-9;]*m", "", shown.getvalue()).strip()


def public_names() -> Iterator[tuple[str, str]]:
    """Package and full name of what each package's stub offers."""
    for package in PACKAGES:
        for node in ast.parse((ROOT / package / "__init__.pyi").read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    yield package, f"{package}.{node.module}.{alias.name}"


def equations() -> dict[tuple[str, int], set[str]]:
    """(paper, equation) -> where it is: file and function or class."""
    found: dict[tuple[str, int], set[str]] = defaultdict(set)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            nodes = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef | ast.ClassDef)]
            owners = sorted((node.lineno, node.end_lineno or node.lineno, node.name) for node in nodes)
            for i, line in enumerate(text.splitlines(), 1):
                for key, numbers in re.findall(r"\[([A-Za-z-]+)\] Eq\. (\d+(?:(?:-|, | and )\d+)*)", line):
                    around = [name for first, last, name in owners if first <= i <= last]
                    where = f"`{path.relative_to(ROOT)}`" + (f" {around[-1]}" if around else "")
                    for first, last in re.findall(r"(\d+)(?:-(\d+))?", numbers):
                        for number in range(int(first), int(last or first) + 1):
                            found[key, number].add(where)
    return found


def main() -> None:
    from completion.__main__ import COMMANDS

    with mkdocs_gen_files.open("commands.md", "w") as page:
        page.write("# Commands\n\n" + "\n".join(commands("scape", COMMANDS)))
    with mkdocs_gen_files.open("python.md", "w") as page:
        page.write("# Python\n")
        last = ""
        for package, name in public_names():
            page.write(f"\n## {package}\n" if package != last else "")
            page.write(f"\n::: {name}\n")
            last = package
    with mkdocs_gen_files.open("equations.md", "w") as page:
        page.write("# Equations\n\n| paper | equation | where |\n|---|---|---|\n")
        for (key, number), places in sorted(equations().items()):
            page.write(f"| {key} | {number} | {'<br>'.join(sorted(places))} |\n")


main()
