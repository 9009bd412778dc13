"""Every command and snippet of the documents runs, on files under the names that they use: README and first tasks.

The other documents are shared out over `test_readme_scans.py`, `test_readme_model.py` and `test_readme_completion.py`,
so that processes share the work; `readme_folder.PARTS` says who runs which.
"""
import re
import shlex

import pytest
from readme_folder import (
    PARTS,
    README,
    REST,
    ROOT,
    SET_UP,
    commands,
    commands_of_part,
    documents,
    run_command,
    run_snippet,
    snippets_of_part,
    user_folder,
)
from readme_user import of_a_user

from completion.__main__ import COMMANDS
from scanprep.command_line import Arguments, list_commands, load_command

pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    """The folder of a user in which the commands of the README and of its first pages were run."""
    folder = user_folder(demo_folder, tmp_path_factory.mktemp("readme"))
    with of_a_user(folder):
        for line in commands_of_part("start"):
            run_command(line)
    return folder


@pytest.fixture
def there(place):
    """Work in that folder."""
    with of_a_user(place):
        yield


def test_set_up_is_what_ci_does():
    assert SET_UP <= set(commands(README))
    ci = (ROOT / ".ci" / "run").read_text()
    assert 'pip install --quiet ".[test]"' in ci and '\npytest -m "slow or not slow"\n' in ci


def test_every_command_of_the_documents_is_understood():
    """Flags, kinds of values and ranges; what the commands make is looked at when they run, which takes minutes."""
    known = list_commands(COMMANDS, "scape")
    for part in (*PARTS, REST):
        for line in commands_of_part(part):
            words = shlex.split(line)
            path = next(path for k in (2, 3) if (path := " ".join(words[:k])) in known)
            words = words[len(path.split()):]
            Arguments(load_command(known[path]), path, words).read(words)


@pytest.mark.slow
def test_commands(place):
    for written in ("out/report.html", "completed/report.html", "walk/animation.glb", "walk.glb", "measures.csv",
                    "heavier.ply", "set/report.html", "evaluation/report.html", "he.ply"):
        assert (place / written).exists(), written


@pytest.mark.slow
@pytest.mark.parametrize("document, code", snippets_of_part("start"))
def test_snippets(there, place, document, code):
    run_snippet(document, code)
    if document == README:
        assert (place / "whole.ply").stat().st_size > 10_000


def test_every_document_is_run_by_one_file():
    found = [document for part in (*PARTS, REST) for document in documents(part)]
    assert len(found) == len(set(found))
    written = {README, *(f"{package}/README.md" for package in ("scanprep", "model", "completion")),
               *(path.relative_to(ROOT).as_posix() for path in (ROOT / ".docs" / "pages").rglob("*.md"))}
    assert set(found) == written


def test_first_screen_and_limits():
    text = (ROOT / README).read_text(encoding="utf-8")
    head = text[:1500]
    assert "![" in head and "scape demo" in head
    picture = re.search(r"!\[[^\]]*\]\(([^)]+)\)", head).group(1)
    assert (ROOT / picture).stat().st_size > 20_000
    assert "## What it does not do" in text


@pytest.mark.parametrize("document, lines", [(README, 150), *((f"{package}/README.md", 120) for package in
                                                             ("scanprep", "model", "completion"))])
def test_readmes_are_short(document, lines):
    assert len((ROOT / document).read_text(encoding="utf-8").splitlines()) <= lines
