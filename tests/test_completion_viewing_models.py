"""`scape view`: bodies behind sliders, in Python and in a real browser, and what is saved."""
import numpy as np
import pytest
from browser import opened, wait_until
from completion_bodies import worm_with_prior
from viewing_apps import OPEN, PART, app_of, ask, expected, seen, write_files

from completion.motion import Motion
from completion.viewing.movable import MovableBody
from completion.viewing.saving import free_name
from model.files import load_model
from scanprep import read_mesh


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def files(tmp_path_factory, model):
    return write_files(tmp_path_factory.mktemp("view"), model)


def test_a_movable_body_is_the_model(model):
    body, rng = MovableBody(model), np.random.default_rng(0)
    betas, pose = np.zeros(3), np.zeros((4, 3))
    for step in range(80):
        what = step % 4
        if what == 0:
            betas = betas.copy()
            betas[rng.integers(3)] = 2 * rng.normal()
        elif what == 1:
            pose = rng.normal(0, 0.5, (4, 3))
        elif what == 2 and step % 5 == 0:
            betas = rng.normal(size=3)
        y = body.vertices(betas, pose) + body.origin
        assert np.abs(y - model.vertices(pose, betas)).max() < 3e-6


def test_what_is_saved_is_never_written_over(files, tmp_path, model):
    app = app_of(files, "worm.npz", output=tmp_path)
    ask(app, "beta", index=1, value=1.5)
    ask(app, "turn", part=PART, turn=[0.2, 0.1, 0])
    for _ in range(2):
        ask(app, "save_body")
        ask(app, "save_pose")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["worm_body.ply", "worm_body_2.ply", "worm_pose.npz", "worm_pose_2.npz"]
    assert np.allclose(read_mesh(tmp_path / "worm_body.ply", "m").vertices, expected(app, model), atol=1e-12)
    saved = Motion.load(tmp_path / "worm_pose.npz")
    assert np.allclose(saved.poses[0, 3], [0.2, 0.1, 0]) and np.allclose(saved.betas, [0, 1.5, 0])
    assert free_name(tmp_path / "new.ply") == tmp_path / "new.ply"


def test_wrong_messages_are_refused(files):
    app = app_of(files, "worm.npz")
    for kind, fields in (("beta", {"index": 7, "value": 1}), ("beta", {"index": 0, "value": 1e9}),
                         ("turn", {"part": "wing", "turn": [0, 0, 0]}), ("turn", {"part": PART, "turn": [1, 2]}),
                         ("nonsense", {})):
        with pytest.raises((ValueError, TypeError)):
            ask(app, kind, **fields)


@pytest.mark.slow
def test_sliders_move_the_body_to_what_the_model_says(files, new_page, model):
    app = app_of(files, "worm.npz")
    with opened(new_page, app, OPEN) as page:
        wait_until(page, "program.sliders?.length === 3")
        slider = page.get_by_label("shape 1", exact=True)
        slider.focus()
        for _ in range(6):
            page.keyboard.press("ArrowRight")
        wait_until(page, "program.betas[0] > 0.29")
        page.get_by_label("part", exact=True).select_option(PART)
        wait_until(page, f"program.chosen === {PART!r}")
        page.get_by_label("turn about y").focus()
        for _ in range(20):
            page.keyboard.press("ArrowRight")
        wait_until(page, f"program.turns[{PART!r}][1] > 0.34")
        page.wait_for_timeout(200)
        assert app.controls.betas[0] == pytest.approx(0.3)
        assert app.controls.turns[PART][1] == pytest.approx(np.radians(20))
        assert np.abs(seen(page) - expected(app, model)).max() < 1e-5
        page.reload()                                     # the state is Python's
        wait_until(page, OPEN, 20)
        wait_until(page, "program.betas?.[0] > 0.29")
        page.wait_for_timeout(200)
        assert np.abs(seen(page) - expected(app, model)).max() < 1e-5
        page.get_by_role("button", name="reset").click()
        wait_until(page, f"program.betas[0] === 0 && !program.turns[{PART!r}].some(Boolean)")
        page.wait_for_timeout(100)
        assert np.abs(seen(page) - expected(app, model)).max() < 1e-5


@pytest.mark.slow
def test_two_models_share_their_sliders(files, new_page, model):
    app = app_of(files, "worm.npz", "short.npz")
    short = load_model(files / "short.npz")
    with opened(new_page, app, OPEN) as page:
        wait_until(page, "program.figure.panes.length === 2 && program.sliders?.length === 3")
        page.evaluate("program.send('beta', {index: 0, value: 1.25})")
        page.evaluate(f"program.send('turn', {{part: {PART!r}, turn: [0, 0.4, 0]}})")
        wait_until(page, f"program.turns[{PART!r}][1] === 0.4")
        page.wait_for_timeout(200)
        assert np.abs(seen(page) - expected(app, model)).max() < 1e-5
        assert np.abs(seen(page, 1) - expected(app, short)).max() < 1e-5
        page.get_by_role("button", name="only").nth(1).click()
        wait_until(page, "program.figure.panes.length === 1 && program.sliders?.length === 1")
        page.wait_for_timeout(200)
        assert np.abs(seen(page) - expected(app, short)).max() < 1e-5


@pytest.mark.slow
def test_laid_over_each_other_each_can_be_hidden(files, new_page):
    app = app_of(files, "body.ply", "worm.npz", over=True)
    with opened(new_page, app, OPEN) as page:
        assert page.evaluate("program.figure.panes.length") == 1
        page.get_by_label("worm.npz", exact=True).last.uncheck()
        assert not page.evaluate("program.figure.layers[2].object.visible")
        page.evaluate("program.send('beta', {index: 0, value: 1})")
        wait_until(page, "program.betas[0] === 1")
        page.wait_for_timeout(150)
        one = app.controls.shown[0]
        assert (one.pane, one.layer) == (0, 2)
        assert np.abs(seen(page, 0, 2) - expected(app, one.body.model)).max() < 1e-5
