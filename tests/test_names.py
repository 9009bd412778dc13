"""Names and comments of the code: functions are verbs, a public name means one thing, blocks say what they are for."""
import ast
import collections
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("scanprep", "model", "completion")
MODULES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
COMMANDS = ("cli.py", "commands.py", "__main__.py")                          # their functions are named as commands
# one function for each kind of file
REGISTRIES = {"read", "encode"}
# words that end as a participle does, and are none
NO_PARTICIPLES = {"need", "feed", "seed", "embed", "speed", "exceed", "proceed", "succeed", "shed", "spread", "read"}
IRREGULAR = {"told", "kept", "hung", "bent", "made", "found", "given", "taken", "drawn", "seen", "known", "shown",
             "worn", "written", "gone", "lost", "left", "held", "sought", "brought", "meant", "sent", "built", "chosen"}
# functions that do not begin with a verb because a term of the field does
TERMS = {"shared_terms", "displaced", "fitted", "namespaced", "seen", "settled", "timed", "told",
         "tried", "turned_away"}
LONGEST = 60                         # lines of code of a function, without docstring, comments and blank lines
COMMENTS = 80                        # per 1,000 lines of code, of all packages together
FEWEST = 20                          # the same of a single module of more than 100 lines of code


@functools.cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def lines_of(path):
    """Lines of a module, and the kind of each: code, comment, doc, import or blank."""
    lines = path.read_text(encoding="utf-8").splitlines()
    kinds = ["blank" if not line.strip() else "comment" if line.strip().startswith("#") else "code" for line in lines]
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            kinds[node.lineno - 1:node.end_lineno] = ["import"] * (node.end_lineno - node.lineno + 1)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            kinds[node.lineno - 1:node.end_lineno] = ["doc"] * (node.end_lineno - node.lineno + 1)
    return lines, kinds


def comments_of(path):
    """How many lines have a comment, and how many are code."""
    lines, kinds = lines_of(path)
    trailing = sum(kind == "code" and bool(re.search(r"\s#\s", line)) for line, kind in zip(lines, kinds, strict=True))
    return kinds.count("comment") + trailing, kinds.count("code")


@functools.cache
def functions(path):
    return [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.FunctionDef)]


def is_participle(name):
    first = name.strip("_").split("_")[0]
    return first in IRREGULAR or (len(first) > 4 and first.endswith("ed") and first not in NO_PARTICIPLES)


@pytest.mark.parametrize("name, expected", [("placed", True), ("_seen_from", True), ("find_seen", False),
                                            ("seed_places", False), ("spread_points", False), ("red", False)])
def test_participles_are_known(name, expected):
    assert is_participle(name) is expected


def test_functions_are_verbs():
    """Or nouns, where they are properties in all but name; never what has been done to something."""
    wrong = [f"{path.relative_to(ROOT)}:{node.lineno} {node.name}" for path in MODULES for node in functions(path)
             if is_participle(node.name) and node.name not in TERMS
             and not any(ast.unparse(one).split(".")[-1] in ("property", "cached_property")
                         for one in node.decorator_list)]
    assert not wrong, "\n".join(wrong)
    assert {node.name for path in MODULES for node in functions(path)} >= TERMS, "exceptions that nobody needs any more"


def test_a_public_name_means_one_thing():
    places = collections.defaultdict(list)
    for path in MODULES:
        if path.name not in COMMANDS:
            for node in tree_of(path).body:
                if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                    places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not {name: where for name, where in places.items() if len(where) > 1 and name not in REGISTRIES}


def test_functions_are_no_longer_than_agreed():
    wrong = []
    for path in MODULES:
        _, kinds = lines_of(path)
        for node in functions(path):
            length = kinds[node.lineno - 1:node.end_lineno].count("code")
            if length > LONGEST:
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}: {length}")
    assert not wrong, "\n".join(wrong)


def test_code_has_comments():
    counted = [comments_of(path) for path in MODULES]
    comments, code = map(sum, zip(*counted, strict=True))
    assert 1000 * comments / code >= COMMENTS


def test_every_module_has_comments():
    wrong = []
    for path in MODULES:
        comments, code = comments_of(path)
        if code > 100 and 1000 * comments / code < FEWEST:
            wrong.append(f"{path.relative_to(ROOT)}: {comments} comments in {code} lines")
    assert not wrong, "\n".join(wrong)
