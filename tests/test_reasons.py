"""A reason, an error or a note names the flag that mends it, and the command that says it has that flag."""
import ast
import re
import typing
from functools import cache
from pathlib import Path

import pytest

from completion.__main__ import COMMANDS
from scanprep.command_line import Arguments, list_commands, load_command

ROOT = Path(__file__).parents[1]
PACKAGES = "scanprep", "model", "completion"
FLAG = re.compile(r"(?<![\w-])(--[a-z][a-z-]+)(?:[ =]([a-z]+))?")
OTHER = re.compile(r"scape(?: [a-z][a-z-]*)+(?=[^,;:()]*$)")      # another command, to which the flag behind it belongs
ON_SCANS = "complete, track, measure, statue fit, prep register, prep run, prep landmarks"
ON_MARKERS = "mosh, animate"

# who says what a function outside the modules of commands says; functions there are said by the commands beside them
SAID_BY = {
    "completion/cli.py marks_of_template": "complete, track",
    "completion/measuring/template.py tape_template": "measure",
    "completion/mocap/animate/work.py betas_in_motion": "animate",
    "completion/mocap/labelling/work.py LabelWork.write": "label",
    "completion/mocap/marker_sets/named.py ": "mosh, animate, label",
    "completion/mocap/marker_sets/named.py fitting_layout": "mosh, animate",
    "completion/mocap/mosh/call.py MoshCall.models": "mosh",
    "completion/mocap/mosh/recordings.py subjects_table": "mosh",
    "completion/mocap/mosh/recordings.py find_actors": "mosh",
    "completion/partial/completion.py completion_problem": "complete",
    "completion/partial/completion.py tell_worn": "complete",
    "completion/partial/folder.py FolderCall.tasks": "complete",
    "completion/partial/folder.py FolderCall.description": "complete",
    "completion/partial/inputs.py check_landmarks": "complete",
    "completion/partial/mend.py CompletionsApp._save": "complete",
    "completion/partial/report.py completion_page": "complete",
    "completion/partial/work.py complete_files": "complete",
    "completion/partial/work.py read_masks": "complete",
    "completion/tracking/sequence.py tracking_problem": "track",
    "model/learning/scape.py judge_model": "learn",
    "model/coregistration/lead.py model_lead": "prep register, prep run",
    "model/statue/verdict.py judge_statue": "statue fit",
    "model/statue/own_mesh.py read_as_gltf": "statue fit",
    "model/statue/own_mesh.py read_pieces": "statue fit",
    "scanprep/alignment/views.py views_problem": "prep views",
    "scanprep/plausible.py ": f"{ON_SCANS}, {ON_MARKERS}",
    "scanprep/plausible.py unit_problem":
        f"{ON_SCANS}, {ON_MARKERS}, learn, prep correspond, prep align, model evaluate, model coregister",
    "scanprep/pipeline/landmarks.py template_and_landmarks": "prep landmarks",
    "scanprep/pipeline/mend.py MendApp.__init__": "prep run",
    "scanprep/registration/lead.py lead_of": "prep register, prep run",
    "scanprep/registration/lead.py _load_entry_point": "prep register, prep run",
    "scanprep/registration/nonrigid.py registration_problem": "prep register, prep run, prep landmarks",
    "scanprep/skeleton/names.py skeleton_doubts": "prep skeleton, prep run",
    "scanprep/surfaces/template.py MadeTemplate.doubts": "prep template",
    "scanprep/viewer/landmark_names.py read_names": "pick"}
# what no user's command says: the machinery of command lines itself
MACHINERY = {"scanprep/arguments.py", "scanprep/command_line.py", "completion/__main__.py"}


@cache
def targets():
    return {name.removeprefix("scape "): target for name, target in list_commands(COMMANDS, "scape").items()}


@cache
def flags_of(command):
    """The flags of a command, each with the words that it takes, where these are known."""
    arguments = Arguments(load_command(targets()[command]), f"scape {command}", [])
    return {each.flag: set(words_of(each.annotation)) for each in arguments.listed}


def words_of(annotation):
    if typing.get_origin(annotation) is typing.Literal:
        yield from typing.get_args(annotation)
    elif typing.get_origin(annotation) is not None:
        for part in typing.get_args(annotation):
            yield from words_of(part)


def text_of(node):
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    return "".join(text_of(part) or "{}" for part in node.values) if isinstance(node, ast.JoinedStr) else ""


def sayings(path):
    """Yield name of the function and text of every string that names a flag; docstrings are help, which others test."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docs = {id(node.body[0].value) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef |
            ast.Module) and node.body and isinstance(node.body[0], ast.Expr)}

    def walk(node, name):
        for child in ast.iter_child_nodes(node):
            inner = f"{name}.{child.name}".lstrip(".") if isinstance(child, ast.FunctionDef | ast.ClassDef) else name
            text = "" if id(child) in docs else text_of(child)
            if FLAG.search(text) and not FLAG.fullmatch(text):          # not where a flag is merely spelt
                yield inner, text
            if not isinstance(child, ast.JoinedStr):
                yield from walk(child, inner)

    yield from walk(tree, "")


def who_says(place, function):
    """The commands that say what a function says."""
    if f"{place} {function}" in SAID_BY:
        return SAID_BY[f"{place} {function}"].split(", ")
    module = place.removesuffix(".py").replace("/", ".")
    beside = [command for command, target in targets().items() if target.split(":")[0] == module]
    own = [command for command in beside if targets()[command] == f"{module}:{function}"]
    return own or beside


ALL = [(str(path.relative_to(ROOT)), function, text) for package in PACKAGES
       for path in sorted((ROOT / package).rglob("*.py")) for function, text in sayings(path)
       if str(path.relative_to(ROOT)) not in MACHINERY]


@pytest.mark.parametrize("place, function, text", ALL, ids=[f"{place}:{function}" for place, function, _ in ALL])
def test_the_command_that_names_a_flag_has_it(place, function, text):
    for match in FLAG.finditer(text):
        flag, word = match.groups()
        other = OTHER.search(text[:match.start()])
        named = [] if other is None else [name for name in targets() if f"{other[0]} ".startswith(f"scape {name} ")]
        speakers = named or who_says(place, function)
        # a helper among several commands speaks for one of them at least
        every = bool(named) or f"{place} {function}" in SAID_BY
        having = [command for command in speakers if flag in flags_of(command)]
        assert having if not every else having == speakers, (flag, sorted(set(speakers) - set(having)), text)
        for command in having:
            words = flags_of(command)[flag]
            assert not words or word is None or word in words or not match[0].endswith(word), (command, match[0], words)


def test_no_entry_of_the_table_is_idle():
    assert set(SAID_BY) <= {f"{place} {function}" for place, function, _ in ALL}


@pytest.mark.parametrize("command", ["complete", "track", "measure", "mosh", "animate", "statue fit", "prep register",
                                     "prep run", "prep landmarks", "prep correspond", "prep clean", "prep template"])
def test_what_reads_a_person_takes_a_unit_that_nobody_knows(command):
    assert "unknown" in flags_of(command)["--unit"]


@pytest.mark.parametrize("command", ["complete", "prep register", "prep run", "prep landmarks", "prep clean"])
def test_what_looks_for_a_person_takes_the_axis_that_is_up(command):
    assert flags_of(command)["--up"] == {"x", "-x", "y", "-y", "z", "-z"}


def next_steps():
    """Yield place and expression of what commands print as `next:`."""
    for path in sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call):
                steps = [word.value for word in call.keywords if word.arg == "following"]
                if getattr(call.func, "id", "") == "do_one":
                    steps += call.args[-1:]
                yield from ((path.relative_to(ROOT), step) for step in steps if not isinstance(step, ast.Name))


STEPS = list(next_steps())


@pytest.mark.parametrize("place, step", STEPS, ids=[f"{place}:{step.lineno}" for place, step in STEPS])
def test_the_next_step_can_be_pasted_into_a_shell(place, step):
    """Paths with blanks are quoted, and no placeholder such as MODEL.npz is named, which nobody has."""
    assert len(STEPS) >= 10
    for part in (part for part in ast.walk(step) if isinstance(part, ast.FormattedValue)):
        parts = [part.value.body, part.value.orelse] if isinstance(part.value, ast.IfExp) else [part.value]
        for value in parts:
            assert isinstance(value, ast.JoinedStr | ast.Constant) or getattr(value.func, "id", "") == "quote", place
    assert not re.search(r"\b[A-Z]{3,}\b", re.sub("BVH", "", text_of(step)))
