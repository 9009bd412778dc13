"""Every command and snippet in the READMEs of the packages runs, after those of the README."""
import pytest
from readme_folder import blocks, run_commands, user_folder, with_results

READMES = [f"{package}/README.md" for package in ("scanprep", "model", "completion")]
pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def place(demo_folder, tmp_path_factory):
    return with_results(user_folder(demo_folder, tmp_path_factory.mktemp("packages")))


@pytest.mark.parametrize("readme", READMES)
def test_commands(place, monkeypatch, readme):
    monkeypatch.chdir(place)
    monkeypatch.setenv("SCAPEKIT_CACHE", str(place / "cache"))
    run_commands(readme)


@pytest.mark.parametrize("readme, code", [(readme, code) for readme in READMES for code in blocks(readme, "python")])
def test_snippets(place, monkeypatch, readme, code):
    monkeypatch.chdir(place)
    exec(compile(code, readme, "exec"), {})
