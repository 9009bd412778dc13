"""Markers in C3D: its forms, its limits, and damaged files."""

import numpy as np
import pytest
from marker_files import agree, refused, sequence

from completion.mocap.files.markers import MarkerFileError, MarkerSequence, read_markers, write_markers

ezc3d = pytest.importorskip("ezc3d")


def c3d_file(path, labels, points, units=("mm",), rate=100.0, **groups):
    """Write points (3, L, T) as they are."""
    tree = ezc3d.c3d()
    parameters = tree["parameters"]["POINT"]
    parameters["LABELS"]["value"] = tuple(labels)
    parameters["RATE"]["value"] = [rate]
    if units is not None:
        parameters["UNITS"]["value"] = list(units)
    for key, value in groups.items():
        tree.add_parameter("POINT", key, value)
    tree["data"]["points"] = np.concatenate([points, np.ones((1, *points.shape[1:]))])
    tree.write(str(path))
    return path


@pytest.mark.parametrize(("frames", "markers"), [(3, 600), (70_000, 1)])
def test_more_labels_or_frames_than_the_header_can_count(tmp_path, frames, markers):
    positions = np.random.default_rng(1).normal(size=(frames, markers, 3))
    seq = MarkerSequence(positions, tuple(f"M{i}" for i in range(markers)), 1000)
    write_markers(tmp_path / "a.c3d", seq)
    agree(read_markers(tmp_path / "a.c3d"), seq, 1e-6)


@pytest.mark.parametrize(("units", "factor"), [(("mm",), 1e-3), (("M ",), 1), (("cm",), 1e-2), (None, 1e-3),
                                               (("",), 1e-3)])
def test_c3d_units_millimetres_where_it_does_not_say(tmp_path, units, factor):
    points = np.random.default_rng(3).uniform(1, 2, (3, 4, 5))
    path = c3d_file(tmp_path / "a.c3d", "ABCD", points, units)
    np.testing.assert_allclose(read_markers(path).positions, factor * points.transpose(2, 1, 0), rtol=1e-6)
    np.testing.assert_allclose(read_markers(path, unit="in").positions, 0.0254 * points.transpose(2, 1, 0),
                               rtol=1e-6)


def test_c3d_an_unknown_unit_asks_for_one(tmp_path):
    path = c3d_file(tmp_path / "a.c3d", "AB", np.ones((3, 2, 2)), ("furlong",))
    with pytest.raises(MarkerFileError, match=r"a\.c3d: expected a unit of m, mm, cm, in, found 'furlong'"):
        read_markers(path)
    assert read_markers(path, unit="mm").positions.max() == 1e-3


def test_c3d_missing_is_nan_or_zero_or_a_negative_residual(tmp_path):
    tree = ezc3d.c3d()
    tree["parameters"]["POINT"]["LABELS"]["value"] = ("A", "B", "C", "D")
    tree["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    points = np.full((4, 4, 2), 500.0)
    points[:3, 0, 0], points[:3, 1, 0], points[:2, 3, 0] = np.nan, 0.0, 0.0
    residuals = np.zeros((1, 4, 2))
    residuals[0, 2, 0] = -1
    tree["data"]["points"] = points
    tree["data"]["meta_points"] = {"residuals": residuals, "camera_masks": np.zeros((7, 4, 2), dtype=bool)}
    tree.write(str(tmp_path / "a.c3d"))
    seq = read_markers(tmp_path / "a.c3d")
    assert seq.seen.tolist() == [[False, False, False, True], [True] * 4]
    assert np.isnan(seq.positions[0, :3]).all() and seq.positions[0, 3].tolist() == [0, 0, 0.5]


def test_c3d_labels_lose_their_subject(tmp_path):
    points = np.arange(3 * 4 * 2, dtype=float).reshape(3, 4, 2) + 1
    path = c3d_file(tmp_path / "one.c3d", ["Ann:C7", "Ann:T10", "*3", "Ann:RKNE"], points)
    assert read_markers(path).labels == ("C7", "T10", "*3", "RKNE")
    path = c3d_file(tmp_path / "two.c3d", ["Ann:C7", "Bob:C7", "Ann:T10", "Bob:T10"], points)
    with pytest.raises(MarkerFileError, match=r"expected one subject, found Ann, Bob; say subject_prefix=Ann"):
        read_markers(path)
    bob = read_markers(path, subject_prefix="Bob")
    assert bob.labels == ("C7", "T10")
    np.testing.assert_allclose(bob.positions, 1e-3 * points.transpose(2, 1, 0)[:, [1, 3]])
    with pytest.raises(MarkerFileError, match=r"two\.c3d: expected the subject 'Cid', found Ann, Bob"):
        read_markers(path, subject_prefix="Cid")


@pytest.mark.parametrize(("labels", "groups", "kept"), [
    (["C7", "LKneeAngles", "T10", "LKneeMoment"], {"ANGLES": ["LKneeAngles"], "MOMENTS": ["LKneeMoment"]},
     ("C7", "T10")),                                                 # computed quantities are no markers
    (["C7", "", "T10"], {}, ("C7", "point1", "T10"))])
def test_c3d_labels_of_all_kinds(tmp_path, labels, groups, kept):
    path = c3d_file(tmp_path / "a.c3d", labels, np.ones((3, len(labels), 2)), **groups)
    assert read_markers(path).labels == kept


@pytest.mark.parametrize("part", [0.001, 0.05, 0.3, 0.6, 0.9])
def test_a_c3d_cut_off_anywhere_is_refused(tmp_path, part):
    write_markers(tmp_path / "whole.c3d", sequence(np.random.default_rng(5), 200))
    data = (tmp_path / "whole.c3d").read_bytes()
    (tmp_path / "cut.c3d").write_bytes(data[:int(part * len(data))])
    refused(tmp_path / "cut.c3d")


def test_ezc3d_reads_the_same(tmp_path):
    seq = sequence(np.random.default_rng(9), 30)
    write_markers(tmp_path / "a.c3d", seq)
    theirs = ezc3d.c3d(str(tmp_path / "a.c3d"))
    np.testing.assert_allclose(1e-3 * theirs["data"]["points"][:3].transpose(2, 1, 0),
                               read_markers(tmp_path / "a.c3d").positions, atol=1e-12)
    assert tuple(theirs["parameters"]["POINT"]["LABELS"]["value"]) == seq.labels


@pytest.mark.parametrize("seed", range(20))
def test_a_damaged_c3d_is_read_or_refused_but_never_breaks(tmp_path, seed):
    rng = np.random.default_rng(seed)
    write_markers(tmp_path / "a.c3d", sequence(rng))
    whole = (tmp_path / "a.c3d").read_bytes()
    for _ in range(20):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 5)):
            data[rng.integers(0, min(1200, len(data)))] = rng.integers(0, 256)
        (tmp_path / "bad.c3d").write_bytes(bytes(data))
        try:
            read_markers(tmp_path / "bad.c3d")
        except MarkerFileError as error:
            assert "bad.c3d" in str(error) and "\n" not in str(error)


@pytest.mark.real
def test_real_marker_files_hold_people(real_data):
    paths = sorted((real_data / "cmu_c3d").glob("*.c3d"))
    if not paths:
        pytest.skip("the folder of real scans has no recordings in cmu_c3d")
    for path in paths:
        seq = read_markers(path)
        height = np.nanmax(seq.positions[..., 2], axis=1) - np.nanmin(seq.positions[..., 2], axis=1)
        assert seq.rate == 120 and len(seq.labels) in (41, 42) and 1.4 < np.median(height) < 2.1
