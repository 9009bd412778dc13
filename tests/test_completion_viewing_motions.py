"""`scape view`: motions and recordings of markers, and how they play."""
import numpy as np
import pytest
from browser import opened, wait_until
from completion_bodies import worm_with_prior
from model_bodies import worm_model
from viewing_apps import OPEN, a_motion, app_of, seen, write_files

from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.motion import Motion
from completion.viewing.files import Files


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def files(tmp_path_factory, model):
    return write_files(tmp_path_factory.mktemp("view"), model)


def test_a_motion_wants_its_model(files, tmp_path):
    with pytest.raises(ValueError, match=r"wave.npz: a motion needs its model; name it with -m"):
        app_of(files, "wave.npz")
    assert app_of(files, "wave.npz", "worm.npz").shown == [0, 1]          # there it is
    small = worm_model(components=1)
    small.save(tmp_path / "small.npz")
    with pytest.raises(ValueError, match="at most the 1 betas"):
        app_of(files, "wave.npz", model=tmp_path / "small.npz")


@pytest.mark.slow
def test_a_recording_laid_over_its_motion_tells_residuals(files, tmp_path, model, new_page):
    motion = a_motion(12, ("A", "B", "C"))
    motion.save(tmp_path / "walk.npz")
    subject = model.subject(motion.betas)
    positions = motion.vertices(subject)[:, [10, 100, 300]] + 0.004
    positions[3, 1] = np.nan
    write_markers(tmp_path / "walk.csv", MarkerSequence(positions, ("A", "B", "C"), motion.rate))
    app = app_of(tmp_path, "walk.npz", "walk.csv", over=True, model=files / "worm.npz")
    assert app.shown == [0] and len(app.contents[0].shapes) == 2
    told = next(message for message in app.greet() if message.kind == "residuals")
    assert [told.fields[name] for name in ("pane", "layer", "labels")] == [0, 1, ("A", "B", "C")]
    assert np.allclose(np.frombuffer(told.data, "<f4"), 0.004)
    with opened(new_page, app, OPEN) as page:
        wait_until(page, "program.markers.length === 1")
        assert "distance of markers" in page.locator(".sk-legend").inner_text()
        shade = "program.figure.panes[0].layers[1].valueAt"
        assert page.evaluate(f"{shade}(0)") == "4.02 mm"                     # in 254 steps up to 30 mm
        here = "program.figure.panes[0].controls.target.x"
        before, _ = page.evaluate(here), page.evaluate("program.figure.go(11)")
        assert page.evaluate(here) - before == pytest.approx(2 * np.pi, abs=0.1)        # the view goes along
        page.get_by_label("follow").uncheck()
        before, _ = page.evaluate(here), page.evaluate("program.figure.go(0)")
        assert page.evaluate(here) == before


@pytest.mark.slow
def test_a_motion_plays(files, new_page, model):
    app = app_of(files, "wave.npz", model=files / "worm.npz")
    motion = Motion.load(files / "wave.npz")
    bodies = motion.vertices(model.subject(motion.betas))
    with opened(new_page, app, OPEN) as page:
        page.evaluate("program.figure.go(25)")
        assert np.abs(seen(page) - bodies[25]).max() < 2e-3
        page.keyboard.press("Space")
        wait_until(page, "program.figure.playing && program.figure.frame !== 25")
        page.keyboard.press("Space")
        wait_until(page, "!program.figure.playing")
        frame = page.evaluate("program.figure.frameOf(program.figure.panes[0].layers[0])")
        assert np.abs(seen(page) - bodies[frame]).max() < 2e-3


def test_motions_and_recordings_play_at_the_rate_that_is_said(files, tmp_path):
    write_markers(tmp_path / "walk.csv", MarkerSequence(np.ones((3, 3, 3)), ("A", "B", "C"), 50.0))
    known = Files((files / "wave.npz", tmp_path / "walk.csv"), files / "worm.npz", rate=20.0)
    assert [entry.load().shapes[0].rate for entry in known.entries()] == [20.0, 20.0]


def test_a_recording_at_another_rate_keeps_the_time(files, tmp_path, new_page, model):
    motion = a_motion(40)
    subject = model.subject(motion.betas)
    positions = motion.vertices(subject)[:, [10, 100, 300]]
    write_markers(tmp_path / "slow.csv", MarkerSequence(positions[::2], ("A", "B", "C"), motion.rate / 2))
    motion.save(tmp_path / "walk.npz")
    app = app_of(tmp_path, "walk.npz", "slow.csv", model=files / "worm.npz")
    with opened(new_page, app, OPEN) as page:
        page.evaluate("program.figure.go(20)")
        assert np.abs(seen(page, 1) - positions[20]).max() < 2e-3
