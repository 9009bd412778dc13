"""The structure of the project holds: imports point down, tags name known papers, libraries do not print."""
import ast
import functools
import graphlib
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
         "fast_simplification", "rich", "sklearn"}
ONE_FILE_EACH = {"pymeshlab", "open3d", "ezc3d"}
SPEAKS = {"cli.py", "command_line.py", "console.py", "interrupts.py", "__main__.py"}

# the rooms of each package from the lowest floor up, and the rooms below that each enters
ROOMS = {
    "scanprep": {
        "geometry": "", "adapters": "geometry", "batch": "geometry", "cleaning": "geometry",
        "correspondence": "geometry", "depth_camera": "geometry", "pictures": "geometry",
        "repair": "geometry", "skeleton": "batch geometry",
        "decimation": "adapters geometry skeleton", "fusion": "geometry repair", "synthetic": "geometry skeleton",
        "alignment": "fusion geometry",
        "registration": "alignment cleaning correspondence geometry skeleton synthetic",
        "surfaces": "adapters alignment cleaning decimation fusion geometry registration repair skeleton",
        "viewer": "alignment batch depth_camera geometry pictures registration skeleton",
        "pipeline": "batch cleaning correspondence geometry pictures registration skeleton synthetic viewer"},
    "model": {
        "fitting": "", "motion": "", "resolution": "",
        "export": "motion", "posing": "export fitting motion", "measurement": "posing",
        "learning": "fitting posing resolution",
        "coregistration": "fitting learning", "statue": "export fitting motion",
        "evaluation": "fitting posing"},
    "completion": {
        "mocap": "", "partial": "mocap", "demo": "mocap partial", "tracking": "mocap partial",
        "viewing": "mocap partial", "measuring": "partial viewing"}}


@functools.cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def name(path):
    return str(path.relative_to(ROOT))


@functools.cache
def imports(path, only_top=False):
    """What a file imports, by full names, with the lines."""
    tree, here, found = parsed(path), path.relative_to(ROOT).parts, []
    for node in (tree.body if only_top else ast.walk(tree)):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = here[:len(here) - node.level] if node.level else ()
            stem = ".".join([*above, *filter(None, [node.module])])
            found += [(f"{stem}.{alias.name}", node.lineno) for alias in node.names]
    return found


def test_imports_point_down():
    wrong = []
    for path in MODULES:
        above = PACKAGES[PACKAGES.index(path.relative_to(ROOT).parts[0]) + 1:]
        wrong += [f"{name(path)}:{line} imports {module}" for module, line in imports(path)
                  if module.split(".")[0] in (*above, "tests")]
    assert not wrong


def test_rooms_enter_rooms_of_lower_floors_only():
    arrows = {}
    for path in MODULES:
        package, room, *inner = path.relative_to(ROOT).parts
        for module, line in imports(path) if inner else ():
            over, other, *_ = [*module.split("."), ""]
            if over == package and other in ROOMS[package] and other != room:
                arrows.setdefault((package, room, other), []).append(f"{name(path)}:{line} imports {module}")
    table = {(package, room, other) for package, rooms in ROOMS.items() for room, below in rooms.items()
             for other in below.split()}
    assert not [places for arrow, places in arrows.items() if arrow not in table]
    assert not table - arrows.keys(), "arrows that nobody needs any more"
    for package, rooms in ROOMS.items():
        assert {path.parent.name for path in (ROOT / package).glob("*/__init__.py")} == set(rooms)
        below = list(rooms)
        assert not [room for room in below if set(rooms[room].split()) - set(below[:below.index(room)])]


def test_no_files_import_each_other_in_a_circle():
    files = {name(path).removesuffix(".py").removesuffix("/__init__").replace("/", "."): path for path in MODULES}
    arrows = {one: {other if other in files else other.rpartition(".")[0] for other, _ in imports(path)} - {one}
              for one, path in files.items() if path.name != "__init__.py"}
    graphlib.TopologicalSorter(arrows).prepare()            # CycleError names the circle


def test_heavy_libraries_load_late():
    wrong = [f"{name(path)}:{line} imports {module} at the top" for path in MODULES if path.name not in SPEAKS
             for module, line in imports(path, only_top=True) if module.split(".")[0] in HEAVY]
    assert not wrong


def test_one_file_a_foreign_library():
    users = {library: {name(path) for path in MODULES for module, _ in imports(path) if module.split(".")[0] == library}
             for library in ONE_FILE_EACH}
    assert all(len(files) <= 1 for files in users.values()), users


def test_libraries_do_not_print_or_exit():
    wrong = [f"{name(path)}:{node.lineno}" for path in MODULES if path.name not in SPEAKS
             for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)
             and ast.unparse(node.func) in ("print", "exit", "quit", "sys.exit", "os._exit")]
    assert not wrong


def test_equation_tags_name_known_papers():
    wrong = []
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        for key, equations in re.findall(r"\[([A-Za-z-]+)\] Eq\. ([\d, and-]+)", text):
            if not all(1 <= int(number) <= WITH_EQUATIONS.get(key, 0) for number in re.findall(r"\d+", equations)):
                wrong.append(f"{name(path)}: [{key}] Eq. {equations}: no equation of a paper that is at hand")
        keys = re.findall(r"^\s*(?:.*\s)?\[([A-Z][A-Za-z-]+)\](?=\s|\.|,|;|\)|$)", text, re.MULTILINE)
        wrong += [f"{name(path)}: [{key}] is not a known paper" for key in keys if key not in PAPERS]
    assert not wrong


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
                       "NOTICE", "CHANGELOG.md", "CITATION.cff"}
    assert not list((ROOT / "tests").rglob("__init__.py"))
    assert not list(ROOT.glob("*/utils.py"))


def test_packages_import_without_heavy_libraries():
    blocked = "open3d,pymeshlab,matplotlib,PIL,trimesh,ezc3d"
    code = (f"import importlib, sys\nfor m in {blocked.split(',')!r}: sys.modules[m] = None\n"
            f"for package in map(importlib.import_module, {PACKAGES}):\n"
            "    for name in package.__all__: getattr(package, name)")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_public_name_loads_from_one_room():
    for package in map(importlib.import_module, PACKAGES):
        assert len(package.__all__) == len(set(package.__all__)), package
        missing = [public for public in package.__all__ if getattr(package, public, None) is None]
        assert not missing, package
