"""Marker files as programs and spreadsheets write them: what they say wrongly of themselves is told, not believed."""
import re

import numpy as np
import pytest
from c3d_bytes import BLOCK, c3d_bytes
from marker_files import refused

from completion.mocap.artefacts.results import MarkerArtefacts, write_virtual
from completion.mocap.files.c3d import file_parameters, point_table, rotations_start
from completion.mocap.files.c3d_points import add_points
from completion.mocap.files.markers import MarkerFileError, MarkerSequence, marker_subjects, people_of, read_markers
from scanprep.geometry.format_common import unit_named

LABELS = ("LFHD", "C7", "LKNE", "RKNE")
RNG = np.random.default_rng(0)
PLACES = np.round(RNG.normal(0, 500, (12, 4, 3)), 2)             # millimetres
RATE = 50.0


def c3d(folder, places=PLACES, labels=LABELS, **named):
    path = folder / "walk.c3d"
    path.write_bytes(c3d_bytes(places, labels, RATE, **named))
    return path


def trc(folder, text=None, encoding="utf-8", places=PLACES, **header):
    """A TRC file, `header` being values of line 3 that differ."""
    said = {"DataRate": "50.00", "CameraRate": "50.00", "NumFrames": str(len(places)), "NumMarkers": "4",
            "Units": "mm"} | header
    lines = ["PathFileType\t4\t(X/Y/Z)\twalk.trc", "\t".join(said), "\t".join(said.values()),
             "Frame#\tTime\t" + "\t\t\t".join(LABELS) + "\t\t",
             "\t\t" + "\t".join(f"{axis}{i + 1}" for i in range(4) for axis in "XYZ"), ""]
    lines += ["\t".join([str(t + 1), f"{t / RATE:.3f}", *(f"{v:.2f}" for v in frame.ravel())])
              for t, frame in enumerate(places)]
    whole = "\n".join(lines) + "\n"
    path = folder / "walk.trc"
    path.write_bytes((whole if text is None else text(whole)).encode(encoding))
    return path


def same(found, places=PLACES, labels=LABELS, rate=RATE, atol=1e-6):
    assert found.labels == labels and found.rate == rate
    np.testing.assert_allclose(found.positions, places / 1000, atol=atol)


# C3D: counts that lie

def test_analog_values_are_counted_by_the_size_of_the_file(tmp_path):
    path = c3d(tmp_path, analog=RNG.normal(size=(12 * 50, 4)), header={"analog": 4})     # channels, without samples
    with pytest.warns(UserWarning, match="the header says 4 analog values a frame; .* there are 200"):
        same(read_markers(path))


@pytest.mark.parametrize("processor", [85, 86])
@pytest.mark.parametrize("scale", [-1.0, 0.1])
def test_numbers_of_other_processors_are_read(tmp_path, processor, scale):
    path = c3d(tmp_path, processor=processor, scale=scale)
    same(read_markers(path), atol=6e-5 if scale > 0 else 1e-6)
    if processor == 85:                                              # big-endian files ezc3d does not read
        theirs = pytest.importorskip("ezc3d").c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
        np.testing.assert_allclose(theirs, 1000 * read_markers(path).positions, atol=1e-3)


def test_the_last_parameter_may_link_into_the_points(tmp_path):
    same(read_markers(c3d(tmp_path, header={"link": 530}, scale=0.1)), atol=6e-5)


@pytest.mark.parametrize("rotations", [False, True])
def test_a_file_of_more_frames_than_the_header_counts(tmp_path, rotations):
    """Without TRIAL and LONG_FRAMES: to the end of the file, or to where rotations begin."""
    T = 65_600
    places = np.tile(np.array([0.0, 0.0, 900.0]), (T, 1, 1)) + np.arange(T)[:, None, None]
    blocks = T * 16 // BLOCK
    start = int.from_bytes(c3d_bytes(places[:1], ["A"], more=[("ROTATION", "DATA_START", 1)])[16:18], "little")
    more = [("ROTATION", "USED", 1), ("ROTATION", "DATA_START", start + blocks)] if rotations else []
    path = c3d(tmp_path, places, ["A"], header={"last": 65535}, more=more)
    if rotations:
        path.write_bytes(path.read_bytes() + np.ones(17 * T // 10, "<f4").tobytes())
    assert len(read_markers(path).positions) == T


def test_the_scale_may_have_the_wrong_sign(tmp_path):
    data = bytearray(c3d_bytes(PLACES, LABELS, RATE))
    data[12:16] = np.array([0.1], "<f4").tobytes()
    (tmp_path / "walk.c3d").write_bytes(bytes(data))
    with pytest.warns(UserWarning, match="wrong sign"):
        same(read_markers(tmp_path / "walk.c3d"), atol=1e-6)


def test_a_rate_is_that_of_the_points_else_of_the_header_else_asked_for(tmp_path):
    more = [("POINT", "RATE", 0.0)]
    same(read_markers(c3d(tmp_path, more=more)))
    path = c3d(tmp_path, more=more, header={"rate": 0.0})
    refused(path, "frames per second", "say rate=")
    same(read_markers(path, rate=50.0))
    with pytest.warns(UserWarning, match="30 are assumed"):
        same(read_markers(path, usual_rate=30.0), rate=30.0)


def test_rotations_without_markers_say_what_to_export(tmp_path):
    path = c3d(tmp_path, np.zeros((5, 0, 3)), [], more=[("ROTATION", "LABELS", ["pelvis_4X4", "l_thigh_4X4"])])
    refused(path, "rotations of 2 segments and no markers", "Theia3D", "export BVH")


# values that stand for what was not seen

@pytest.mark.parametrize("fill", [9999999.0, -16512.0, -3.697314e28, 0.0])
def test_numbers_that_stand_for_a_gap(tmp_path, fill):
    places = PLACES.copy()
    places[3:5, 1] = fill
    path, gap = c3d(tmp_path, places), PLACES.copy()
    gap[3:5, 1] = np.nan
    if fill:
        with pytest.warns(UserWarning, match=rf"2 positions of {re.escape(f'{np.float32(fill):.9g}')} .*missing"):
            same(read_markers(path), gap)
    else:
        same(read_markers(path), gap)
    if abs(fill) < 1e8 and fill:
        with pytest.warns(UserWarning, match="taken as missing"):
            same(read_markers(trc(tmp_path, places=places)), gap)


def test_a_place_with_three_equal_numbers_among_others_is_a_place(tmp_path):
    places = PLACES.copy()
    places[3, 1] = 250.0
    same(read_markers(c3d(tmp_path, places)), places)


# labels and people

def test_a_label_that_comes_twice_gets_a_name_of_its_own(tmp_path):
    twice = ("LKNE", "C7", "LKNE", "LKNE")
    path = c3d(tmp_path, labels=twice, more=[("POINT", "DESCRIPTIONS", ["L.Knee", "C7", "L.Knee.Medial", ""])])
    with pytest.warns(UserWarning, match="labels come again: LKNE now L.Knee.Medial, LKNE now LKNE_2"):
        same(read_markers(path), labels=("LKNE", "C7", "L.Knee.Medial", "LKNE_2"))
    with pytest.warns(UserWarning, match="labels come again: LKNE now LKNE_2"):
        found = read_markers(trc(tmp_path, lambda text: text.replace("RKNE", "LKNE")))
    same(found, labels=("LFHD", "C7", "LKNE", "LKNE_2"))


def test_the_mended_file_has_the_same_names(tmp_path):
    path = c3d(tmp_path, labels=("LKNE", "C7", "LKNE", "RKNE"))
    with pytest.warns(UserWarning, match="LKNE_2"):
        sequence = read_markers(path)
    order = np.tile(np.arange(4), (12, 1))
    found = MarkerArtefacts((), (), sequence.positions, sequence.labels, sequence, np.ones((12, 4)), sequence.positions,
                            order)
    joints = MarkerSequence(np.zeros((12, 1, 3)) + 0.5, ("knee_l_joint",), RATE)
    write_virtual(tmp_path / "v.c3d", found, path, joints=joints)
    back = read_markers(tmp_path / "v.c3d")
    assert back.labels == ("LKNE", "C7", "LKNE_2", "RKNE", "knee_l_joint")
    np.testing.assert_allclose(back.positions[:, :4], PLACES / 1000, atol=1e-6)


def test_prefixes_are_of_clusters_where_no_label_comes_twice(tmp_path):
    clusters = tuple(f"{who}:{label}" for who, label in zip(("Head", "Trunk", "Left", "Right"), LABELS, strict=True))
    path = c3d(tmp_path, labels=clusters)
    with pytest.warns(UserWarning, match="Head, Trunk, Left, Right are taken as .* subject_prefix=Head"):
        same(read_markers(path))
    assert marker_subjects(path) == ()
    same(read_markers(path, subject_prefix="Head,Left"), PLACES[:, [0, 2]], ("LFHD", "LKNE"))
    with pytest.raises(MarkerFileError, match="expected the subject 'Eve', found Head, Left, Right, Trunk"):
        read_markers(path, subject_prefix="Head,Eve")
    assert people_of(["Ann:LFHD", "Ann:C7", "box:box1"]) == (("Ann", "box"),)        # a prop is in no marker set
    assert people_of(["Ann:C7", "Bob:C7", "*3"]) == (("Ann",), ("Bob",)) and people_of(["C7"]) == ()


def test_joint_centres_beyond_the_whole_numbers_of_a_file_make_it_a_floating_point_one(tmp_path):
    """Points and analog values stay."""
    analog = RNG.integers(-2000, 2000, (24, 2))
    path = c3d(tmp_path, scale=0.1, analog=analog)
    sequence = read_markers(path)
    found = MarkerArtefacts((), (), sequence.positions, LABELS, sequence, np.ones((12, 4)), sequence.positions,
                            np.tile(np.arange(4), (12, 1)))
    joints = MarkerSequence(np.tile([5.0, 5.1, 4.9], (12, 1, 1)), ("hip_l_joint",), RATE)
    with pytest.warns(UserWarning, match=r"floating-point numbers, its whole ones reach only 3276\.7 mm"):
        write_virtual(tmp_path / "v.c3d", found, path, joints=joints)
    back = read_markers(tmp_path / "v.c3d")
    np.testing.assert_allclose(back.positions[:, :4], sequence.positions, atol=1e-7)
    np.testing.assert_allclose(back.positions[:, 4:], joints.positions)
    data = (tmp_path / "v.c3d").read_bytes()
    table = point_table(path, data)
    rows = np.frombuffer(data[table.start:table.start + 12 * table.width], "<f4").reshape(12, -1)
    np.testing.assert_array_equal(rows[:, 4 * 5:].reshape(24, 2), analog)
    np.testing.assert_array_equal(np.frombuffer(data[12:16], "<f4"), -np.float32(0.1))


def test_rotations_stay_behind_the_points_that_are_added(tmp_path):
    turns = np.arange(17 * 12, dtype="<f4").tobytes()
    data = c3d_bytes(PLACES, LABELS, RATE, more=[("ROTATION", "USED", 1), ("ROTATION", "DATA_START", 0)])
    place = len(data) // BLOCK + 1
    data = c3d_bytes(PLACES, LABELS, RATE, more=[("ROTATION", "USED", 1), ("ROTATION", "DATA_START", place)]) + turns
    out = add_points(tmp_path / "a.c3d", data, ["D1", "D2"], ["", ""], np.ones((12, 2, 3)))
    table = point_table(tmp_path / "a.c3d", out)
    start = rotations_start(file_parameters(out, table.numbers), table.start, len(out))
    assert out[start:] == turns and table.labels == (*LABELS, "D1", "D2")
    (tmp_path / "a.c3d").write_bytes(out)
    np.testing.assert_allclose(read_markers(tmp_path / "a.c3d").positions[:, :4], PLACES / 1000, atol=1e-6)


# units

@pytest.mark.parametrize(("said", "unit"), [
    ("mete", "m"), ("Meter", "m"), ("metres", "m"), ("m.", "m"), ("Millimeters", "mm"), ("mill", "mm"), ("mm", "mm"),
    ("centimetre", "cm"), ("CM", "cm"), ("inch", "in"), ("inches", "in"), ("met", None), ("furlong", None), ("", None)])
def test_units_are_spelled_out_or_cut(said, unit):
    assert unit_named(said) == unit


def test_a_unit_that_is_spelled_out_is_read_and_written_back(tmp_path):
    path = c3d(tmp_path, PLACES / 1000, unit="Meter")
    same(read_markers(path))
    same(read_markers(trc(tmp_path, Units="millimeters")))
    same(read_markers(trc(tmp_path, Units="")))


# TRC

@pytest.mark.parametrize("change", [
    lambda text: "\ufeff" + text,
    lambda text: text.replace("\t", ","),
    lambda text: text.replace("walk.trc", "walk").replace(".", ","),
    lambda text: text.replace("C7\t\t\tLKNE", "C7   LKNE"),
    lambda text: text.replace("X1\tY1\tZ1", "X5\tY5\tZ5"),
    lambda text: text.replace("50.00\t", "  50.0\t\t").replace("12\t4\t", "12\t\t   4\t\t "),
    lambda text: text.replace("\n\n", "\n"),                       # without the empty line
    lambda text: text.replace("\n", "\r\n"),
    lambda text: text.replace("walk.trc", "C:/a,b,c,d,e/walk.trc"),
    lambda text: text.replace("\t", " ").replace("   ", " ")])
def test_a_trc_as_editors_and_spreadsheets_save_it(tmp_path, change):
    same(read_markers(trc(tmp_path, change)))


def test_a_trc_in_utf_16(tmp_path):
    same(read_markers(trc(tmp_path, encoding="utf-16")))


@pytest.mark.parametrize(("header", "says"), [
    ({"NumFrames": "40"}, "NumFrames says 40, there are 12"), ({"NumFrames": "11"}, "NumFrames says 11, there are 12"),
    ({"DataRate": "0"}, "DataRate says 0 .* the times 50"), ({"DataRate": "100"}, "DataRate says 100 .* the times 50"),
    ({"DataRate": ""}, "the times are believed")])
def test_what_the_header_of_a_trc_says_wrongly(tmp_path, header, says):
    with pytest.warns(UserWarning, match=says):
        same(read_markers(trc(tmp_path, **header)))


def test_a_trc_with_another_number_of_markers_or_columns_without_a_name(tmp_path):
    same(read_markers(trc(tmp_path, NumMarkers="8")))
    lines = trc(tmp_path).read_text().splitlines()
    (tmp_path / "walk.trc").write_text("\n".join([*lines[:6], *(line + "\t1\t2\t3" for line in lines[6:])]))
    with pytest.warns(UserWarning, match="1 trajectory without a name left out"):
        same(read_markers(tmp_path / "walk.trc"))


@pytest.mark.parametrize("word", ["-nan(ind)", "1.#QNAN", "NaN", "null", ""])
def test_markers_that_windows_programs_print_as_missing(tmp_path, word):
    lines = trc(tmp_path).read_text().splitlines()
    cells = lines[8].split("\t")
    lines[8] = "\t".join([*cells[:5], word, word, word, *cells[8:]])
    (tmp_path / "walk.trc").write_text("\n".join(lines))
    gap = PLACES.copy()
    gap[2, 1] = np.nan
    same(read_markers(tmp_path / "walk.trc"), gap)


# exports of camera systems

def motive(folder, unit="Meters", kind="Marker"):
    """Beside the markers the solved place of a bone, position and rotation."""
    head = ["Format Version", "1.23", "Take Name", "walk", "Export Frame Rate", "50.0", "Length Units", unit]
    kinds = [*["Bone"] * 3, *[kind] * 12]
    names = ["Hip"] * 3 + [f"Ann:{label}" for label in LABELS for _ in "xyz"]
    rows = [head, [], ["", "Type", *kinds], ["", "Name", *names], ["", "ID", *names],
            ["", "", "Rotation", "Rotation", "Position", *["Position"] * 12],
            ["Frame", "Time (Seconds)", *"XYX", *"XYZ" * 4]]
    for t, frame in enumerate(PLACES / 1000):
        cells = [f"{value:.6f}" for value in frame.ravel()]
        rows.append([str(t), f"{t / RATE:.3f}", "0.1", "0.2", "0.3", *([""] * 3 + cells[3:] if t == 4 else cells)])
    path = folder / "walk.csv"
    path.write_text("\r\n".join(",".join(row) for row in rows) + "\r\n")
    return path


def test_a_csv_of_motive(tmp_path):
    gap = PLACES.copy()
    gap[4, 0] = np.nan
    same(read_markers(motive(tmp_path)), gap)
    same(read_markers(motive(tmp_path, "Centimeters")), 0.01 * gap)
    refused(motive(tmp_path, kind="Bone"), "columns of the type Marker", "export it with the option 'Markers'")


@pytest.mark.parametrize("clock", [False, True])
def test_a_tsv_of_qualisys(tmp_path, clock):
    rows = [["NO_OF_FRAMES", "12"], ["NO_OF_MARKERS", "4"], ["FREQUENCY", "50"], ["DATA_INCLUDED", "3D"],
            ["MARKER_NAMES", *LABELS]]
    if clock:
        rows += [["TRAJECTORY_TYPES", *["Measured"] * 4],
                 ["Frame", "Time", *(f"{label} {axis}" for label in LABELS for axis in "XYZ")]]
    gap = PLACES.copy()
    gap[[0, 3], 0], gap[5] = np.nan, np.nan
    for t, frame in enumerate(gap):
        cells = ["" if np.isnan(value) else f"{value:.3f}" for value in frame.ravel()]
        rows.append([*([str(t + 1), f"{t / RATE:.5f}"] if clock else []), *cells])
    path = tmp_path / "walk.tsv"
    path.write_text("\r\n".join("\t".join(row) for row in rows))
    same(read_markers(path), gap)
    path.write_text(path.read_text().replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D"))
    refused(path, "expected a TSV of 3D data", "found 6D data")


@pytest.mark.parametrize(("name", "words"), [
    ("walk.fbx", ["FBX", "export BVH"]), ("walk.amc", ["ASF/AMC", "BVH"]), ("walk.asf", ["ASF/AMC", "BVH"]),
    ("walk.mvnx", ["Xsens", "rotations", "BVH"]), ("walk.htr", ["HTR", "rotations", "BVH"]), ("walk.qtm", ["C3D"])])
def test_formats_of_others_say_which_export_works(tmp_path, name, words):
    (tmp_path / name).write_bytes(b"...")
    refused(tmp_path / name, *words)


def test_a_table_of_nexus_asks_for_c3d(tmp_path):
    (tmp_path / "walk.csv").write_text("Trajectories\n100\n,,Ann:LFHD,,\nFrame,Sub Frame,X,Y,Z\n1,0,1,2,3\n")
    refused(tmp_path / "walk.csv", "Vicon Nexus", "C3D")
