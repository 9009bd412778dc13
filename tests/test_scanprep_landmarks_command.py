"""`scape prep landmarks`: files that other commands read, what has no data, what failed, and what is done again."""
import csv
import dataclasses
import json

import numpy as np
import pytest
from jointed_bodies import bent, crab
from scan_folders import MARKS, QUICK, ball, write_scans
from test_scanprep_registration_start import BEND

from scanprep import Mesh, read_landmarks, read_mesh, write_landmarks, write_mesh
from scanprep.batch.opening import workspace
from scanprep.cli import group
from scanprep.correspondence.correspondences import Correspondences
from scanprep.geometry.landmarks import landmarks_beside
from scanprep.geometry.rotations import exp
from scanprep.geometry.surface import Surface
from scanprep.pipeline import landmarks
from scanprep.pipeline.landmarks import (
    ScanLandmarks,
    landmark_errors,
    points_on_scan,
    template_and_landmarks,
    write_all,
)
from scanprep.pipeline.scans import find_scans
from scanprep.registration import unmarked
from scanprep.synthetic.landmarks import landmarks as landmarks_of_people
from scanprep.synthetic.people import SyntheticPerson
from scanprep.viewer.clicked import Clicked

NEAR_POSE = dataclasses.replace(QUICK, scan=dataclasses.replace(QUICK.scan, through="pose"))
CLAWS = {"left claw": 5, "back": 400, "right claw": 800}
OFF = 0.02                                    # metres: skin slides on an ellipsoid of 1.8 m


@pytest.fixture(name="template", scope="module")
def ball_template():
    return ball()


@pytest.fixture(name="scans")
def three_scans(tmp_path, template):
    """Three scans, with landmark files that must not be used, as they are wrong."""
    folder = write_scans(tmp_path / "scans", template)
    for path in folder.glob("*.landmarks.json"):
        path.write_text(json.dumps({name: [9, 9, 9] for name in MARKS}))
    return folder


def write_points(scans, template, output, format="json"):
    with workspace(output) as space:
        return write_all(find_scans(scans), template, MARKS, NEAR_POSE, format, space)


def rows_of(output):
    with (output / "landmarks.csv").open() as file:
        return list(csv.DictReader(file))


def value(outcome, name):
    return next(m.value for m in outcome.metrics if m.name == name)


def test_files_of_three_formats_lie_on_the_scans_and_serve_the_next_command(scans, template, tmp_path):
    output = tmp_path / "points"
    for format, ending in (("json", ".landmarks.json"), ("pp", ".pp"), ("csv", ".landmarks.csv")):
        outcome = write_points(scans, template, output, format)
        assert value(outcome, "registered in this run") == (3 if format == "json" else 0)
        files = sorted(path.name for path in output.glob("body*"))
        assert files == [f"body{k}{ending}" for k in range(3)]               # those of the format before are gone
        for task in find_scans(scans, output):
            body, read = read_mesh(task.scan), read_landmarks(task.landmarks)
            assert task.landmarks.name == task.name + ending and list(read) == list(MARKS)
            points = np.array(list(read.values()))
            # the scans have the template's vertices, so the truth is known
            assert np.linalg.norm(points - body.vertices[list(MARKS.values())], axis=1).max() < OFF
            assert Surface(body).closest(points).distances.max() < 1e-5
    rows = rows_of(output)
    assert [(row["scan"], row["landmark"]) for row in rows] == [(f"body{k}", name) for k in range(3) for name in MARKS]
    last = np.array([[float(row[axis]) for axis in "xyz"] for row in rows[-5:]])
    assert np.allclose(last, points, atol=1e-5) and {row["data"] for row in rows} == {"seen"}


def test_a_scan_that_fails_gets_no_file_and_stops_no_other(scans, template, tmp_path):
    output = tmp_path / "points"
    write_points(scans, template, output)
    (scans / "body1.ply").write_bytes((scans / "body1.ply").read_bytes()[:-100])
    outcome = write_points(scans, template, output)
    assert len(outcome.failures) == 1 and "body1.ply" in outcome.failures[0]
    assert outcome.judgement.verdict == "check" and value(outcome, "scans with landmarks") == "2 of 3"
    assert [path.name[:5] for path in sorted(output.glob("body*"))] == ["body0", "body2"]
    assert {row["scan"] for row in rows_of(output)} == {"body0", "body2"}


def test_what_has_no_data_is_guessed_and_stays_out_of_the_files(scans, template, tmp_path):
    """The end of a body is missing in a mesh; a cloud is landmarked on its points."""
    whole = read_mesh(scans / "body0.ply")
    low = whole.vertices[:, 2] < np.quantile(whole.vertices[:, 2], 0.2)
    write_mesh(scans / "body0.ply", Mesh(whole.vertices, whole.faces[~low[whole.faces].any(axis=1)]))
    cloud = read_mesh(scans / "body1.ply").vertices
    (scans / "body1.ply").unlink()
    (scans / "scans.csv").unlink()
    np.savetxt(scans / "body1.xyz", cloud)
    marks = {**MARKS, "lost": int(whole.vertices[:, 2].argmin())}
    with workspace(tmp_path / "points") as space:
        write_all(find_scans(scans), template, marks, NEAR_POSE, "json", space)
    rows = {row["landmark"]: row for row in rows_of(tmp_path / "points") if row["scan"] == "body0"}
    kept = read_landmarks(tmp_path / "points" / "body0.landmarks.json")
    seen = {name for name, row in rows.items() if row["data"] == "seen"}
    assert "lost" not in seen and len(seen) >= 3 and set(kept) == seen and rows["lost"]["data"] == "guessed"
    error = {name: float(row["expected_error_mm"]) for name, row in rows.items()}
    assert error["lost"] > max(error[name] for name in seen)
    on_cloud = np.array(list(read_landmarks(tmp_path / "points" / "body1.landmarks.json").values()))
    assert np.abs(on_cloud[:, None] - cloud).max(axis=2).min(axis=1).max() < 1e-6


def test_the_other_side_of_a_thin_limb_is_no_data(template):
    """A sheet 8 mm thick of which one side was scanned: nothing is written on that side for the other one."""
    flat = ball(3, (0.4, 0.004, 0.9))
    front = flat.vertices[:, 1] < 0
    scan = Mesh(flat.vertices, flat.faces[front[flat.faces].all(axis=1)])
    middle = [int(np.linalg.norm(flat.vertices - [0, y, 0], axis=1).argmin()) for y in (-0.004, 0.004)]
    points, gaps = points_on_scan(scan, flat, np.array(middle))
    assert gaps[0] == 0 and 0.007 < gaps[1] < 0.03                            # it is as far as the other side
    assert np.allclose(points, flat.vertices[middle], atol=1e-9)              # what was not seen stays on the body


def test_expected_errors_grow_with_what_speaks_against_a_landmark():
    names, near = ("Lt. Digit II", "left knee", "scar 3"), np.zeros(3)

    def errors(gaps, size=1.4, verdict="good"):
        return landmark_errors(ScanLandmarks(names, np.zeros((3, 3)), gaps, size), verdict)

    usual = errors(near)
    assert errors(near + 0.02).min() > usual.max() and (errors(near + 0.1) > errors(near + 0.02)).all()
    assert (errors(near, verdict="check") > usual).all()
    assert np.allclose(errors(near + 0.2, 2.8), 2 * errors(near + 0.1))       # a body of double size
    assert 3 * usual[0] < usual[1] == usual[2]                                # a toe is held by its shape, by any name


def test_templates_and_their_landmarks(tmp_path):
    with workspace(tmp_path / "out") as space:
        person, marks = template_and_landmarks(None, space, None)
        assert marks == landmarks_of_people() and np.array_equal(person.vertices, SyntheticPerson().mesh.vertices)
        body = crab(20, 10)
        write_mesh(tmp_path / "crab.ply", body)
        with pytest.raises(ValueError, match=r"crab\.landmarks\.json beside it, or the body of a person.*--template"):
            template_and_landmarks(tmp_path / "crab.ply", space, None)
        write_landmarks(tmp_path / "crab.landmarks.json", {"Lt. Digit II": body.vertices[7], "claw": body.vertices[9]})
        assert template_and_landmarks(tmp_path / "crab.ply", space, None)[1] == {"Lt. Digit II": 7, "claw": 9}


def test_names_of_the_template_stay_and_a_person_gets_what_is_missing(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(landmarks, "landmarks_of_person", lambda body, progress: asked.append(len(body.vertices)) or {
        "left toe": 7, "claw": 9, "navel": 3})
    body = crab(20, 10)
    write_mesh(tmp_path / "crab.ply", body)
    write_landmarks(tmp_path / "crab.landmarks.json", {"Lt. Digit II": body.vertices[7], "claw": body.vertices[9]})
    for _ in range(2):                                                        # a step that is kept
        with workspace(tmp_path / "out") as space:
            marks = template_and_landmarks(tmp_path / "crab.ply", space, None)[1]
        assert list(marks.items()) == [("Lt. Digit II", 7), ("claw", 9), ("navel", 3)]
    assert asked == [len(body.vertices)]


@pytest.fixture(name="crab_files")
def crab_with_a_scan(tmp_path, monkeypatch):
    """A template with landmarks, a scan of it in millimetres, bent and lying, and what leads the one to the other."""
    body = crab(41, 20)
    scan = body.with_vertices(bent(body, *BEND) @ exp(np.array([2.5, 0.4, 1.0])).T)
    write_mesh(tmp_path / "crab.ply", body)
    write_landmarks(tmp_path / "crab.landmarks.json", CLAWS)
    write_mesh(tmp_path / "scan.ply", scan.with_vertices(1000 * scan.vertices))
    some = np.arange(0, len(body.vertices), 12)
    pairs = Correspondences(some, scan.vertices[some], np.ones(len(some)))
    monkeypatch.setattr(unmarked, "find_seeds", lambda *args: pairs)
    monkeypatch.setattr(unmarked, "find_correspondences", lambda *args: pairs)
    return scan


def command(folder, *more):
    return group(["landmarks", str(folder / "scan.ply"), "--template", str(folder / "crab.ply"),
                  "-o", str(folder / "points"), *more])


@pytest.mark.slow
def test_the_command_takes_one_scan_in_any_unit(crab_files, tmp_path):
    """Landmarks come out in the unit of the scan, in the table in metres."""
    assert command(tmp_path, "--format", "csv", "--unit", "mm") == 0
    read = read_landmarks(tmp_path / "points" / "scan.landmarks.csv", unit="mm")
    table = {row["landmark"]: [float(row[axis]) for axis in "xyz"] for row in rows_of(tmp_path / "points")}
    for name, vertex in CLAWS.items():
        assert np.linalg.norm(read[name] - crab_files.vertices[vertex]) < OFF
        assert np.allclose(table[name], read[name], atol=1e-5)
    report = json.loads((tmp_path / "points" / "report.json").read_text())
    assert report["judgement"]["verdict"] in ("good", "check") and not report["failures"]


def test_where_all_scans_fail_nothing_is_written(crab_files, tmp_path, capsys):
    write_mesh(tmp_path / "scan.ply", crab_files.with_vertices(90 * crab_files.vertices))
    assert command(tmp_path, "--unit", "m") == 1
    assert "times as large as the body: the wrong unit? (--unit)" in capsys.readouterr().err
    assert not (tmp_path / "points").exists()


@pytest.mark.parametrize("ending", [".lnd", ".landmarks.txt"])
def test_beside_a_file_that_is_only_read_the_clicks_are_saved_in_a_new_one(scans, ending):
    """The new file is the one that is read from then on, and the old one stays as it is."""
    (scans / "body0.landmarks.json").unlink()
    old = scans / f"body0{ending}"
    old.write_text("0.1 0.2 0.3 nose\n" if ending.endswith("txt") else "1 0 0 224 100 200 300 nose\n")
    for format_ending in (".landmarks.csv", ".landmarks.json"):
        clicked, before = Clicked.load(scans / "body0.ply", format_ending), old.read_bytes()
        assert np.allclose(clicked.places["nose"], [0.1, 0.2, 0.3])
        clicked.places["chin"] = np.zeros(3)
        clicked.save()
        assert landmarks_beside(scans / "body0.ply") == clicked.file == scans / f"body0{format_ending}"
        assert [*read_landmarks(clicked.file)] == ["nose", "chin"] and old.read_bytes() == before
        clicked.file.unlink()
