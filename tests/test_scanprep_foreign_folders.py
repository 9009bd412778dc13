"""Folders that come from somebody else: what they name outside of themselves is neither read, moved nor removed."""
import csv
import dataclasses
import os
import re
import warnings
import zipfile

import numpy as np
import pytest
from PIL import Image

from completion import MarkerLayout, read_markers
from completion.partial.masks import read_mask
from model import load_model
from model.importing import read_published
from model.motion.files import read_motion_file
from model.statue.detail.maps import read_edited
from scanprep import Mesh, RegisteredSet, Skeleton, config_files, read_landmarks, read_mesh
from scanprep.batch.cluster import _outcome
from scanprep.batch.digests import Digests
from scanprep.batch.opening import beside, workspace
from scanprep.batch.ownership import HOME
from scanprep.batch.room import Job
from scanprep.batch.values import load_value, save_value
from scanprep.batch.workspace import RECORD, Task
from scanprep.console import Metric, bar, say, show
from scanprep.depth_camera.picture import read_camera, read_distances
from scanprep.geometry import storage
from scanprep.geometry.storage import StorageError, path_inside
from scanprep.geometry.tables import number_table, read_table, write_table
from scanprep.pictures.sheets import small_picture
from scanprep.pipeline.scans import find_scans
from scanprep.viewer.landmark_names import read_names


@dataclasses.dataclass(frozen=True)
class Copy:
    """Work that writes one file."""

    def __call__(self, given, room):
        (room.folder / "copy.txt").write_text(given.read_text())
        return 4


NAMES = ("../profile", "a/../../profile", "/etc/hostname", "..\\profile", "C:\\profile", "C:profile", "\\profile", "",
         "a\0b", "link/profile", 7, None)

CORNER = Mesh(np.vstack([np.eye(3), np.zeros(3)]), [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


@pytest.fixture
def home(tmp_path):
    """A folder of results with a link out of it, and beside it a file of the user's that must stay as it is."""
    (tmp_path / "profile").write_text("mine")
    (tmp_path / "out" / HOME / "done").mkdir(parents=True)
    (tmp_path / "out" / "link").symlink_to(tmp_path, target_is_directory=True)
    yield tmp_path
    assert (tmp_path / "profile").read_text() == "mine"


@pytest.mark.parametrize("name", NAMES)
def test_a_name_leads_out_of_the_folder(home, name):
    with pytest.raises(StorageError, match=r"report\.json.*(inside|expected)"):
        path_inside(home / "out", name, "report.json")


@pytest.mark.parametrize("name", ["a.ply", "meshes/a b.ply", "meshes/2024.05.01 ä.ply", "a..b"])
def test_a_name_inside(tmp_path, name):
    assert path_inside(tmp_path, name, "report.json") == tmp_path / name


def hostile(home, name):
    """What the record of a result says that names another's file, with its true digest: it could be removed."""
    return {"digest": "of before", "work": "", "files": {name: Digests().of_file(home / "profile")}}


def run_again(home):
    (home / "in.txt").write_text("text")
    with workspace(home / "out") as space:
        return space.run(Copy(), [Task("in", home / "in.txt", "place")])


TEXTS = [name for name in NAMES if isinstance(name, str) and "\0" not in name]


@pytest.mark.parametrize("name", TEXTS)
def test_a_record_names_the_file_of_somebody_else(home, name):
    """The next run would remove it: what a result had written and has no more goes."""
    save_value(home / "out" / HOME / "done" / "in.npz", None, hostile(home, name))
    with pytest.raises(StorageError, match=r"in\.npz"):
        run_again(home)
    assert not (home / "out" / HOME / "lock").exists()
    assert sorted(p.name for p in home.iterdir()) == ["in.txt", "out", "profile"]


@pytest.mark.parametrize("name", TEXTS)
def test_a_result_on_its_way_names_the_file_of_somebody_else(home, name):
    """The next run would put a file there: what a killed run had made whole comes to its place."""
    ready = home / "out" / HOME / "ready" / "in"
    ready.mkdir(parents=True)
    (home / "out" / HOME / "ready" / "profile").write_text("theirs")
    save_value(ready / RECORD, None, hostile(home, name))
    with pytest.raises(StorageError, match=r"record\.npz"):
        run_again(home)


@pytest.mark.parametrize("name", TEXTS)
def test_a_report_names_the_file_of_somebody_else(home, name):
    (home / "out" / "body.ply").write_text("ours")
    storage.write_json(home / "out" / "body.ply.report.json", {"written": hostile(home, name)["files"]})
    with pytest.raises(StorageError, match=r"report\.json"), beside(home / "out" / "body.ply") as space, \
            space.staging("output") as staged:
        (staged.folder / "body.ply").write_text("new")


def test_a_new_result_follows_no_link_out_of_the_output(home):
    """Before it is written: else every later run would find it on its way and stop."""
    (home / "elsewhere").mkdir()
    (home / "out" / "place").symlink_to(home / "elsewhere", target_is_directory=True)
    (home / "in.txt").write_text("text")
    with workspace(home / "out") as space:
        with pytest.raises(StorageError, match="link"), space.staging("in") as staged:
            (staged.folder / "place").mkdir()
            (staged.folder / "place" / "copy.txt").write_text("text")
        assert not list(space.home.glob("ready/*"))
    assert not list((home / "elsewhere").iterdir())


READERS = (load_model, read_published, read_camera, read_distances, read_landmarks, read_markers, Skeleton.load,
           MarkerLayout.load, read_motion_file, lambda path: read_mask(path, np.zeros((2, 3))),
           lambda path: config_files.read_settings(path, {}), small_picture, lambda path: read_names(str(path)),
           lambda path: read_edited(path, (4, 4)), read_mesh, storage.load_arrays)


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_plain_file_is_refused_before_it_is_read(tmp_path, reader):
    """A pipe that nobody writes to would be waited for without end, and a device read without one."""
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "device.npz").symlink_to("/dev/zero")
    for path in (tmp_path, tmp_path / "pipe.npz", tmp_path / "device.npz"):
        with pytest.raises(ValueError, match=re.escape(str(path))):
            reader(path)


def test_what_unpacks_to_more_than_the_memory_is_refused_by_its_name(tmp_path):
    """A small file of nothing but zeros."""
    with zipfile.ZipFile(tmp_path / "model.npz", "w", zipfile.ZIP_DEFLATED) as archive, \
            archive.open("v_template.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (2**25, 1)})
        for _ in range(256):
            member.write(bytes(2**20))
    with pytest.raises(StorageError, match=r"model\.npz.*would unpack to"):
        read_published(tmp_path / "model.npz")


PICTURES = {"depth": read_distances, "map": lambda path: read_edited(path, (4, 4)), "page": small_picture}


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("pixels", [10_000, 14_000])
def test_pictures_of_too_many_pixels_are_refused_by_name_without_a_warning(tmp_path, name, pixels):
    """Pillow warns of the smaller one, and refuses the larger one with an error of its own."""
    path = tmp_path / f"{name}.png"
    Image.new("1", (pixels, pixels)).save(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(StorageError, match=rf"{name}\.png.*pixels"):
            PICTURES[name](path)


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_that_is_cut_short_is_refused_by_name(tmp_path, name):
    path = tmp_path / f"{name}.png"
    grey = np.random.default_rng(0).integers(0, 2**16, (64, 64)).astype(np.uint16)
    Image.fromarray(grey).save(path)
    whole = path.read_bytes()
    for length in (0, 8, 20, 40, len(whole) // 2):
        path.write_bytes(whole[:length])
        with pytest.raises(StorageError, match=rf"{name}\.png"):
            PICTURES[name](path)


@pytest.mark.parametrize("name", ["scanprep.geometry.mesh:Mesh", "scanprep.geometry.mesh:csr_array",
                                  "scanprep.pictures.scene:_Columns", "os:stat_result", "scanprep.cli:Path"])
def test_a_record_names_another_class_than_is_kept(tmp_path, name):
    """Only a frozen dataclass of ours with just its own values is made again."""
    storage.save(tmp_path / "in.npz", "result", 1, {}, {"value": {"class": name, "fields": {"more": 1}}})
    with pytest.raises(StorageError, match=r"in\.npz.*(not a dataclass that is kept|not of this project|the values)"):
        load_value(tmp_path / "in.npz")


def test_a_record_without_what_it_needs_counts_as_none(home):
    save_value(home / "out" / HOME / "done" / "in.npz", None, {"files": {"../profile": "x"}})
    assert run_again(home).fresh == ("in",)


@pytest.mark.parametrize("place", [HOME, f"{HOME}/making", f"{HOME}/ready", f"{HOME}/ready/in", f"{HOME}/done",
                                   f"{HOME}/ready/in/place", f"{HOME}/steps/in"])
def test_a_link_where_scapekit_keeps_what_it_knows(home, place):
    """Removing what a killed run left would remove it elsewhere."""
    (home / "elsewhere" / "making").mkdir(parents=True)
    (home / "elsewhere" / "making" / "mine").write_text("mine")
    for path in (home / "out" / HOME / "done", home / "out" / HOME):
        path.rmdir()
    (home / "out" / place).parent.mkdir(parents=True, exist_ok=True)
    (home / "out" / place).symlink_to(home / "elsewhere", target_is_directory=True)
    with pytest.raises(ValueError, match="link"):
        run_again(home)
    assert (home / "elsewhere" / "making" / "mine").exists()


@pytest.mark.parametrize("column", ["name", "file"])
@pytest.mark.parametrize("name", TEXTS)
def test_a_set_names_a_mesh_of_somebody_else(home, column, name):
    folder = home / "set"
    RegisteredSet.create(folder, CORNER).add("anna", CORNER)
    os.symlink(home, folder / "link")
    text = (folder / "set.csv").read_text()
    before = {"name": "anna,", "file": ",meshes/anna.ply"}[column]
    assert before in text
    (folder / "set.csv").write_text(text.replace(before, before.replace("anna" if column == "name" else
                                                                      "meshes/anna.ply", name)))
    with pytest.raises(StorageError, match=r"set\.csv: line 2"):
        RegisteredSet.load(folder)


def test_a_worker_answers_with_the_name_of_a_file_of_somebody_else(home):
    class Future:
        exception = staticmethod(lambda: None)
        result = staticmethod(lambda: (None, {"../profile": b"theirs"}, []))

    with pytest.raises(StorageError, match="tcp://there"):
        _outcome(Future, Job("in", None, home / "out"), "tcp://there")


STRANGE = ("=1+1", "-anna", "+49 a", "@sum", "'=1", "''-x", "[red]anna[/red]", "<b>anna</b>", "anna;b", 'an"na',
           "\t=1", "\r+2", "\tanna", " =3")


def test_a_table_gives_back_names_that_spreadsheets_would_run(tmp_path):
    write_table(tmp_path / "a.csv", ["name", "value"], [(name, -0.5) for name in STRANGE])
    assert [row["name"] for _, row in read_table(tmp_path / "a.csv", ["name", "value"])] == list(STRANGE)
    with open(tmp_path / "a.csv", newline="") as file:
        cells = [row[0] for row in csv.reader(file)][1:]
    assert not [cell for cell in cells if cell.lstrip(" ")[0] in "=+-@\t\r"]
    write_table(tmp_path / "b.csv", ["=name", "value"], [])
    assert (tmp_path / "b.csv").read_text() == "'=name,value\n"
    assert all(row["value"] == "-0.5" for _, row in read_table(tmp_path / "a.csv", ["name", "value"]))
    assert number_table(["=a", "b"], np.zeros((1, 2))).startswith("'=a,b\n")


def test_what_a_terminal_is_told_does_not_steer_it(capsys):
    name = "\x1b[2Jan\x07na\u202e\udce9 é\u00a0ü\nwritten: elsewhere"
    say(name)
    with bar(name) as tell:
        tell(1, 1)
    show([Metric(name, "[red]x[/red]", "[bold]")])
    out, err = capsys.readouterr()
    for text in (out, err):
        assert not {"\x1b", "\x07", "\u202e", "\udce9"} & set(text)
        assert "\nwritten" not in text
    assert r"\x1b[2Jan\x07na\u202e\udce9 é" in err
    assert "[red]x[/red]" in out and "[bold]" in out


def test_a_scan_whose_name_is_no_text_is_named(tmp_path):
    (tmp_path / "an\x1bna.ply").write_bytes(b"")
    with pytest.raises(ValueError, match=r"an\\x1bna.*rename"):
        find_scans(tmp_path)


ALIKE = {"case": ("Anna", "anna"), "accents": ("Ann\u00e9", "Anne\u0301"), "both": ("\u00c4NNE", "a\u0308nne"),
         "sharp s": ("gro\u00df", "GROSS")}


@pytest.mark.parametrize("names", ALIKE.values(), ids=ALIKE)
def test_names_that_are_one_folder_elsewhere_are_refused_before_the_work(home, tmp_path, names):
    says = f"'{names[0]}' and '{names[1]}' are one name"
    for name in names:
        (home / f"{name}.ply").write_bytes(b"")
    with pytest.raises(ValueError, match="are one name"):
        find_scans(home)
    with workspace(tmp_path / "new") as space, pytest.raises(ValueError, match=says):
        space.run(Copy(), [Task(name, home / "in.txt", name) for name in names])
    made = RegisteredSet.create(tmp_path / "set", CORNER).add(names[0], CORNER)
    with pytest.raises(ValueError, match=says):
        made.add(names[1], CORNER)
    assert [path.stem for path in (tmp_path / "set" / "meshes").iterdir()] == [names[0]]


HARD_NAMES = ("two words", "it's", "-anna", "--help", 'quo"te', "$HOME", "a%2Fb", "\u00e4" * 90,
              "\u65e5" * 66, "n" * 200)


def test_names_of_any_signs_and_length_are_done_and_found_again(home):
    tasks = [Task(name, home / "in.txt", name) for name in HARD_NAMES]
    (home / "in.txt").write_text("text")
    for fresh in (HARD_NAMES, ()):
        with workspace(home / "all") as space:
            done = space.run(Copy(), tasks)
        assert not done.failures and done.fresh == fresh
        assert {path.name for path in (home / "all").iterdir() if path.name != HOME} == {*HARD_NAMES}
    for name in ("n" * 201, "\u65e5" * 67):
        with workspace(home / "all") as space, pytest.raises(ValueError, match=r"at most 200 bytes.*rename"):
            space.run(Copy(), [Task(name, home / "in.txt", name)])
