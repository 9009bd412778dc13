"""Force plates of C3D files: a known force at a known place comes out of every type of plate, number and processor."""
import warnings

import numpy as np
import pytest
from c3d_bytes import c3d_bytes

from completion.mocap.files.c3d import file_parameters, point_table, read_analog
from completion.mocap.files.force_plates import plate_axes, read_ground_reactions, write_ground_reactions
from completion.mocap.files.markers import MarkerFileError, read_markers

# z is up in the room; columns x, y (up) and z of the ground
GROUND = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
T, SAMPLES = 4, 3
# the plate: mm, its x along y of the room, its y along x, its z down
CORNERS = np.array([[880.0, 580, 5], [880, 0, 5], [0, 0, 5], [0, 580, 5]])
AXES, CENTRE = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]).T, np.array([440.0, 290, 5])
ORIGINS = {1: (0.0, 0, 0), 2: (3.0, -2, -30), 3: (210.0, 260, -40), 4: (3.0, -2, -30)}
# the ground pushes a person up, a bit aside, and turns him: N, mm, Nmm
FORCE, POINT, TURN = np.array([30.0, -20, 700]), np.array([500.0, 200, 5]), np.array([0.0, 0, 2500])
CROSS_TALK = np.eye(6) + 0.01 * np.random.default_rng(0).normal(size=(6, 6))


def channels(kind, force=FORCE):
    """The signals (C,) of a plate on which a force acts at POINT: from the moments about its transducers, N and Nmm."""
    f, p, turn = force @ AXES, (POINT - CENTRE) @ AXES, TURN @ AXES
    if kind == 1:
        return np.array([*f, *p[:2], turn[2]])
    if kind == 3:
        # forces (4, 3) of sensors in the corners, 1 and 2 ahead, 1 and 4 to the right, which do the same as the load
        a, b, height = 210, 260, 40
        sensors = np.array([[a, b, height], [-a, b, height], [-a, -b, height], [a, -b, height]])
        effects = np.concatenate([np.concatenate([np.eye(3), np.stack([np.cross(at, way) for way in np.eye(3)], 1)])
                                  for at in sensors], axis=1)
        s = np.linalg.lstsq(effects, np.r_[f, np.cross(p, f) + turn], rcond=None)[0].reshape(4, 3)
        return np.array([s[0, 0] + s[1, 0], s[2, 0] + s[3, 0], s[0, 1] + s[3, 1], s[1, 1] + s[2, 1], *s[:, 2]])
    wrench = np.r_[f, np.cross(p + ORIGINS[2], f) + turn]    # the origin is from the transducer to the centre
    return np.linalg.solve(CROSS_TALK, wrench) if kind == 4 else wrench


def plate(kind=2, corners=CORNERS, first=1, count=1, **more):
    """Parameters of `count` plates that are alike."""
    width = 8 if kind == 3 else 6
    values = {"USED": count, "TYPE": np.full(count, kind), "ZERO": np.zeros(2, int),
              "CORNERS": np.tile(corners, (count, 1, 1)), "ORIGIN": np.tile(ORIGINS.get(kind, (0.0, 0, 0)), (count, 1)),
              "CHANNEL": np.tile(np.arange(first, first + width), (count, 1)),
              "CAL_MATRIX": np.tile(CROSS_TALK.T, (count, 1, 1)), **more}
    return [("FORCE_PLATFORM", name, value) for name, value in values.items()]


def write(path, analog, more, scale=-1.0, processor=84, L=1):
    places = np.full((T, L, 3), 100.0)
    path.write_bytes(c3d_bytes(places, ["C7", "T10"][:L], scale=scale, analog=analog, more=more, processor=processor))
    return path


def steady(kind, force=FORCE, sign=1.0):
    return np.tile(sign * channels(kind, force) if kind != 1 else
                   channels(kind, force) * np.where([1, 1, 1, 0, 0, 1], sign, 1), (T * SAMPLES, 1))


def read(path, **more):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_ground_reactions(path, GROUND, 100.0, **more)
    return found, [str(note.message) for note in caught]


def check(found, p=0, force=FORCE, when=slice(None), tolerance=1e-4):
    np.testing.assert_allclose(found.forces[when, p], np.tile(force @ GROUND, (len(found.forces[when]), 1)),
                               atol=700 * tolerance)
    np.testing.assert_allclose(found.points[when, p] - POINT / 1000 @ GROUND, 0, atol=tolerance)
    np.testing.assert_allclose(found.moments[when, p] - TURN / 1000 @ GROUND, 0, atol=10 * tolerance)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("kind", [1, 2, 3, 4])
def test_a_known_load_comes_back_from_every_type_whichever_way_it_is_stored(tmp_path, kind, sign):
    found, notes = read(write(tmp_path / "a.c3d", steady(kind, sign=sign), plate(kind)))
    assert not notes and found.plates == (1,) and found.rate == 300 and found.times[-1] == pytest.approx(11 / 300)
    check(found)
    assert found.forces[0, 0, 1] > 0                          # the ground pushes up


@pytest.mark.parametrize("kind", [1, 2, 3, 4])
def test_ezc3d_finds_the_same(tmp_path, kind):
    ezc3d = pytest.importorskip("ezc3d")
    signals = steady(kind) + np.random.default_rng(1).normal(size=(T * SAMPLES, 1))
    tree, C = ezc3d.c3d(), signals.shape[1]
    own, point, analog = (tree["parameters"][group] for group in ("FORCE_PLATFORM", "POINT", "ANALOG"))
    point["RATE"]["value"], point["UNITS"]["value"], point["LABELS"]["value"] = [100.0], ["mm"], ("C7",)
    analog["RATE"]["value"], analog["LABELS"]["value"] = [300.0], tuple(f"c{i}" for i in range(C))
    tree["data"]["points"], tree["data"]["analogs"] = np.ones((4, 1, T)), signals.T[None]
    for name, value in (("USED", [1]), ("TYPE", [kind]), ("ZERO", [0, 0]), ("CHANNEL", np.arange(1, C + 1)[:, None])):
        own[name]["value"] = value
    for name, value in (("CORNERS", CORNERS.T[..., None]), ("ORIGIN", np.array(ORIGINS[kind])[:, None]),
                        ("CAL_MATRIX", CROSS_TALK[..., None])):
        tree.add_parameter("FORCE_PLATFORM", name, value)
    if kind == 3:                        # the maker's correction of the centre of pressure, here up to 8 mm
        powers = np.array([[1e-16, 1e-12, 1e-8, 1e-13, 1e-8, 0.02], [1e-16, -1e-12, 2e-8, 1e-13, 1e-8, -0.05]])
        tree.add_parameter("FORCE_PLATFORM", "FPCOPPOLY", powers.T[..., None])
    path = tmp_path / "a.c3d"
    tree.write(str(path))
    theirs, (found, _) = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"][0], read(path)
    np.testing.assert_allclose(found.forces[:, 0], theirs["force"].T @ GROUND, atol=1e-3)
    np.testing.assert_allclose(found.points[:, 0], theirs["center_of_pressure"].T @ GROUND / 1000, atol=1e-6)
    np.testing.assert_allclose(found.moments[:, 0, 1], theirs["Tz"][2] / 1000, atol=1e-4)       # ours are vertical
    assert np.allclose(found.points[0, 0], POINT / 1000 @ GROUND, atol=1e-3) == (kind != 3)


def test_a_matrix_may_be_stored_by_rows(tmp_path):
    more = [*plate(4, CAL_MATRIX=CROSS_TALK[None]), ("FORCE_PLATFORM", "MATRIX_STORE", ["BYROW"])]
    check(read(write(tmp_path / "a.c3d", steady(4), more))[0])


@pytest.mark.parametrize("origin", [np.array([[3.0, -2, -30]]), np.array([[-3.0, 2, 30]])])
def test_an_origin_is_read_in_both_directions(tmp_path, origin):
    check(read(write(tmp_path / "a.c3d", steady(2), plate(ORIGIN=origin)))[0])


def test_moments_have_the_unit_that_the_channels_say_and_lengths_that_of_the_points(tmp_path):
    metres = steady(2) * [1, 1, 1, 1e-3, 1e-3, 1e-3]
    more = [*plate(), ("ANALOG", "UNITS", ["N"] * 3 + ["N.m"] * 3)]
    check(read(write(tmp_path / "a.c3d", metres, more))[0])
    more = [*plate(corners=CORNERS / 1000, ORIGIN=np.array([ORIGINS[2]]) / 1000), ("POINT", "UNITS", ["m"])]
    check(read(write(tmp_path / "b.c3d", metres, more))[0])
    more[-1] = ("POINT", "UNITS", ["mm"])                     # a wrong unit, put right by the user
    check(read(write(tmp_path / "c.c3d", metres, more), unit="m")[0])


@pytest.mark.parametrize("processor", [84, 85, 86])
@pytest.mark.parametrize("scale, unsigned", [(-1.0, False), (0.1, False), (0.1, True)])
def test_numbers_of_every_kind_and_processor(tmp_path, processor, scale, unsigned):
    offset = np.array([32768, 40000] * 3) if unsigned else np.array([0, 7, -5, 100, 0, 3])
    factor, general = np.array([0.01, 0.01, 0.1, 10, 10, 1]), 0.5
    stored = steady(2) / (factor * general) + offset
    raw = stored if scale < 0 else np.where(stored > 32767, stored - 65536, stored)
    more = [*plate(), ("ANALOG", "SCALE", factor), ("ANALOG", "OFFSET", offset.astype(np.uint16).view(np.int16)),
            ("ANALOG", "GEN_SCALE", general), ("ANALOG", "FORMAT", ["UNSIGNED" if unsigned else "SIGNED"])]
    path = write(tmp_path / "a.c3d", raw, more, scale, processor, L=2)
    check(read(path)[0], tolerance=1e-2)
    some = read_analog(path, path.read_bytes(), [5, 2])
    np.testing.assert_allclose(some, steady(2)[:, [5, 2]], atol=3)


def test_the_zero_level_is_taken_off_but_not_the_weight_of_a_person(tmp_path):
    signals = steady(2) + [8.0, -5, 20, 900, -900, 400]
    signals[:2 * SAMPLES] -= steady(2)[0]                     # nobody is on the plate in frames 1 and 2
    found, notes = read(write(tmp_path / "a.c3d", signals, plate(ZERO=np.array([1, 2]))))
    assert not notes and not found.forces[:6].any() and not found.points[:6].any() and not found.moments[:6].any()
    check(found, when=slice(6, None))
    cut = [("TRIAL", "ACTUAL_START_FIELD", np.array([3, 0])), *plate(ZERO=np.array([3, 4]))]
    check(read(write(tmp_path / "b.c3d", signals, cut))[0], when=slice(6, None))         # the file begins in frame 3
    found, notes = read(write(tmp_path / "c.c3d", steady(2), plate(ZERO=np.array([1, 2]))))
    check(found)
    assert "loaded in frames 1 to 2, which ZERO calls empty" in notes[0] and found.notes[0] in notes[0]


@pytest.mark.parametrize("load, on", [(10.5, True), (9.5, False)])
def test_below_ten_newtons_all_is_zero(tmp_path, load, on):
    found, _ = read(write(tmp_path / "a.c3d", steady(2, FORCE * load / 700), plate()))
    assert found.forces.any() == on and found.points.any() == on and found.moments.any() == on


SKEW = CORNERS + [[0, 0, 0], [300, 0, 0], [300, 0, 0], [0, 0, 0]]
BAD = {"nan": (plate(corners=CORNERS * np.nan), "no rectangle"), "zero": (plate(corners=0 * CORNERS), "no rectangle"),
       "skew": (plate(corners=SKEW), "no rectangle"), "huge": (plate(corners=1e6 * CORNERS), "no rectangle"),
       "three corners": (plate(CORNERS=CORNERS[None, :3]), "expected 4 corners of 3 coordinates, found 9 numbers"),
       "upside down": (plate(corners=CORNERS[[1, 0, 3, 2]]), "the other way round"),
       "channels": (plate(first=40), "expected analog channels up to 45, found 6"),
       "few channels": (plate(CHANNEL=np.arange(1, 5)[None]), "expected 6 channels, found 4"),
       "no origin": (plate(ORIGIN=np.zeros((1, 2))), "expected an origin of 3 numbers"),
       "type": (plate(kind=7), "expected a type of 1, 2, 3, 4, found 7"),
       "no matrix": (plate(kind=4, CAL_MATRIX=np.zeros(3)), "needs CAL_MATRIX"),
       "no numbers": ([*plate(), ("ANALOG", "SCALE", np.full(6, np.nan))], "hold values that are no numbers"),
       "no types": (plate(TYPE=np.zeros(0, int)), "names 1 plates, and the types of 0")}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_plate_is_a_sentence(tmp_path, name):
    more, words = BAD[name]
    found, notes = read(write(tmp_path / "a.c3d", steady(2), more))
    assert found is None and len(notes) == 1 and words in notes[0] and notes[0].startswith("a.c3d: ")


def test_numbers_of_plates_that_are_none_are_an_error(tmp_path):
    for name, more in (("TYPE", plate(TYPE=["II"])), ("USED", plate(USED=np.array([np.nan])))):
        with pytest.raises(MarkerFileError, match="FORCE_PLATFORM, USED and TYPE: expected whole numbers"):
            read(write(tmp_path / f"{name}.c3d", steady(2), more))


def test_a_bad_plate_leaves_the_good_one_its_number(tmp_path):
    more = plate(count=2, CORNERS=np.stack([0 * CORNERS, CORNERS]))
    found, notes = read(write(tmp_path / "a.c3d", steady(2), more))
    assert found.plates == (2,) and "force plate 1 is left out" in notes[0]
    check(found)


def test_files_without_plates_or_markers(tmp_path):
    assert read(write(tmp_path / "a.c3d", steady(2), ())) == (None, [])
    with pytest.raises(MarkerFileError, match="expected points, the C3D file holds 0 points"):
        read_markers(write(tmp_path / "b.c3d", steady(2), plate(), L=0))


def test_corners_of_a_measured_plate_may_be_a_bit_off():
    axes, centre = plate_axes((CORNERS + np.random.default_rng(2).normal(0, 2, (4, 3))).ravel() / 1000)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes, AXES, atol=0.02)
    np.testing.assert_allclose(centre, CENTRE / 1000, atol=0.003)


def test_the_file_for_opensim(tmp_path):
    found, _ = read(write(tmp_path / "a.c3d", steady(2), plate(count=2)))
    write_ground_reactions(tmp_path / "grf.mot", found)
    head, table = (tmp_path / "grf.mot").read_text().split("endheader\n")
    names, *rows = [line.split("\t") for line in table.splitlines()]
    assert {"nRows=12", "nColumns=19", "inDegrees=yes"} <= set(head.splitlines())
    told = dict(zip(names, np.array(rows, float)[1], strict=True))
    wanted = [("ground_force_1_v", FORCE @ GROUND), ("ground_force_1_p", POINT @ GROUND / 1000),
              ("ground_torque_1_", TURN @ GROUND / 1000)]
    assert names[1:4] == ["ground_force_1_vx", "ground_force_1_vy", "ground_force_1_vz"] and told["time"] > 0.0033
    for name, values in wanted:
        assert [told[f"{name}{axis}"] for axis in "xyz"] == pytest.approx(values.tolist(), abs=1e-4)
        assert told[f"{name.replace('1', '2')}y"] == told[f"{name}y"]
    assert {"ground_force_1_px", "ground_torque_1_x"} <= set(names)


def test_channels_beyond_255_have_their_scales_in_a_second_list(tmp_path):
    analog = np.arange(1.0, 258)[None] * np.ones((T, 1))
    more = [("ANALOG", "SCALE", np.ones(255)), ("ANALOG", "SCALE2", np.array([2.0, 3.0]))]
    path = write(tmp_path / "a.c3d", analog, more)
    data = path.read_bytes()
    assert read_analog(path, data, [0, 255, 256])[0].tolist() == [1, 512, 771]
    assert ("ANALOG", "SCALE2") in file_parameters(data, point_table(path, data).numbers)
