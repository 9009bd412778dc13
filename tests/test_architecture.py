"""The structure of the project holds: imports point down, tags name known papers, libraries do not print."""
import ast
import functools
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("scanprep", "model", "completion")          # each may import itself and those before it
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
REFERENCES = (ROOT / "README.md").read_text(encoding="utf-8").split("## References")[1]
PAPERS = set(re.findall(r"\[([A-Za-z-]+)\]", REFERENCES))
WITH_EQUATIONS = {"SCAPE": 11, "Statues": 23, "MoSh": 27}  # the papers at hand, and their last equation
HEAVY = {"open3d", "pymeshlab", "matplotlib", "PIL", "trimesh", "ezc3d", "igl", "cholespy", "embreex", "pygltflib",
         "fast_simplification", "rich", "skimage", "sklearn"}
ONE_FILE_EACH = {"pymeshlab", "open3d", "ezc3d"}
SPEAKS = {"cli.py", "command_line.py", "console.py", "interrupts.py", "__main__.py"}


@functools.cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def name(path):
    return str(path.relative_to(ROOT))


def imports(tree, only_top=False):
    for node in (tree.body if only_top else ast.walk(tree)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name.split(".")[0], node.lineno
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            yield node.module.split(".")[0], node.lineno


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_imports_point_down(path):
    package = path.relative_to(ROOT).parts[0]
    above = PACKAGES[PACKAGES.index(package) + 1:]
    wrong = [f"{name(path)}:{line} imports {module}" for module, line in imports(parsed(path))
             if module in above or module == "tests"]
    assert not wrong


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_heavy_libraries_load_late(path):
    wrong = [f"{name(path)}:{line} imports {module} at the top"
             for module, line in imports(parsed(path), only_top=True) if module in HEAVY]
    assert not wrong or path.name in SPEAKS


@pytest.mark.parametrize("library", sorted(ONE_FILE_EACH))
def test_one_file_a_foreign_library(library):
    users = [name(p) for p in MODULES if library in {m for m, _ in imports(parsed(p))}]
    assert len(users) <= 1, users


@pytest.mark.parametrize("path", [p for p in MODULES if p.name not in SPEAKS], ids=name)
def test_libraries_do_not_print_or_exit(path):
    calls = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
    wrong = [f"{name(path)}:{node.lineno}" for node in calls
             if ast.unparse(node.func) in ("print", "exit", "quit", "sys.exit", "os._exit")]
    assert not wrong


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_equation_tags_name_known_papers(path):
    text = path.read_text()
    for key, equations in re.findall(r"\[([A-Za-z-]+)\](?: Eq\. ([\d, and-]+))?", text):
        if equations:
            assert key in WITH_EQUATIONS, f"[{key}] Eq. {equations}: an equation of a paper that is not at hand"
            for number in re.findall(r"\d+", equations):
                assert 1 <= int(number) <= WITH_EQUATIONS[key], f"[{key}] has no Eq. {number}"
    for key in re.findall(r"^\s*(?:.*\s)?\[([A-Z][A-Za-z-]+)\](?=\s|\.|,|;|\)|$)", text, re.MULTILINE):
        assert key in PAPERS, f"{name(path)}: [{key}] is not a known paper"


def test_the_papers_of_the_project_are_listed():
    assert {"SCAPE", "SCAPE-patent", "Statues", "MoSh", "CC", "Articulated", "Hahnel", "Allen", "Amberg", "Sumner",
            "Davis", "Liepa", "VRIP", "QEM", "BlendSCAPE"} <= PAPERS


def test_top_level_is_as_agreed():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {line.split("/")[0] for line in listed.stdout.splitlines()}
    visible = {entry for entry in top if not entry.startswith(".")}
    assert visible == {"pyproject.toml", "README.md", "scanprep", "model", "completion", "tests", "LICENSE",
                       "CHANGELOG.md"}
    assert not list((ROOT / "tests").rglob("__init__.py"))
    assert not list(ROOT.glob("*/utils.py"))


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_without_heavy_libraries(package):
    blocked = "open3d,pymeshlab,matplotlib,PIL,trimesh,ezc3d"
    code = (f"import sys\nfor m in {blocked.split(',')!r}: sys.modules[m] = None\n"
            f"import {package}\nfor name in {package}.__all__: getattr({package}, name)")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_loads_from_one_room(package):
    module = importlib.import_module(package)
    assert sorted(module.__all__) == sorted(set(module.__all__))
    for public in module.__all__:
        assert getattr(module, public) is not None
