"""Files of `scape label` and of --unlabelled: nothing is lost, labels can be corrected, later commands go on with them.

Who is which marker is known here, see `KnowsTruth`; that it is found is in test_completion_labelling.py.
"""
import csv
import json
import re
import shutil
from collections import Counter

import numpy as np
import pytest
from c3d_bytes import c3d_bytes
from config_files import config_file
from mosh_folders import FRAMES, QuietWork, write_people
from mosh_folders import run as mosh
from quiet_pictures import small_pictures  # noqa: F401 -- fixture
from shuffled_points import RATE, KnowsTruth, shuffle, worm_points

from completion import MarkerSequence, read_markers, write_markers
from completion.__main__ import main
from completion.mocap.animate import work as animating
from completion.mocap.files.c3d import point_table
from completion.mocap.files.c3d_points import rename_points
from completion.mocap.files.markers import MarkerFileError, read_marker_points
from completion.mocap.labelling import recording
from completion.mocap.labelling.corrections import COLUMNS
from completion.mocap.mosh import cli as mosh_cli
from completion.mocap.mosh.call import MoshCall
from completion.mocap.mosh.mend import MoshApp
from completion.motion import Motion

ezc3d = pytest.importorskip("ezc3d")
MARKERS = tuple(f"M{i}" for i in range(34))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A model, a layout, and raw.c3d: a worm and a ghost, shuffled in every frame, with all that C3D files hold."""
    place = write_people(tmp_path_factory.mktemp("label"))
    config_file(place, person={"frames": 4})
    order, points, _ = worm_points(place)
    write_raw(place / "raw.c3d", shuffle(points, order))
    return place


@pytest.fixture
def here(place, tmp_path, monkeypatch):
    """The working folder, with these files; markers are labelled by the truth."""
    for name in ("model.npz", "layout.json", "config.toml", "raw.c3d"):
        shutil.copy(place / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    _, _, markers = worm_points(place)
    knows = KnowsTruth(*markers)
    monkeypatch.setattr(recording, "label_people", knows)
    return tmp_path, knows


def write_raw(path, points):
    """Points among which one is an angle, with cameras, residuals, analog channels, an event and a force plate."""
    T, C = points.shape[:2]
    rng, tree = np.random.default_rng(7), ezc3d.c3d()
    names = [f"*{i}" for i in range(C)]
    names.insert(4, "Angle")
    every = np.insert(1000 * points, 4, rng.normal(0, 40, (T, 3)), axis=1)
    parameters = tree["parameters"]["POINT"]
    parameters["LABELS"]["value"], parameters["RATE"]["value"], parameters["UNITS"]["value"] = names, [RATE], ["mm"]
    tree.add_parameter("POINT", "ANGLES", ["Angle"])
    tree.add_parameter("EVENT", "LABELS", ["Foot Strike"])
    tree.add_parameter("EVENT", "TIMES", np.array([[0.0], [0.25]]))
    tree.add_parameter("FORCE_PLATFORM", "ORIGIN", np.array([[1.0], [2.0], [3.0]]))
    tree.add_parameter("ANALOG", "LABELS", ["Fx", "Fy"])
    tree["parameters"]["ANALOG"]["RATE"]["value"] = [4 * RATE]
    tree["data"]["points"] = np.concatenate([every.transpose(2, 1, 0), np.ones((1, C + 1, T))])
    residuals = np.where(np.isnan(every[..., 0]), -1.0, rng.integers(1, 9, (T, C + 1)))
    tree["data"]["meta_points"] = {"residuals": residuals.T[None], "camera_masks": rng.random((7, C + 1, T)) < 0.5}
    tree["data"]["analogs"] = rng.normal(size=(1, 2, 4 * T))
    tree.write(str(path))


def label(*words):
    return main(["label", *map(str, words), "-m", "model.npz", "--layout", "layout.json"])


def observations(path):
    """Of every frame the measured points with cameras and residual, however often each."""
    data = path.read_bytes()
    table = point_table(path, data)
    words = table.words(data)[:, list(table.kept)]
    return [Counter(map(tuple, frame[frame[:, 3] >= 0].tolist())) for frame in words]


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def correct(path, **changes):
    """Change a table of labels: {track: label}, and all rows of that track are fixed."""
    rows = rows_of(path)
    for row in rows:
        row["point"] = row["point"].lstrip("'")
        if (name := f"t{row['track']}") in changes:
            row["label"], row["fixed"] = changes[name], "yes"
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)


def told(path):
    return {m["metric"]: m["value"] for m in json.loads(path.read_text())["metrics"]}


def test_a_c3d_keeps_all_that_was_in_it(here):
    folder, _ = here
    assert label("raw.c3d", "-o", "out.c3d") == 0
    assert observations(folder / "out.c3d") == observations(folder / "raw.c3d")
    old, new = (ezc3d.c3d(str(folder / name)) for name in ("raw.c3d", "out.c3d"))
    labels = new["parameters"]["POINT"]["LABELS"]["value"]
    assert labels == [*MARKERS, "*1", "Angle"]                       # the tracks of the ghost share one column
    angle = old["parameters"]["POINT"]["LABELS"]["value"].index("Angle")
    np.testing.assert_array_equal(new["data"]["points"][:, -1], old["data"]["points"][:, angle])
    np.testing.assert_array_equal(new["data"]["analogs"], old["data"]["analogs"])
    for group, name in (("EVENT", "LABELS"), ("EVENT", "TIMES"), ("FORCE_PLATFORM", "ORIGIN"), ("POINT", "ANGLES"),
                        ("ANALOG", "LABELS"), ("POINT", "RATE"), ("POINT", "UNITS")):
        before, after = (tree["parameters"][group][name]["value"] for tree in (old, new))
        np.testing.assert_array_equal(before, after)
    _, points, markers = worm_points(folder)
    np.testing.assert_allclose(read_markers("out.c3d").select(MARKERS).positions, markers[0], atol=1e-6)
    np.testing.assert_allclose(read_markers("out.c3d").positions[:, 34], points[:, 34], atol=1e-6)


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("ending", ["trc", "csv"])
def test_other_files_keep_all_points(ending):
    raw = read_markers("raw.c3d")
    write_markers(f"raw.{ending}", raw)
    assert label(f"raw.{ending}", "-o", f"out.{ending}") == 0
    out = read_markers(f"out.{ending}")
    assert out.labels == (*MARKERS, "*1") and out.rate == RATE
    for before, after in zip(raw.positions, out.positions, strict=True):
        before, after = (np.array(sorted(some[np.isfinite(some[:, 0])].tolist())) for some in (before, after))
        np.testing.assert_allclose(before, after, atol=1e-6)
    assert label("raw.c3d", "-o", f"again.{ending}") == 0              # and from one kind to another
    np.testing.assert_allclose(read_markers(f"again.{ending}").positions, out.positions, atol=1e-6)


def test_whole_numbers_and_other_counts(here):
    """A C3D of whole numbers keeps its steps; a table of columns for another file is refused."""
    folder, _ = here
    places = np.round(1000 * read_markers("raw.c3d").positions[:6, :5])
    data = c3d_bytes(places, ["a", "b", "c", "d", "e"], scale=0.5, analog=np.arange(24.0).reshape(12, 2))
    (folder / "whole.c3d").write_bytes(data)
    source = np.tile([4, 3, -1, 0], (6, 1))
    renamed = rename_points(folder / "whole.c3d", data, ["E", "D", "none", "A"], source)
    (folder / "renamed.c3d").write_bytes(renamed)
    out = read_markers(folder / "renamed.c3d")
    assert out.labels == ("E", "D", "none", "A") and not out.seen[:, 2].any()
    whole = read_markers(folder / "whole.c3d")
    np.testing.assert_array_equal(out.positions[:, [0, 1, 3]], whole.positions[:, [4, 3, 0]])
    for wrong in (source[:3], source + 3):
        with pytest.raises(MarkerFileError, match="expected a file of"):
            rename_points(folder / "whole.c3d", data, ["E", "D", "none", "A"], wrong)


def test_corrections_go_back_in(here):
    folder, _ = here
    assert label("raw.c3d", "-o", "out.c3d") == 0
    rows = rows_of(folder / "out.labels.csv")
    track = {row["label"]: row["track"] for row in rows}
    correct(folder / "out.labels.csv", **{f"t{track['M5']}": "M6", f"t{track['M6']}": "M5", f"t{track['M9']}": ""})
    assert label("raw.c3d", "-o", "mended.c3d", "--labels", "out.labels.csv") == 0
    before, after = read_markers("out.c3d"), read_markers("mended.c3d")
    np.testing.assert_array_equal(after.select(["M5", "M6"]).positions, before.select(["M6", "M5"]).positions)
    assert not after.select(["M9"]).seen.any()
    assert observations(folder / "mended.c3d") == observations(folder / "raw.c3d")
    fixed = [row for row in rows_of(folder / "mended.labels.csv") if row["fixed"]]
    assert sorted(row["label"] for row in fixed) == ["", "M5", "M6"]
    assert told(folder / "mended.c3d.report.json")["labels that were known"] == 2 * FRAMES


TABLES = {
    "fixed": ("{track},*1,{begin},{end},M5,1,perhaps", "line 2: expected yes or nothing in the column fixed"),
    "number": ("{track},*1,first,{end},M5,1,yes", "line 2: expected whole numbers for track, begin and end"),
    "label": ("{track},*1,{begin},{end},LKNE,1,yes", "line 2: expected a label of the layout or nothing, found 'LKNE'"),
    "frames": ("{track},*1,{begin},999,M5,1,yes", "this recording has it in .* was the table made from another?"),
    "track": ("9999,*1,{begin},{end},M5,1,yes", "this recording has no such track"),
    "twice": ("{track},*1,{begin},{end},M5,1,yes\n{other},*1,{begin},{end},M5,1,yes", "M5 is fixed for two points"),
    "both": ("{track},*1,{begin},{end},M5,1,yes\n{track},*1,{begin},{end},M6,1,yes", "line 3: expected one label for"),
    "columns": (None, "line 1: expected the columns track,point,begin,end")}


@pytest.mark.parametrize("case", TABLES)
def test_a_wrong_table_is_refused(here, capsys, case):
    folder, _ = here
    assert label("raw.c3d", "-o", "out.c3d") == 0
    whole = [row for row in rows_of(folder / "out.labels.csv") if row["begin"] == "0" and row["end"] == str(FRAMES - 1)]
    text, message = TABLES[case]
    lines = "a,b\n1,2" if text is None else ",".join(COLUMNS) + "\n" + text.format(
        other=whole[1]["track"], **{name: whole[0][name] for name in ("track", "begin", "end")})
    (folder / "wrong.csv").write_text(lines + "\n")
    capsys.readouterr()
    assert label("raw.c3d", "-o", "other.c3d", "--labels", "wrong.csv") == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "wrong.csv" in said
    assert re.search(message, said), said
    assert not (folder / "other.c3d").exists()


def test_labels_that_the_recording_has_are_believed_unless_asked(here):
    """Two names of the layout are on the wrong points: they stay, or are put right."""
    folder, _ = here
    _, points, _ = worm_points(folder)
    names = [f"*{i}" for i in range(35)]
    names[5], names[6], names[7] = "Worm:m6", "Worm:M5", "Worm:stick"
    write_markers("some.csv", MarkerSequence(points, names, RATE))
    assert label("some.csv", "-o", "kept.csv") == 0 and label("some.csv", "-o", "anew.csv", "--relabel") == 0
    kept, anew = read_markers("kept.csv"), read_markers("anew.csv")
    np.testing.assert_allclose(kept.select(["M6", "M5"]).positions, points[:, [5, 6]], atol=1e-8)
    np.testing.assert_allclose(anew.select(["M5", "M6"]).positions, points[:, [5, 6]], atol=1e-8)
    reports = [told(folder / f"{name}.csv.report.json")["labels that were known"] for name in ("kept", "anew")]
    assert reports == [2 * FRAMES, 0]


def test_several_people(here, monkeypatch):
    folder, _ = here
    order, points, markers = worm_points(folder, ("ann", "bob"))
    knows = KnowsTruth(*markers)
    monkeypatch.setattr(recording, "label_people", knows)
    write_markers("two.csv", MarkerSequence(shuffle(points, order), [f"*{i}" for i in range(69)], RATE))
    assert label("two.csv", "-o", "out.c3d", "--people", "2") == 0
    out = read_marker_points("out.c3d")
    assert out.labels == (*(f"Person{k}:{name}" for k in (1, 2) for name in MARKERS), "*1")
    for k in (1, 2):
        np.testing.assert_allclose(read_markers("out.c3d", subject_prefix=f"Person{k}").positions, markers[k - 1],
                                   atol=1e-6)
    # people whom the recording names keep their names
    names = [*(f"Ann:{name}" for name in MARKERS), *(f"Bob:{name}" for name in MARKERS), "*1"]
    write_markers("named.csv", MarkerSequence(points, names, RATE))
    assert label("named.csv", "-o", "again.csv", "--people", "2") == 0
    assert read_marker_points("again.csv").labels == tuple(names)
    assert "person 2" in (folder / "again.report.html").read_text()


def test_a_folder_of_recordings(here, capsys):
    folder, knows = here
    (folder / "raw").mkdir()
    for name in ("one.c3d", "two.c3d"):
        shutil.copy("raw.c3d", folder / "raw" / name)
    (folder / "raw" / "broken.trc").write_text("no markers")
    assert label("raw", "-o", "out", "--workers", "1") == 1
    assert "broken.trc" in capsys.readouterr().err and knows.called == 2
    for name in ("one", "two"):
        assert {p.name for p in (folder / "out" / name).iterdir()} == {"labelled.c3d", "labels.csv", "report.html"}
        assert observations(folder / "out" / name / "labelled.c3d") == observations(folder / "raw.c3d")
    (folder / "raw" / "broken.trc").unlink()
    assert label("raw", "-o", "out", "--workers", "1") == 0
    assert knows.called == 2 and told(folder / "out" / "report.json")["done before"] == 2
    assert "labelled" in (folder / "out" / "report.html").read_text()
    (folder / "table.csv").write_text(",".join(COLUMNS))
    assert label("raw", "-o", "out.c3d") == 2 and label("raw", "-o", "out", "--labels", "table.csv") == 2
    assert label("raw/one.c3d", "-o", "single") == 0
    assert {p.name for p in (folder / "single").iterdir()} >= {"labelled.c3d", "labels.csv", "report.html",
                                                              "report.json"}


def test_the_page_says_where_labels_are_unsure(here, monkeypatch):
    folder, knows = here
    confidence = np.ones((FRAMES, 34))
    confidence[12:20, 7], confidence[30, 8] = 0.3, 0.7
    knows.confidence = confidence
    assert label("raw.c3d", "-o", "out.c3d") == 0
    page = (folder / "out.report.html").read_text()
    rows = page[page.index("<tbody>"):page.index("</tbody>")]
    assert rows.count("<tr>") == 2 and rows.index("12–19") < rows.index("M7") < rows.index("M8")
    assert "<code>--labels out.labels.csv</code>" in page and "hardly" not in rows
    assert "src=\"http" not in page and "href=\"http" not in page
    assert json.loads((folder / "out.c3d.report.json").read_text())["judgement"]["verdict"] == "good"
    knows.confidence = 0.5
    assert label("raw.c3d", "-o", "bad.c3d") == 0
    report = json.loads((folder / "bad.c3d.report.json").read_text())
    assert report["judgement"]["verdict"] == "check" and "100% of the labels are doubtful" in str(report["judgement"])


WRONG = {
    "label raw.c3d -o out.c3d -m model.npz": (1, "--layout: expected one"),
    "label raw.c3d -o out.ply --layout layout.json": (2, "--output: expected a file ending in .c3d, .trc, .csv, or a"),
    "label raw.c3d -o out.c3d --layout layout.json --people 0": (2, "--people: expected one at least, got 0"),
    "label gone.c3d -o out.c3d --layout layout.json -m model.npz": (1, "gone.c3d"),
    "animate raw.c3d -o out -m model.npz --unlabelled": (2, "--unlabelled: expected --layout"),
    "animate walk.bvh -o out -m model.npz --unlabelled": (1, "a motion has no markers; leave out"),
    "mosh raw.c3d -o out -m model.npz --unlabelled": (2, "--unlabelled: expected --layout")}


@pytest.mark.parametrize("command", WRONG)
def test_wrong_use_is_told(here, capsys, command):
    folder, _ = here
    (folder / "walk.bvh").write_text("HIERARCHY\n")
    code, message = WRONG[command]
    assert main(command.split()) == code
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (folder / "out").exists() and not (folder / "out.c3d").exists()


def animate(*words):
    return main(["animate", *map(str, words), "-m", "model.npz", "--layout", "layout.json", "--config", "config.toml",
                 "--workers", "1"])


@pytest.mark.slow
def test_animate_goes_on_with_the_labels(here, monkeypatch):
    """As with the markers under their names; killed after the labels, it does not look for them again."""
    folder, knows = here
    _, _, markers = worm_points(folder)
    write_markers("named.c3d", MarkerSequence(markers[0], MARKERS, RATE))
    assert animate("named.c3d", "-o", "named") == 0
    with monkeypatch.context() as patch:
        patch.setattr(animating, "animate", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert animate("raw.c3d", "-o", "out", "--unlabelled") == 130
    assert animate("raw.c3d", "-o", "out", "--unlabelled") == 0 and knows.called == 1
    out = folder / "out"
    assert {p.name for p in out.iterdir()} >= {"labelled.c3d", "labels.csv", "labels.html", "report.html", "motion.npz"}
    assert observations(out / "labelled.c3d") == observations(folder / "raw.c3d")
    assert 'href="labels.html"' in (out / "report.html").read_text()
    first, second = (Motion.load(folder / name / "motion.npz") for name in ("named", "out"))
    np.testing.assert_allclose(first.poses, second.poses, atol=1e-5)
    assert second.labels == MARKERS
    assert animate("raw.c3d", "-o", "out", "--unlabelled") == 0 and knows.called == 1
    knows.confidence = 0.5
    assert animate("raw.c3d", "-o", "doubtful", "--unlabelled") == 0
    judged = json.loads((folder / "doubtful" / "report.json").read_text())["judgement"]
    assert judged["verdict"] == "check" and "of the labels are doubtful" in " ".join(judged["reasons"])


def test_mosh_goes_on_with_the_labels(here, monkeypatch):
    """Of centimetres, which the file does not tell; the page that mends reads the labelled points."""
    folder, knows = here
    monkeypatch.setattr(mosh_cli, "MoshTask", QuietWork)
    order, points, markers = worm_points(folder)
    write_markers("walk.csv", MarkerSequence(100 * shuffle(points, order), [f"*{i}" for i in range(35)], RATE))
    assert mosh(folder, "walk.csv", "-o", "out", "--unlabelled", "--unit", "cm") == 0
    own = folder / "out" / "walk" / "walk"
    assert {p.name for p in own.iterdir()} >= {"labelled.c3d", "labels.csv", "labels.html", "virtual.c3d"}
    for name in ("labelled.c3d", "virtual.c3d"):
        found = read_markers(own / name).select(MARKERS).positions
        seen = np.isfinite(markers[0])
        np.testing.assert_allclose(found[seen], markers[0][seen], atol=1e-3)
    filled = found[4:10, 3]                                          # by the body, from where it was last seen on
    assert np.linalg.norm(np.diff(filled, axis=0), axis=1).max() < 0.03
    assert MoshCall.read(folder / "out").unlabelled and 'href="labels.html"' in (own / "report.html").read_text()
    app = MoshApp(folder / "out")
    np.testing.assert_allclose(app.person.markers[0].positions, markers[0], atol=1e-6)
    assert app.person.markers[0].labels == MARKERS
    # called again, and with other settings, it does not look for the labels again
    for more in ({}, {"exaggeration": 1.5}):
        assert mosh(folder, "walk.csv", "-o", "out", "--unlabelled", "--unit", "cm", **more) == 0
    assert knows.called == 1
