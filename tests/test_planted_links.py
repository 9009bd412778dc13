"""Folders of strangers hold links: nothing outside of the folder that the user named is written, whatever is planted.

That no file is opened for writing which scapekit has not made itself, every test checks (`exclusive_writes`).
"""
import os
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exclusive_writes import OURS
from test_bad_input import ANIMATE, COMPLETE, LEARN, MOSH, PREP, place  # noqa: F401 -- a fixture
from test_scanprep_pipeline_mend import ENDING, made, sent  # noqa: F401 -- a fixture
from test_scanprep_pipeline_mend import place as mended  # noqa: F401 -- a fixture

from completion.__main__ import main
from completion.viewing.saving import free_name
from scanprep import RegisteredSet
from scanprep.geometry import storage
from scanprep.pipeline.again import Call
from scanprep.pipeline.mend import MendApp
from scanprep.pipeline.scans import find_scans
from scanprep.viewer.clicked import Clicked

COMMANDS = ("prep fill template.ply -o out.ply", "prep decimate template.ply -o out.ply --faces 100",
            "model mesh model.npz -o out.ply", "model export model.npz -o out.glb", ANIMATE,
            *(pytest.param(one, marks=pytest.mark.slow) for one in (LEARN, PREP, COMPLETE, MOSH)))


def files_of(folder):
    """Every file, folder and link below a folder, with contents and where links lead."""
    return {path.relative_to(folder): os.readlink(path) if path.is_symlink() else
            path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.fixture
def user(tmp_path):
    """Beside the folder of a stranger: what the user has, which has to stay as it is."""
    home = tmp_path.with_name(f"{tmp_path.name}_user")
    (home / "folder").mkdir(parents=True)
    (home / "profile").write_text("mine")
    before = files_of(home)
    yield home
    assert files_of(home) == before


def plant(folder, names, target):
    """Put a link to `target` at names of a folder, where nothing is."""
    for name in names:
        path = folder / name
        if not os.path.lexists(path) and path.parent.is_dir():
            path.symlink_to(target)


@pytest.mark.parametrize("command", COMMANDS)
def test_links_at_every_name_that_a_command_writes(place, user, listener, monkeypatch, command):  # noqa: F811
    """The command runs once, and its output goes; then links stand at all those names, each to a file, or to none."""
    opened = set()
    monkeypatch.setattr(listener, "opened", opened.add, raising=False)
    assert main(command.split()) in (0, 1)
    found = [path for path in place.rglob("*") if any("out" in part for part in path.relative_to(place).parts)]
    names = {path.relative_to(place) for path in [*map(Path, opened), *found] if path.is_relative_to(place)}
    assert any(path.name.startswith("out") for path in found)
    for path in place.glob("*out*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    # each depth by itself: a link above hides the names below it, which need their folders
    for depth in (1, 2, 3):
        for target in ("new", "profile", "folder"):
            folder = shutil.copytree(place, place.with_name(f"{place.name}_{depth}_{target}"), symlinks=True)
            monkeypatch.chdir(folder)
            for name in names:
                if len(name.parts) > depth:
                    folder.joinpath(*name.parts[:depth]).mkdir(parents=True, exist_ok=True)
            plant(folder, [name for name in names if len(name.parts) == depth], user / target)
            main(command.split())
            main([*command.split(), *(["--force"] if command.startswith("mosh") else [])])


def test_a_copy_of_landmarks_is_kept_through_no_link(tmp_path, user):
    """One click on an unpacked scan has made a file of the user's, with text of the sender's."""
    (tmp_path / "anna.landmarks.csv").write_text("0 0 0 $(touch gotcha)\n")
    (tmp_path / "anna.landmarks.csv.before").symlink_to(user / ".bash_aliases")
    one = Clicked(tmp_path / "anna.ply", tmp_path / "anna.landmarks.csv", "m")
    one.places = {"head": np.zeros(3)}
    with pytest.raises(storage.StorageError, match=r"anna\.landmarks\.csv\.before: .*found a link"):
        one.save()
    assert (tmp_path / "anna.landmarks.csv").read_text().endswith("gotcha)\n")
    (tmp_path / "anna.landmarks.csv.before").unlink()
    one.save()
    assert "gotcha" in (tmp_path / "anna.landmarks.csv.before").read_text()


def test_the_names_of_unfinished_files_cannot_be_guessed(tmp_path, user):
    """An archive had links at the names of all process numbers."""
    (tmp_path / f".body.{os.getpid()}.part.json").symlink_to(user / "profile")
    (tmp_path / "body.json").symlink_to(user / "profile")
    names = set()
    for _ in range(2):
        with storage.writing(tmp_path / "body.json") as unfinished:
            names.add(unfinished.name)
            unfinished.write_text("{}")
    assert len(names) == 2 and not (tmp_path / "body.json").is_symlink()
    with pytest.raises(FileExistsError):
        storage.create_file(tmp_path / f".body.{os.getpid()}.part.json")


@pytest.mark.parametrize("target", ["profile", "new"])
def test_names_that_count_as_free(tmp_path, user, target):
    (tmp_path / "a_body.ply").symlink_to(user / target)
    assert free_name(tmp_path / "a_body.ply").name == "a_body_2.ply"


def test_landmarks_are_clicked_into_no_other_folder(tmp_path, user):
    (tmp_path / "anna.ply").write_text("")
    (tmp_path / "landmarks").symlink_to(user / "folder")
    with pytest.raises(storage.StorageError, match="landmarks is a link that leads out"):
        find_scans(tmp_path)
    assert find_scans(tmp_path, tmp_path / "landmarks")[0].landmarks is None             # it was named


def test_a_set_takes_no_mesh_through_a_link(mended, user):  # noqa: F811
    registered = RegisteredSet.load(mended / "set")
    shutil.rmtree(mended / "set" / "meshes")
    (mended / "set" / "meshes").symlink_to(mended / "scans")
    with pytest.raises(ValueError, match="link"):
        registered.add("body9", registered.template)
    assert not (mended / "scans" / "body9.ply").exists()


def test_a_foreign_set_asks_before_it_changes_a_file_outside(mended):  # noqa: F811
    """Its record says where scans, landmarks and template are, and a click is saved there."""
    before = files_of(mended / "scans")
    app = MendApp(mended / "set", ENDING)
    name = next(iter(app.template.places))
    for kind, fields in (("remove", {"pane": 1, "name": name}), ("open", {"scan": 1})):
        if kind == "remove":
            with pytest.raises(ValueError, match=rf"run\.json names {mended / 'scans'}, .*do it once more"):
                sent(app, kind, **fields)
        else:
            sent(app, kind, **fields)
        assert files_of(mended / "scans") == before
    sent(app, "remove", pane=1, name=name)
    assert files_of(mended / "scans") != before


def test_what_lies_inside_is_not_asked_for(mended):  # noqa: F811
    call = Call.read(mended / "set")
    inside = replace(call, scans=mended / "set" / "scans", template=mended / "set" / "template.ply")
    assert call.ask_outside(mended / "set") and not inside.ask_outside(mended / "set")


def test_half_a_copy_is_none(tmp_path):
    """The disk is full: the landmarks stay as they are, and later there is a whole copy."""
    (tmp_path / "a.txt").write_text("0 0 0 head\n")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            storage.keep_former(tmp_path / "a.txt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    storage.keep_former(tmp_path / "a.txt")
    assert (tmp_path / "a.txt.before").read_text() == "0 0 0 head\n"


def test_what_is_opened_without_having_been_made_is_noticed(tmp_path, listener):
    """Or the check of every test would prove nothing: a file that was there, written by a line of our code."""
    (tmp_path / "theirs").write_text("")
    for name, wrong in (("theirs", 1), ("new", 2)):
        exec(compile(f"open({str(tmp_path / name)!r}, 'w').close()", f"{OURS[0]}line.py", "exec"))
        assert len(listener.wrong) == wrong and name in listener.wrong[-1]
    listener.wrong.clear()
    storage.write_file(tmp_path / "theirs", "ours")
    assert not listener.wrong
