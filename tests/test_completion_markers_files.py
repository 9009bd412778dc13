"""Marker sequences: what is written comes back, foreign forms are understood, bad files say what is wrong."""
import csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_files import agree, refused, sequence

from completion.mocap.files.markers import MarkerFileError, MarkerSequence, read_markers, write_markers

ezc3d = pytest.importorskip("ezc3d")


def trc_file(path, seq, unit="mm", factor=1000.0, missing=""):
    rows = ["PathFileType\t4\t(X/Y/Z)\ta.trc",
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
            f"{seq.rate}\t{seq.rate}\t{len(seq.positions)}\t{len(seq.labels)}\t{unit}\t120\t1\t9",
            "Frame#\tTime\t" + "\t\t\t".join(seq.labels) + "\t\t",
            "\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(seq.labels)) for a in "XYZ"), ""]
    for t, frame in enumerate(seq.positions):
        cells = [missing if np.isnan(v) else repr(factor * float(v)) for v in frame.ravel()]
        rows.append("\t".join([str(t + 1), f"{t / seq.rate:.6f}", *cells]))
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(("suffix", "tolerance"), [(".csv", 1e-8), (".c3d", 1e-6), (".trc", 6e-9)])
@pytest.mark.parametrize("rate", [120.0, 59.94, 1000 / 3, 30.0])
def test_round_trip(tmp_path, suffix, tolerance, rate):
    seq = sequence(np.random.default_rng(0), rate=rate)
    write_markers(tmp_path / f"a{suffix}", seq)
    back = read_markers(tmp_path / f"a{suffix}")
    agree(back, MarkerSequence(seq.positions, seq.labels, back.rate), tolerance)
    assert back.rate == pytest.approx(rate, rel=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == [f"a{suffix}"]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_round_trip_of_any_csv(tmp_path_factory, frames, markers, seed):
    seq = sequence(np.random.default_rng(seed), frames, tuple(f"M {i}_x" for i in range(markers)), 50.0)
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    write_markers(path, seq)
    assert read_markers(path).labels == seq.labels
    agree(read_markers(path, rate=50.0), seq, 1e-8)


@pytest.mark.parametrize("missing", ["", "NaN", "0.0"])
@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000), ("m", 1), ("cm", 100)])
def test_trc_in_its_own_unit(tmp_path, missing, unit, factor):
    seq = sequence(np.random.default_rng(2))
    agree(read_markers(trc_file(tmp_path / "a.trc", seq, unit, factor, missing)), seq)


def test_csv_with_frames_asks_for_a_rate(tmp_path):
    (tmp_path / "a.csv").write_text("Frame,C7_X,C7_Y,C7_Z\n0,1,2,3\n1,,,\n2,1.5,2,3\n")
    with pytest.raises(MarkerFileError, match=r"a\.csv: expected the frames per second.*say rate="):
        read_markers(tmp_path / "a.csv")
    seq = read_markers(tmp_path / "a.csv", rate=60)
    assert seq.rate == 60 and seq.labels == ("C7",) and seq.seen.ravel().tolist() == [True, False, True]


def test_csv_in_millimetres_when_the_caller_says_so(tmp_path):
    (tmp_path / "a.csv").write_text("time,frame,C7_x,C7_y,C7_z\n0.5,1,1000,2000,3000\n0.51,2,1000,2000,\n")
    seq = read_markers(tmp_path / "a.csv", unit="mm")
    assert seq.rate == pytest.approx(100) and seq.positions[0, 0].tolist() == [1, 2, 3]
    assert np.isnan(seq.positions[1, 0]).all()


def test_csv_is_plain_enough_for_a_spreadsheet(tmp_path):
    write_markers(tmp_path / "a.csv", MarkerSequence([[[1, 2, 3], [np.nan] * 3]], ("C7", "T10"), 100))
    rows = list(csv.reader((tmp_path / "a.csv").open()))
    assert rows == [["time", "C7_x", "C7_y", "C7_z", "T10_x", "T10_y", "T10_z"], ["0", "1", "2", "3", "", "", ""]]


@pytest.mark.parametrize(("data", "word"), [
    (None, "no such file"), (b"", "empty"), (b"\x89PNG\r\n" + bytes(range(256)) * 8, "expected"),
    (b"hello\nworld\n" * 100, "expected"), ("folder", "found a folder")])
@pytest.mark.parametrize("suffix", [".c3d", ".trc", ".csv"])
def test_missing_empty_folder_and_foreign_files(tmp_path, suffix, data, word):
    path = tmp_path / f"a{suffix}"
    if data == "folder":
        path.mkdir()
    elif data is not None:
        path.write_bytes(data)
    refused(path, word)


def test_a_name_of_no_known_format(tmp_path):
    (tmp_path / "a.bvh").write_text("HIERARCHY")
    refused(tmp_path / "a.bvh", ".c3d", "'.bvh'")
    with pytest.raises(MarkerFileError, match=r"a\.txt: expected a name ending in \.c3d, \.trc, \.csv"):
        write_markers(tmp_path / "a.txt", sequence(np.random.default_rng(4)))


@pytest.mark.parametrize(("old", "new", "words"), [
    ("time,", "clock,", ["line 1", "time,LABEL_x"]),
    ("C7_y", "C7_w", ["line 1", "LABEL_y"]),
    ("0.01,1,2,3", "0.01,1,2", ["line 3", "4 values", "found 3"]),
    ("0.01,1,2,3", "0.01,1,two,3", ["line 3", "two"]),
    ("0.01,1,2,3", "0.05,1,2,3", ["line 3", "even steps"]),
    ("0.02,1,2,3\n", "0.00,1,2,3\n", ["even steps"]),
    ("0,1,2,3\n0.01,1,2,3\n0.02,1,2,3\n", "", ["found none"]),
    ("0.01,1,2,3", "0.01,1,inf,3", ["finite"]),
])
def test_a_bad_csv_says_where(tmp_path, old, new, words):
    text = "time,C7_x,C7_y,C7_z\n0,1,2,3\n0.01,1,2,3\n0.02,1,2,3\n"
    assert old in text
    (tmp_path / "bad.csv").write_text(text.replace(old, new))
    refused(tmp_path / "bad.csv", *words)


@pytest.mark.parametrize(("line", "new", "words"), [
    (2, "many\t120\t7\t4\tmm\t120\t1\t9", ["line 3", "DataRate"]),
    (3, "Frame#\tTime", ["line 4", "marker names", "found none"]),
    (7, "2\t0.1\t1\t2\tx", ["line 8", "x"]),
    (7, "2\t0.1" + 13 * "\t1", ["line 8", "14 values", "found 15"]),
])
def test_a_bad_trc_says_where(tmp_path, line, new, words):
    path = trc_file(tmp_path / "bad.trc", sequence(np.random.default_rng(6)))
    lines = path.read_text().split("\n")
    lines[line] = new
    path.write_text("\n".join(lines))
    refused(path, *words)


def test_select_and_frames():
    seq = sequence(np.random.default_rng(7), 10)
    picked = seq.select(["RTOE", "C7"])
    assert picked.labels == ("RTOE", "C7")
    np.testing.assert_array_equal(picked.positions, seq.positions[:, [3, 0]])
    half = seq.frames(slice(1, None, 2))
    assert half.rate == 60 and len(half.positions) == 5
    np.testing.assert_array_equal(half.positions, seq.positions[1::2])
    with pytest.raises(ValueError, match="labels: NOSE not among C7, LFHD"):
        seq.select(["NOSE"])


@pytest.mark.parametrize(("positions", "labels", "rate", "says"), [
    (np.ones((2, 3, 3)), ("A", "B"), 100, "positions: expected shape"),
    (np.ones((2, 2, 3)), ("A", "A"), 100, "labels: .* A comes"),
    (np.ones((2, 2, 3)), ("A", "B"), 0, "rate"),
    (np.ones((2, 2, 3)), ("A", "B"), np.nan, "rate"),
    (np.full((2, 2, 3), np.inf), ("A", "B"), 100, "finite"),
])
def test_a_sequence_refuses_what_does_not_agree(positions, labels, rate, says):
    with pytest.raises(ValueError, match=says):
        MarkerSequence(positions, labels, rate)


def test_a_marker_with_one_missing_coordinate_is_missing():
    seq = MarkerSequence([[[1, np.nan, 2], [1, 2, 3]]], ("A", "B"), 100)
    assert np.isnan(seq.positions[0, 0]).all() and seq.seen.tolist() == [[False, True]]
