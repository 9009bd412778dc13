"""The README and the pages of tasks are walked as they stand, in the folder of `scape sample`, without a landmark.

The other documents are shared out over `test_readme_scans.py`, `test_readme_model.py` and `test_readme_completion.py`,
so that processes share the work; `readme_folder.PARTS` says who runs which.
"""
import csv
import json
import re
import shlex
from pathlib import Path

import numpy as np
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
)
from readme_user import work_in

from completion.__main__ import COMMANDS, main
from completion.demo.sample import (
    HALF_VIEW,
    PEOPLE,
    RATE,
    SCANS,
    Y_UP,
    SampleScan,
    record_markers,
    sample_pose,
    scan_to_file,
)
from completion.mocap.files.markers import write_markers
from model.files import BUILT_IN
from scanprep.command_line import Arguments, list_commands, load_command
from scanprep.geometry.files import name_of, read_mesh
from scanprep.geometry.surface import Surface
from scanprep.synthetic.data_set import stand
from scanprep.synthetic.people import SyntheticPerson, synthesise_walk

pytestmark = pytest.mark.timeout(1800)
VIEWED = "scape pick", "scape view"                  # what they show is not written


def verdict(output):
    report = output / "report.json" if output.is_dir() else output.with_name(f"{output.name}.report.json")
    return json.loads(report.read_text(encoding="utf-8"))["judgement"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """The folder of a sample in which the commands of the README and of the pages of tasks were run."""
    folder = tmp_path_factory.mktemp("readme")
    with work_in(folder):
        for line in commands_of_part("start"):
            run_command(line)
    return folder / "sample"


@pytest.fixture
def there(place):
    """Work in that folder."""
    with work_in(place):
        yield


def test_set_up_is_what_ci_does():
    assert SET_UP <= set(commands(README)) and 'pip install ".[test]" && pytest' in (ROOT / README).read_text()
    ci = (ROOT / ".ci" / "run").read_text()
    assert 'pip install --quiet ".[test]"' in ci and '\npytest -m "slow or not slow"\n' in ci


def arguments_of(line):
    """The name of a command's output and the values that its line gives, checked but not run."""
    words, known = shlex.split(line), list_commands(COMMANDS, "scape")
    path = next(path for k in (3, 2) if (path := " ".join(words[:k])) in known)
    words = words[len(path.split()):]
    arguments = Arguments(load_command(known[path]), path, words)
    return arguments.output_name, arguments.read(words)


def test_every_command_of_the_documents_is_understood():
    """Flags, kinds of values and ranges; what the commands make is looked at when they run, which takes minutes."""
    for part in (*PARTS, REST):
        for line in commands_of_part(part):
            if line.startswith("scape "):
                arguments_of(line)


def test_commands_read_what_the_sample_has_or_a_command_before_them_wrote(sample_folder):
    """Without running them: no file of one's own is needed, and no model but the built-in one or one's own."""
    there = {path.name for path in sample_folder.iterdir()}
    for line in commands_of_part("start"):
        if line.startswith("scape "):
            output_name, values = arguments_of(line)
            output = values.pop(output_name, None)
            paths = [path for value in values.values() for path in (value if isinstance(value, tuple) else (value,))
                     if isinstance(path, Path) and str(path) in line.split() and str(path) != BUILT_IN]
            assert not [path for path in paths if path.parts[0] not in there], line
            there |= {output.parts[0]} if output else set()


def test_no_command_names_a_landmark():
    assert not [line for line in commands_of_part("start") if "landmark" in line]


@pytest.mark.slow
def test_every_result_is_good(place):
    written = [shlex.split(line)[-1] for line in commands_of_part("start")
               if " -o " in line and not line.startswith(VIEWED) and "measure set" not in line]
    judged = {name: verdict(place / name) for name in written}
    assert not {name: one["reasons"] for name, one in judged.items() if one["verdict"] != "good"}


@pytest.mark.slow
@pytest.mark.parametrize("number, one", list(enumerate(SCANS)), ids=lambda value: getattr(value, "file", ""))
def test_every_scan_of_unlike_people_is_registered_rightly(place, number, one):
    """Fat, slim, old, small, tall, women and men: 15 mm on average, as far as a person is called right."""
    truth = stand(SyntheticPerson(PEOPLE[one.person]), sample_pose(one.pose, np.random.default_rng(number))).vertices
    found = read_mesh(place / "set" / "meshes" / f"{name_of(one.file)}.ply")
    distances = Surface(found).closest(truth @ Y_UP.T if one.y_up else truth).distances
    assert distances.mean() < 0.005 and np.quantile(distances, 0.99) < 0.03


@pytest.mark.slow
def test_the_table_of_measures_is_true(place):
    """Of people who stand: stature within three centimetres, as soles and crowns were not seen."""
    with open(place / "set_measures.csv", encoding="utf-8") as table:
        measured = {row["body"]: row for row in csv.DictReader(table)}
    for one in SCANS:
        if one.pose == "standing":
            stature = SyntheticPerson(PEOPLE[one.person]).anatomy.stature
            assert abs(float(measured[name_of(one.file)]["stature"]) - stature) < 0.03, one.file


@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
def test_half_view_and_walk_of_unlike_people(name, tmp_path):
    """The first commands of the animator and of the biomechanist, with every person of the sample."""
    person = SyntheticPerson(PEOPLE[name])
    scan_to_file(tmp_path, SampleScan("half_view.ply", name, HALF_VIEW.pose, HALF_VIEW.scanner), person, 0)
    truth = stand(person, sample_pose(HALF_VIEW.pose, np.random.default_rng(0))).vertices
    poses, trans = synthesise_walk(48, RATE)
    bodies = np.stack([person.in_pose(pose, at) for pose, at in zip(poses, trans, strict=True)])
    walk = record_markers(bodies, person.mesh.faces, RATE, np.random.default_rng(1), lambda done, total: None)
    write_markers(tmp_path / "walk.c3d", walk)
    with work_in(tmp_path):
        for line in ("scape complete half_view.ply -o completed", "scape mosh walk.c3d -o out"):
            assert line in commands_of_part("start")
            assert main(shlex.split(line)[1:]) == 0
    distances = Surface(read_mesh(tmp_path / "completed" / "completed.ply")).closest(truth).distances
    assert distances.mean() < 0.015
    height = {m["metric"]: m["value"] for m in json.loads((tmp_path / "out" / "report.json").read_text())["metrics"]}
    assert abs(height["height"] / person.anatomy.stature - 1) < 0.02
    assert verdict(tmp_path / "completed")["verdict"] == verdict(tmp_path / "out")["verdict"] == "good"


@pytest.mark.slow
@pytest.mark.parametrize("document, code", snippets_of_part("start"))
def test_snippets(there, place, document, code):
    run_snippet(document, code)
    if document == README:
        assert (place / "whole" / "completed.ply").stat().st_size > 10_000


def test_every_document_is_run_by_one_file():
    found = [document for part in (*PARTS, REST) for document in documents(part)]
    assert len(found) == len(set(found))
    written = {README, *(f"{package}/README.md" for package in ("scanprep", "model", "completion")),
               *(path.relative_to(ROOT).as_posix() for path in (ROOT / ".docs" / "pages").rglob("*.md"))}
    assert set(found) == written


def test_first_screen_and_limits():
    text = (ROOT / README).read_text(encoding="utf-8")
    head = text[:1500]
    assert "![" in head and "scape sample" in head and "scape demo" in head
    picture = re.search(r"!\[[^\]]*\]\(([^)]+)\)", head).group(1)
    assert 20_000 < (ROOT / picture).stat().st_size < 300_000
    assert "## What it does not do" in text


def test_every_picture_is_shown_somewhere_and_small():
    shown = {Path(name).name for document in (*(ROOT / ".docs" / "pages").rglob("*.md"), ROOT / README)
             for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", document.read_text(encoding="utf-8"))}
    pictures = list((ROOT / ".docs" / "pages" / "pictures").iterdir())
    assert {path.name for path in pictures} == shown
    assert max(path.stat().st_size for path in pictures) < 300_000


@pytest.mark.parametrize("document, lines", [(README, 150), *((f"{package}/README.md", 120) for package in
                                                             ("scanprep", "model", "completion"))])
def test_readmes_are_short(document, lines):
    assert len((ROOT / document).read_text(encoding="utf-8").splitlines()) <= lines
