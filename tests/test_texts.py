"""What users read is plain: spelling, short sentences, reading ease, names that exist, links that lead somewhere."""
import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("scanprep", "model", "completion")
PAGES = [ROOT / "README.md", *(ROOT / package / "README.md" for package in PACKAGES),
         ROOT / ".github" / "CONTRIBUTING.md", ROOT / ".github" / "SECURITY.md",
         *sorted((ROOT / ".docs" / "pages").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
# the longest page of each kind, in lines
LONGEST = {"README.md": 150, ".github/CONTRIBUTING.md": 100, **{f"{package}/README.md": 120 for package in PACKAGES}}
WORDS_OF_A_SENTENCE = 25
# Flesch: 60 to 70 is plain English, 30 a scientific paper
READING_EASE = 65
# how codespell would read abbreviations and names of the field
SPELT_RIGHT = "nd,mot,tread,paeth,coo,normaly,abd"


def prose(text):
    """The sentences of a page: without code, tables, headings, formulas, links' addresses and names in backticks."""
    text = re.sub(r"```.*?```|<!--.*?-->|\$\$.*?\$\$", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", text)
    text = text.split("## References")[0]
    lines = ["" if re.match(r"\s*(\||#|    |:::|---|<)", line) else line for line in text.splitlines()]
    # an item of a list begins a new paragraph
    text = "\n".join(re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "\n\n", line) for line in lines)
    text = re.sub(r"`[^`]*`", "NAME", text)
    paragraphs = [re.sub(r"\s+", " ", part).strip(" *_") for part in re.split(r"\n\s*\n", text)]
    return [sentence for part in paragraphs if part for sentence in re.split(r"(?<=[.!?;:])\s+(?=[A-Z*(])", part)]


def words_of(sentence):
    return [word for word in re.findall(r"[A-Za-z][A-Za-z'’-]*", sentence) if word != "NAME"]


def syllables_of(word):
    """Groups of vowels, without a silent e at the end."""
    word = re.sub(r"(?<=[^td])ed$|(?<=[^sxzcgh])es$|(?<=[^l])e$", "", word.lower())
    return max(1, len(re.findall(r"[aeiouy]+", word)))


def reading_ease(sentences):
    """Flesch reading ease of sentences."""
    words = [word for sentence in sentences for word in words_of(sentence)]
    syllables = sum(map(syllables_of, words))
    return 206.835 - 1.015 * len(words) / len(sentences) - 84.6 * syllables / len(words)


@pytest.mark.parametrize("word, count", [("time", 1), ("table", 2), ("registration", 4), ("shape", 1), ("the", 1),
                                         ("moved", 1), ("vertices", 3), ("poses", 2), ("body", 2)])
def test_syllables(word, count):
    assert syllables_of(word) == count


def test_reading_ease_tells_plain_from_learned():
    plain = ["The dog ran to the house.", "It was late."]
    learned = ["Heterogeneous methodological considerations necessitate interdisciplinary investigation."]
    assert reading_ease(plain) > 90 and reading_ease(learned) < 0


@pytest.mark.parametrize("name", NAMES)
def test_sentences_are_short_and_plain(name):
    sentences = prose((ROOT / name).read_text(encoding="utf-8"))
    long = [f"{len(words_of(one))} words: {one}" for one in sentences if len(words_of(one)) > WORDS_OF_A_SENTENCE]
    assert not long, "\n".join(long)
    if len(sentences) > 10:
        assert reading_ease(sentences) >= READING_EASE


@pytest.mark.parametrize("name, lines", LONGEST.items())
def test_pages_are_no_longer_than_agreed(name, lines):
    assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= lines


def test_the_glossary_is_short():
    rows = [line for line in (ROOT / ".docs/pages/glossary.md").read_text(encoding="utf-8").splitlines()
            if line.startswith("| ") and not line.startswith(("| term", "| -", "|-"))]
    assert 20 <= len(rows) <= 60
    terms = [row.split("|")[1].strip(" `").lower() for row in rows]
    assert terms == sorted(terms)


def test_spelling():
    places = [*NAMES, "CHANGELOG.md", *PACKAGES]
    done = subprocess.run([sys.executable, "-m", "codespell_lib", "--ignore-words-list", SPELT_RIGHT, "--skip",
                           "*.json,*.npz,*.js,*.css,*.ts,*.html,*/node_modules", *places],
                          cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@functools.cache
def identifiers():
    """Every name that our code, its tests or its settings use, and every file."""
    found = set()
    for folder in (*PACKAGES, "tests"):
        for path in (ROOT / folder).rglob("*.py*"):
            if path.suffix in (".py", ".pyi"):
                found |= set(re.findall(r"\w+", _without_docs(path.read_text(encoding="utf-8"))))
        found |= {part for path in (ROOT / folder).rglob("*") if "node_modules" not in path.parts
                  for part in re.findall(r"\w+", path.name)}
    return found | {word for path in (ROOT / "pyproject.toml", ROOT / ".ci" / "run")
                    for word in re.findall(r"\w+", path.read_text(encoding="utf-8"))}


def _without_docs(source):
    """Source without its docstrings and comments: what is only told there is no name."""
    lines = source.splitlines()
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) \
                and ast.get_docstring(node, clean=False) is not None:
            for i in range(body[0].lineno - 1, body[0].end_lineno):
                lines[i] = ""
    return "\n".join(re.sub(r"(^|\s)#\s.*", "", line) for line in lines)


def dead_names(text):
    """Names of functions in backticks, with an underscore or brackets, of which nothing in the code has any part."""
    dead = []
    for quoted in re.findall(r"(?<!`)`([A-Za-z_][\w.]*(?:\(\))?)`(?!`)", text):
        parts = re.findall(r"\w+", quoted)
        if re.fullmatch(r"[A-Za-z]_\w+", quoted):                            # a symbol with its index
            continue
        if ("_" in quoted or quoted.endswith("()")) and parts[-1] not in identifiers():
            dead.append(quoted)
    return dead


@pytest.mark.parametrize("name", NAMES)
def test_pages_name_what_exists(name):
    assert not dead_names((ROOT / name).read_text(encoding="utf-8"))


def test_docstrings_and_comments_name_what_exists():
    wrong = [f"{path.relative_to(ROOT)}: {name}" for package in PACKAGES for path in (ROOT / package).rglob("*.py")
             for name in dead_names(path.read_text(encoding="utf-8"))]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_to_files(name):
    page = ROOT / name
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        made = {"commands.md", "python.md", "equations.md"}                   # by .docs/reference.py
        if not target.startswith("http") and Path(target).name not in made:
            assert (page.parent / target).exists(), target
