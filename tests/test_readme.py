"""Every command and snippet of the README runs, on files under the names that it uses; then those of two packages.

One file, so that one process does it all: these READMEs go on with what the commands of the README wrote. That of
`model` needs only what the demonstration did: `test_readme_model.py`.
"""
import re

import pytest
from readme_folder import ROOT, SET_UP, blocks, commands, run_commands, user_folder, with_demo_model
from readme_user import of_a_user

README = (ROOT / "README.md").read_text(encoding="utf-8")
PACKAGES = [f"{package}/README.md" for package in ("scanprep", "completion")]
pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    """The folder of a user in which the commands of the README were run."""
    folder = user_folder(demo_folder, tmp_path_factory.mktemp("readme"))
    with of_a_user(folder):
        run_commands("README.md")
    return folder


@pytest.fixture(scope="module")
def results(place):
    """The same folder for the READMEs of the packages."""
    return with_demo_model(place)


@pytest.fixture(autouse=True)
def there(request):
    """Work in that folder."""
    if "place" not in request.fixturenames:
        yield
        return
    with of_a_user(request.getfixturevalue("place")):
        yield


def test_set_up_is_what_ci_does():
    assert SET_UP <= set(commands("README.md"))
    ci = (ROOT / ".ci" / "run").read_text()
    assert 'pip install --quiet ".[test]"' in ci and "\npytest\n" in ci


def test_commands(place):
    for written in ("out/report.html", "completed/report.html", "walk/animation.glb", "person/report.html", "walk.glb",
                    "measures.csv", "smpl.npz", "brought/motion.npz", "walk_of_two/motion.npz", "tracked/motion.npz"):
        assert (place / written).exists(), written


@pytest.mark.parametrize("code", blocks("README.md", "python"))
def test_snippets(place, code):
    exec(compile(code, "README.md", "exec"), {})
    assert (place / "whole.ply").stat().st_size > 10_000


@pytest.mark.parametrize("readme", PACKAGES)
def test_commands_of_packages(results, readme):
    run_commands(readme)


@pytest.mark.parametrize("readme, code", [(readme, code) for readme in PACKAGES for code in blocks(readme, "python")])
def test_snippets_of_packages(results, readme, code):
    exec(compile(code, readme, "exec"), {})


def test_first_screen_and_limits():
    head = README[:1500]
    assert "![" in head and "scape demo" in head
    picture = re.search(r"!\[[^\]]*\]\(([^)]+)\)", head).group(1)
    assert (ROOT / picture).stat().st_size > 20_000
    assert "## What it does not do" in README
    assert len(README.splitlines()) <= 200
