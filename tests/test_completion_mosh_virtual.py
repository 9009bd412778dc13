"""Virtual marker files: filled points can be told, and nothing else in the file changes."""
import struct

import numpy as np
import pytest

from completion.mocap.artefacts.results import BadSpan, MarkerArtefacts, Swap, artefact_table, write_virtual
from completion.mocap.files.c3d import point_table, replace_points
from completion.mocap.files.markers import MarkerFileError, MarkerSequence, read_markers

ezc3d = pytest.importorskip("ezc3d")
LABELS = ("LFHD", "RFHD", "C7", "Free")
T = 12


@pytest.fixture
def original(tmp_path):
    """A file with a subject's name, a computed point, analog channels, an event, residuals and cameras."""
    rng = np.random.default_rng(0)
    tree = ezc3d.c3d()
    tree["parameters"]["POINT"]["LABELS"]["value"] = (*(f"Bob:{label}" for label in LABELS), "Angle")
    tree["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    tree["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    tree.add_parameter("POINT", "ANGLES", ["Angle"])
    tree.add_parameter("EVENT", "LABELS", ["Foot Strike"])
    tree.add_parameter("ANALOG", "LABELS", ["Fx", "Fy"])
    tree["parameters"]["ANALOG"]["RATE"]["value"] = [200.0]
    points = np.ones((4, 5, T))
    points[:3] = rng.normal(0, 500, (3, 5, T))
    residuals = rng.integers(1, 5, (1, 5, T)).astype(float)
    residuals[0, 1] = 0                                              # the second says nothing of how it was measured
    points[:3, 2, 4:7], residuals[0, 2, 4:7] = np.nan, -1
    points[:3, 3, 9], residuals[0, 3, 9] = np.nan, -1
    cameras = rng.random((7, 5, T)) < 0.5
    cameras[:, 1] = False
    tree["data"]["points"], tree["data"]["meta_points"] = points, {"residuals": residuals, "camera_masks": cameras}
    tree["data"]["analogs"] = rng.normal(size=(1, 2, 2 * T))
    tree.write(str(tmp_path / "a.c3d"))
    return tmp_path / "a.c3d"


def found(path):
    """Labels 0 and 1 exchanged in frames 2 to 5, label 0 bad in frames 8 and 9; label 3 is in no layout."""
    sequence = read_markers(path)
    order = np.tile(np.arange(4), (T, 1))
    order[2:6, [0, 1]] = [1, 0]
    repaired = np.take_along_axis(sequence.positions, order[..., None], axis=1)
    repaired[8:10, 0] = np.nan
    simulated = np.random.default_rng(1).normal(0, 0.5, (T, 3, 3))
    return MarkerArtefacts((Swap("LFHD", "RFHD", 2, 5),), (BadSpan("LFHD", "stray", 8, 9, 0.2),), simulated,
                        LABELS[:3], MarkerSequence(repaired, LABELS, 100.0), np.ones((T, 3)), simulated + 0.01, order)


def test_a_copy_of_the_file_with_other_points(tmp_path, original):
    faults = found(original)
    write_virtual(tmp_path / "v.c3d", faults, original)
    back, virtual = read_markers(tmp_path / "v.c3d"), faults.virtual()
    np.testing.assert_allclose(back.positions, virtual.positions, atol=1e-6)
    np.testing.assert_array_equal(virtual.positions[8:10, 0], faults.expected[8:10, 0])
    assert back.labels == LABELS and back.seen.sum() == 4 * T - 1                  # no layout knows the last one
    old, new = (ezc3d.c3d(str(path))["data"] for path in (original, tmp_path / "v.c3d"))
    residual, cameras = new["meta_points"]["residuals"][0].T, new["meta_points"]["camera_masks"].transpose(2, 1, 0)
    filled = ~faults.repaired.seen
    filled[:, 3] = False
    assert (residual[:, :4][filled] == 0).all() and not cameras[:, :4][filled].any() and residual[9, 3] == -1
    assert (residual[:, :4][~filled & back.seen] > 0).all()
    np.testing.assert_array_equal(residual[2:6, 1], old["meta_points"]["residuals"][0, 0, 2:6])  # goes with its point
    np.testing.assert_array_equal(new["analogs"], old["analogs"])
    np.testing.assert_array_equal(new["points"][:, 4], old["points"][:, 4])
    a, b = original.read_bytes(), (tmp_path / "v.c3d").read_bytes()
    table = point_table(original, a)
    assert len(a) == len(b) and a[:table.start] == b[:table.start]
    with pytest.raises(MarkerFileError, match="expected the subject 'Eve', found Bob"):
        write_virtual(tmp_path / "w.c3d", faults, original, subject_prefix="Eve")
    assert not (tmp_path / "w.c3d").exists()


def test_nothing_changes_where_nothing_was_found(tmp_path, original):
    data = original.read_bytes()
    table, sequence = point_table(original, data), read_markers(original)
    source = np.where(sequence.seen, np.arange(4), -1)
    out = replace_points(original, data, np.arange(4), sequence.positions, source)
    words, same = table.words(data), table.words(out)
    measured = np.isfinite(words).all(axis=2) & (words[..., 3] >= 256)
    np.testing.assert_array_equal(same[measured], words[measured])
    np.testing.assert_array_equal(same[:, 1, :3], words[:, 1, :3])
    with pytest.raises(MarkerFileError, match="expected a file of 3 frames, found 12"):
        replace_points(original, data, np.arange(4), sequence.positions[:3], source[:3])


def test_a_new_file_tells_filled_points_too(tmp_path, original):
    faults = found(original)
    write_virtual(tmp_path / "v.c3d", faults)
    np.testing.assert_allclose(read_markers(tmp_path / "v.c3d").positions, faults.virtual().positions, atol=1e-6)
    residual = ezc3d.c3d(str(tmp_path / "v.c3d"))["data"]["meta_points"]["residuals"][0].T
    filled = ~faults.repaired.seen & faults.virtual().seen
    np.testing.assert_array_equal(residual, np.where(filled, 0, np.where(faults.virtual().seen, 1, -1)))
    write_virtual(tmp_path / "v.csv", faults)
    np.testing.assert_allclose(read_markers(tmp_path / "v.csv").positions, faults.virtual().positions, atol=1e-8)
    assert artefact_table(faults)["filled"] == {"LFHD": 2, "C7": 3}


def test_whole_numbers_are_rounded_or_do_not_reach(tmp_path, original):
    data, sequence = bytearray(original.read_bytes()), read_markers(original)
    table = point_table(original, bytes(data))
    steps = np.rint(np.nan_to_num(table.words(bytes(data))[..., :3]) / 0.5)
    rows = np.concatenate([steps, np.full((T, 5, 1), 257)], axis=2).astype("<i2")
    data[12:16] = struct.pack("<f", 0.5)
    data[4:6] = struct.pack("<H", 0)                                 # without the analog channels
    whole = bytes(data[:table.start]) + rows.tobytes()
    positions = 5e-4 * steps[:, :4] + np.where(np.arange(4)[:, None] == 2, 0.1001, 0.0)
    source = np.where(np.arange(4) == 2, -1, np.arange(4)) * np.ones((T, 1), dtype=int)
    out = point_table(original, whole).words(replace_points(original, whole, np.arange(4), positions, source))
    np.testing.assert_array_equal(out[:, 2, :3], steps[:, 2] + 200)
    np.testing.assert_array_equal(out[:, :4, 3], np.tile([257, 257, 0, 257], (T, 1)))
    np.testing.assert_array_equal(out[:, 4], rows[:, 4])
    with pytest.warns(UserWarning, match=r"floating-point numbers, its whole ones reach only 16383\.5 mm"):
        far = replace_points(original, whole, np.arange(4), 0 * positions + 20.0, 0 * source - 1)
    (tmp_path / "far.c3d").write_bytes(far)
    assert (read_markers(tmp_path / "far.c3d").positions == 20).all() and len(sequence.labels) == 4
    words = point_table(original, far).words(far)
    np.testing.assert_array_equal(words[:, 4], rows[:, 4] * [0.5, 0.5, 0.5, 1])      # the computed point stays
