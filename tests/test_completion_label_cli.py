"""`scape label`, and `--unlabelled` of `animate` and `mosh`, as users call them."""
import json
import warnings

import numpy as np
import pytest
from c3d_bytes import c3d_bytes
from labelling import RATE, person, shuffled, unnamed

from completion.__main__ import main
from completion.mocap.files.c3d import point_table
from completion.mocap.files.c3d_points import rename_points
from completion.mocap.files.markers import MarkerSequence, read_markers, write_markers
from completion.mocap.labelling.corrections import read_corrections
from completion.mocap.labelling.label import GHOST
from completion.mocap.labelling.recording import pack_tracks
from completion.mocap.labelling.tracks import link_points
from completion.mocap.marker_sets.named import choose_layout
from completion.mocap.marker_sets.opensim import opensim_markers
from model import load_model
from scanprep.geometry.landmark_writing import marker_set
from scanprep.geometry.tables import read_table


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a recording, raw.c3d, true.c3d with its labels, and the person's betas."""
    folder = tmp_path_factory.mktemp("label")
    _, layout, places = person(2, frames=24)
    places = places.copy()
    places[10:14, 3] = np.nan
    write_markers(folder / "true.c3d", MarkerSequence(places, layout.labels, RATE))
    points, _ = shuffled(places)
    write_markers(folder / "raw.c3d", unnamed(points))
    write_markers(folder / "raw.trc", unnamed(points))
    rng = np.random.default_rng(2)
    (folder / "betas.json").write_text(json.dumps(rng.normal(size=8).tolist()))
    return folder


@pytest.fixture(scope="module")
def out(place):
    """What the command makes of it."""
    assert run(place, "label", "raw.c3d", "--layout", "cmu41", "-o", "labelled.c3d") == 0
    return place


def run(folder, *words):
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.chdir(folder)
        return main([str(word) for word in words])


def test_the_recording_is_labelled_and_nothing_is_lost(out):
    true, found, raw = (read_markers(out / f"{name}.c3d") for name in ("true", "labelled", "raw"))
    markers = found.select(true.labels).positions
    same = np.isclose(markers, true.positions, atol=1e-5, equal_nan=True).all(axis=2)
    assert same.mean() > 0.985
    for before, after in zip(raw.positions, found.positions, strict=True):
        kept = [np.sort(each[np.isfinite(each[:, 0]), 0]) for each in (before, after)]
        assert np.array_equal(*kept)
    told = json.loads((out / "labelled.c3d.report.json").read_text())
    assert told["judgement"]["verdict"] == "good", told["judgement"]
    assert "Where it is unsure" in (out / "labelled.report.html").read_text()


@pytest.mark.slow
def test_corrections_come_back(out):
    """The two front markers of the head exchanged by hand, and one made none."""
    rows = [row for _, row in read_table(out / "labelled.labels.csv", ("track", "label"))]
    names = {"LFHD": "RFHD", "RFHD": "LFHD", "CLAV": ""}
    lines = ["track,point,begin,end,label,confidence,fixed"]
    for row in rows:
        fixed = "yes" if row["label"] in names else ""
        label = names.get(row["label"], row["label"])
        lines.append(",".join([row["track"], row["point"], row["begin"], row["end"], label, row["confidence"], fixed]))
    (out / "mine.csv").write_text("\n".join(lines))
    assert run(out, "label", "raw.c3d", "--layout", "cmu41", "--labels", "mine.csv", "-o", "again.c3d") == 0
    before, after = read_markers(out / "labelled.c3d"), read_markers(out / "again.c3d")
    for one, other in (("LFHD", "RFHD"), ("RFHD", "LFHD")):
        a, b = before.select([one]).positions, after.select([other]).positions
        assert np.isclose(a, b, equal_nan=True).all()
    assert not after.select(["CLAV"]).seen.any()
    known = read_corrections(out / "mine.csv", link_points(read_markers(out / "raw.c3d").positions, RATE),
                             after.labels[:41])
    assert (known == GHOST).sum() == before.select(["CLAV"]).seen.sum()


@pytest.mark.parametrize(("line", "words"), [
    ("0,*1,0,3,NOSE,0.9,yes", "line 2: expected a label of the layout or nothing, found 'NOSE'"),
    ("0,*1,0,x,LFHD,0.9,yes", "line 2: expected whole numbers for track, begin and end"),
    ("9999,*1,0,3,LFHD,0.9,yes", "line 2: expected frames of track 9999 in 0 to 3"),
    ("0,*1,0,3,LFHD,0.9,perhaps", "line 2: expected yes or nothing in the column fixed, found 'perhaps'"),
])
def test_corrections_that_cannot_be_are_told(out, capsys, line, words):
    (out / "bad.csv").write_text("track,point,begin,end,label,confidence,fixed\n" + line + "\n")
    assert run(out, "label", "raw.c3d", "--layout", "cmu41", "--labels", "bad.csv", "-o", "no.c3d") == 1
    told = capsys.readouterr().err
    assert "bad.csv" in told and words in " ".join(told.split()) and not (out / "no.c3d").exists()


@pytest.mark.slow
def test_a_known_person_and_other_formats(place, capsys):
    assert run(place, "label", "raw.trc", "--layout", "cmu41", "--subject", "betas.json", "-o", "known.csv") == 0
    true, found = read_markers(place / "true.c3d"), read_markers(place / "known.csv")
    same = np.isclose(found.select(true.labels).positions, true.positions, atol=1e-4, equal_nan=True).all(axis=2)
    assert same.mean() > 0.98


@pytest.mark.slow
def test_labels_that_are_there_are_believed_unless_told_otherwise(place):
    true = read_markers(place / "true.c3d")
    swapped = [{"LFHD": "RFHD", "RFHD": "LFHD"}.get(label, label) for label in true.labels]
    write_markers(place / "swapped.c3d", MarkerSequence(true.positions, tuple(swapped), true.rate))
    for words, right in (((), False), (("--relabel",), True)):
        assert run(place, "label", "swapped.c3d", "--layout", "cmu41", "--subject", "betas.json", *words, "-o",
                   "told.c3d") == 0
        found = read_markers(place / "told.c3d").select(["LFHD"]).positions
        assert np.isclose(found, true.select(["LFHD"]).positions, atol=1e-5, equal_nan=True).all() == right


@pytest.mark.parametrize(("words", "said"), [
    (("label", "raw.c3d", "-o", "x.c3d"), "--layout: expected one, the recording has no labels of a marker set"),
    (("label", "raw.c3d", "--layout", "cmu41", "-o", "x.txt"), "a file ending in .c3d, .trc, .csv, or a folder"),
    (("label", "raw.c3d", "--layout", "cmu41", "--people", "0", "-o", "x.c3d"), "--people: expected one at least"),
    (("label", "few.c3d", "--layout", "cmu41", "-o", "x.c3d"), "at least 10 points, the best has 9"),
    (("label", "raw.c3d", "--layout", "cmu41", "--unit", "m", "-o", "x.c3d"), "metres taken for millimetres"),
    (("animate", "raw.c3d", "--unlabelled", "-o", "x"), "--unlabelled: expected --layout"),
    (("mosh", "raw.c3d", "--unlabelled", "-o", "x"), "--unlabelled: expected --layout"),
])
def test_what_cannot_be_labelled_is_told(place, capsys, words, said):
    raw = read_markers(place / "raw.c3d")
    write_markers(place / "few.c3d", MarkerSequence(raw.positions[:, :9], raw.labels[:9], raw.rate))
    assert run(place, *words) in (1, 2)
    assert said in " ".join(capsys.readouterr().err.split()) and not (place / "x.c3d").exists()


@pytest.mark.slow
def test_animate_labels_first(place):
    assert run(place, "animate", "raw.c3d", "--unlabelled", "--layout", "cmu41", "--subject", "betas.json", "-o",
               "moving") == 0
    true, found = read_markers(place / "true.c3d"), read_markers(place / "moving" / "labelled.c3d")
    same = np.isclose(found.select(true.labels).positions, true.positions, atol=1e-5, equal_nan=True).all(axis=2)
    assert same.mean() > 0.98 and (place / "moving" / "labels.csv").exists()
    first = (place / "moving" / "labels.csv").stat().st_mtime_ns
    assert run(place, "animate", "raw.c3d", "--unlabelled", "--layout", "cmu41", "--subject", "betas.json", "-o",
               "moving") == 0
    assert (place / "moving" / "labels.csv").stat().st_mtime_ns == first                    # not labelled anew
    motion = np.load(place / "moving" / "motion.npz")
    assert np.isfinite(motion["poses"]).all()


@pytest.mark.parametrize("scale", [-1.0, 0.1])
def test_a_c3d_keeps_what_is_not_points(tmp_path, scale):
    """Analog channels and further parameters; points go bit for bit under their new labels."""
    rng = np.random.default_rng(0)
    places, analog = rng.uniform(-1, 1, (6, 4, 3)).round(4), rng.integers(-99, 99, (12, 3)).astype(float)
    path = tmp_path / "raw.c3d"
    path.write_bytes(c3d_bytes(places * 1000, ["*1", "*2", "*3", "*4"], scale=scale, analog=analog,
                               more=[("SUBJECT", "NAME", ["Eve"])]))
    order = np.stack([rng.permutation(4) for _ in range(6)])
    order[2, 1] = -1
    data = path.read_bytes()
    written = tmp_path / "named.c3d"
    written.write_bytes(rename_points(path, data, ["A", "B", "C", "D"], order))
    before, after = read_markers(path).positions, read_markers(written)
    wanted = np.take_along_axis(before, np.maximum(order, 0)[..., None], axis=1)
    wanted[order < 0] = np.nan
    assert after.labels == ("A", "B", "C", "D") and np.array_equal(after.positions, wanted, equal_nan=True)
    tables = [point_table(p, p.read_bytes()) for p in (path, written)]
    rows = [np.frombuffer(p.read_bytes(), np.uint8, t.frames * t.width, t.start).reshape(t.frames, -1)
            for p, t in zip((path, written), tables, strict=True)]
    own = 16 * (4 if scale < 0 else 2)
    assert np.array_equal(rows[0][:, own:], rows[1][:, own:]) and rows[0].shape[1] > own
    assert b"Eve" in written.read_bytes()
    with pytest.raises(ValueError, match="expected a file of 3 frames"):
        rename_points(path, data, ["A", "B", "C", "D"], order[:3])


def test_tracks_are_packed_into_few_series():
    tracks = np.array([[0, 1], [0, 1], [-1, 1], [2, -1]])
    packed = pack_tracks(tracks, tracks >= 0)
    assert packed.shape == (4, 2) and (packed >= 0).sum() == (tracks >= 0).sum()
    assert pack_tracks(tracks, np.zeros((4, 2), dtype=bool)).shape == (4, 0)


def test_a_marker_set_of_opensim_is_a_layout(tmp_path):
    """There and back: markers end within a centimetre of where they began."""
    model = load_model("people")
    layout, _ = choose_layout(model, "plugingait39", ())
    body, skeleton = model.template, model.skeleton
    (tmp_path / "set.xml").write_text(marker_set(opensim_markers(layout, body, skeleton)))
    found, name = choose_layout(model, str(tmp_path / "set.xml"), ())
    assert found.labels == layout.labels and name.endswith("set.xml")
    off = np.linalg.norm(found.skin_points(body.vertices) - layout.skin_points(body.vertices), axis=1)
    assert np.median(off) < 0.03
    for text, words in (("<x", "MarkerSet of OpenSim"), ("<x/>", "expected markers of OpenSim, found none"),
                        ('<x><Marker name="a"><socket_parent_frame>/bodyset/tail</socket_parent_frame>'
                         "<location>0 0 0</location></Marker></x>", "marker 'a': expected one on")):
        (tmp_path / "bad.xml").write_text(text)
        with pytest.raises(ValueError, match=words):
            choose_layout(model, str(tmp_path / "bad.xml"), ())
