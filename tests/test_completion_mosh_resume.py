"""`scape mosh` that is killed, called again, called with something changed, and called where others are."""
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mosh_folders import QuietWork, contents, run, write_people

from completion import MarkerLayout, MarkerSequence, read_markers, write_markers
from completion.mocap.mosh import cli
from model import load_model
from scanprep.batch.workspace import HOME

HERE = Path()
BOB = ("people/bob/jump.csv",)


@pytest.fixture(scope="module", autouse=True)
def quiet():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "MoshTask", QuietWork)
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return write_people(tmp_path_factory.mktemp("mosh"))


@pytest.fixture(scope="module")
def whole(place):
    """Bob's recording, undisturbed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert run(HERE, *BOB, "-o", "whole") == 0
    return place / "whole"


@pytest.fixture
def copied(place, whole, tmp_path, monkeypatch):
    """All of that once more, to be changed; the working folder."""
    shutil.copytree(place, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.mark.slow
def test_killed_in_the_middle_of_a_recording_it_goes_on(copied):
    """Killed when the first steps have been kept; then all comes to what an undisturbed call comes to."""
    out, program = copied / "killed", Path(__file__).with_name("mosh_folders.py")
    with subprocess.Popen([sys.executable, program, HERE, *BOB, "-o", "killed"]) as process:
        while process.poll() is None and len([*(out / HOME / "steps").rglob("*.*")]) < 2:
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -9 and {p.name for p in out.iterdir()} <= {HOME, "subjects.csv"}
    assert run(HERE, *BOB, "-o", "killed") == 0
    assert contents(out) == contents(copied / "whole")
    assert not (out / HOME / "making").exists() and not list((out / HOME).rglob(".*"))


def test_what_is_done_is_left_alone(copied):
    def times():
        return {p: p.stat().st_mtime_ns for p in (copied / "whole" / "jump").rglob("*") if p.is_file()}

    before = times()
    assert run(HERE, *BOB, "-o", "whole") == 0
    assert times() == before


@pytest.mark.slow
@pytest.mark.parametrize("what", ["exaggeration", "soft", "poses", "person", "model", "layout", "recording"])
def test_what_depends_on_a_change_is_done_anew(copied, what):
    """It comes to what a first call comes to."""
    settings = {"exaggeration": 1.5, "soft": {"reach": 0.12}, "poses": {"prior_weight": 0.2}, "person": {"shape": 0.4}}
    if what == "model":
        model = load_model(copied / "model.npz")
        model.pose_mean[1] += 0.01
        model.save(copied / "model.npz")
    elif what == "layout":
        layout = MarkerLayout.load(copied / "layout.json")
        MarkerLayout(layout.labels, layout.vertices, 0.013).save(copied / "layout.json")
    elif what == "recording":
        path = copied / "people" / "bob" / "jump.csv"
        markers = read_markers(path)
        positions = markers.positions.copy()
        positions[20, 5] += 0.001
        write_markers(path, MarkerSequence(positions, markers.labels, markers.rate))
    before = contents(copied / "whole")
    for out in ("whole", "fresh"):
        assert run(HERE, *BOB, "-o", out, **{name: value for name, value in settings.items() if name == what}) == 0
    assert before != contents(copied / "whole") == contents(copied / "fresh")


@pytest.mark.slow
def test_two_workers_write_what_one_does(place, tmp_path):
    for count in ("1", "2"):
        assert run(place, place / "people", "-o", tmp_path / count, "--workers", count, soft_tissue=False) == 0
    one = contents(tmp_path / "1")
    assert {"ann/walk/motion.npz", "bob/jump/report.html"} <= set(one) and contents(tmp_path / "2") == one


@pytest.mark.slow
def test_a_recording_less_takes_its_folder_away(place, tmp_path):
    people, out = tmp_path / "people", tmp_path / "out"
    shutil.copytree(place / "people", people)
    shutil.rmtree(people / "bob")
    assert run(place, people, "-o", out, soft_tissue=False) == 0
    (out / "ann" / "walk" / "notes.txt").write_text("mine")
    (people / "ann" / "run.csv").unlink()
    assert run(place, people, "-o", out, soft_tissue=False) == 0
    assert not (out / "ann" / "run").exists() and (out / "ann" / "walk" / "notes.txt").read_text() == "mine"


def test_what_is_not_of_scapekit_stays(copied, capsys):
    out = copied / "whole"
    (out / "jump" / "jump" / "animation.glb").write_bytes(b"mine")
    before = contents(out)
    assert run(HERE, *BOB, "-o", "whole", exaggeration=1.5) == 1
    assert "animation.glb: in the way of the output" in capsys.readouterr().err
    after = contents(out)
    assert {name for name in after if after[name] != before[name]} <= {"report.html", "report.json"}
    assert run(HERE, *BOB, "-o", "people/ann") == 1
    assert "nothing was touched" in capsys.readouterr().err
    assert sorted(p.name for p in (copied / "people" / "ann").iterdir()) == ["run.csv", "walk.csv"]


def test_a_mended_table_is_never_overwritten(copied, capsys):
    out = copied / "whole"
    table = out / "subjects.csv"
    mended = table.read_text().replace(",jump", ",rob")
    table.write_text(mended)
    before = contents(out)
    assert run(HERE, *BOB, "-o", "whole") == 1
    assert "whole/subjects.csv: was mended; go by it with --subjects whole/subjects.csv" in capsys.readouterr().err
    assert contents(out) == before
    assert run(HERE, *BOB, "-o", "whole", "--subjects", table, soft_tissue=False) == 0
    assert table.read_text() == mended and (out / "rob" / "jump" / "motion.npz").exists()
