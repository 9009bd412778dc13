"""`scape view`: bodies behind sliders, in Python and in a real browser, poses by dragging, what is saved."""
import numpy as np
import pytest
from browser import wait_until
from completion_bodies import worm_with_prior
from model_bodies import worm_model
from viewing_apps import PART, app_of, ask, expected, on_screen, open_app, seen, write_files

from completion.motion import Motion
from completion.viewing.dragging import Drag
from completion.viewing.movable import FEW, MovableBody
from completion.viewing.saving import free_name
from model.files import load_model
from scanprep import read_mesh
from scanprep.skeleton.roles import in_words
from scanprep.viewer.server import Server


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
        trans = rng.normal(size=3)
        y = body.vertices(betas, pose, trans) + body.origin
        assert np.abs(y - model.vertices(pose, betas, trans)).max() < 3e-6


def test_moving_one_slider_makes_one_difference(model, monkeypatch):
    body, pose, made = MovableBody(model), np.zeros((4, 3)), []
    real = type(model).operator
    monkeypatch.setattr(type(model), "operator", lambda self, betas=None: made.append(betas) or real(self, betas))
    for value in np.linspace(-2, 2, 9):
        body.vertices(np.array([value, 0, 0]), pose)
    assert len(made) == 2                                # of one standard deviation, and of the mean
    body.vertices(np.array([1.0, 0, 0]), pose + 0.1)
    assert len(made) == 2


def test_a_body_with_many_other_betas_is_made_again():
    model = worm_model(components=FEW + 2)
    body, pose = MovableBody(model), np.full((4, 3), 0.1)
    betas = np.arange(1.0, FEW + 3)
    for k in range(1, len(betas) + 1):
        shown = np.where(np.arange(len(betas)) < k, betas, 0)
        body.vertices(shown, np.zeros((4, 3)))
    y = body.vertices(betas, pose) + body.origin         # all differences are known: the basis gets these betas
    assert np.abs(y - model.vertices(pose, betas)).max() < 5e-6
    assert np.array_equal(body.betas, betas)


def test_models_that_name_their_parts_otherwise_share_them():
    assert [in_words(name) for name in ("hand_left", "l_hand", "upper_arm_right", "r_upper_arm", "chest", "part3")
            ] == ["left hand"] * 2 + ["right upper arm"] * 2 + ["chest", "part3"]


def test_a_model_without_betas_is_its_own_body(model):
    alone = worm_model(components=0)
    body = MovableBody(alone)
    assert np.abs(body.vertices(None, np.zeros((4, 3))) + body.origin - alone.template.vertices).max() < 1e-5


def test_a_dragged_vertex_follows_the_hand_and_the_rest_stays(model):
    body, pose, trans = MovableBody(model), np.zeros((4, 3)), np.zeros(3)
    vertex = int(np.flatnonzero(body.part_of_vertex == 3)[-1])
    drag = Drag(body, vertex, np.zeros(3), pose)
    start = drag.operator.evaluate(pose, trans)[0]
    target = start + [-0.05, 0.25, 0.1]
    for _ in range(4):
        pose, trans = drag.drag_to(pose, trans, target)
    assert np.linalg.norm(drag.operator.evaluate(pose, trans)[0] - target) < 0.01
    assert not pose[[0, 1]].any() and not trans.any()    # only the chain from the trunk turns
    for _ in range(30):
        pose, trans = drag.drag_to(pose, trans, np.array([50.0, -30, 20]))
    assert np.isfinite(pose).all() and np.linalg.norm(pose, axis=1).max() <= np.pi + 1e-9


def test_the_trunk_moves_as_a_whole(model):
    body, pose = MovableBody(model), np.zeros((4, 3))
    vertex = int(np.flatnonzero(body.part_of_vertex == 0)[0])
    drag = Drag(body, vertex, np.zeros(3), pose)
    turned, trans = drag.drag_to(pose, np.zeros(3), drag.operator.evaluate(pose)[0] + [0.1, 0.2, 0])
    assert not turned.any() and np.allclose(trans, [0.1, 0.2, 0])


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
                         ("grab", {"pane": 3, "layer": 0, "vertex": 0}), ("nonsense", {}),
                         ("touch", {"pane": 0, "layer": 0, "vertex": 10**7}), ("drag", {"target": [0, None, 0]})):
        with pytest.raises((ValueError, TypeError)):
            ask(app, kind, **fields)


def test_random_bodies_and_poses_are_as_the_model_says(files, model):
    app = app_of(files, "worm.npz")
    drawn = []
    for _ in range(300):
        app.controls.random_body()
        drawn.append(app.controls.betas)
    assert np.abs(np.mean(drawn, axis=0)).max() < 0.25 and np.abs(np.std(drawn, axis=0) - 1).max() < 0.2
    ask(app, "random_pose")
    assert not app.controls.turns[model.skeleton.names[0]].any() and app.controls.turns[PART].any()
    ask(app, "reset")
    assert not any(turn.any() for turn in app.controls.turns.values()) and not app.controls.betas.any()


@pytest.mark.slow
def test_sliders_move_the_body_to_what_the_model_says(files, page, model):
    app = app_of(files, "worm.npz")
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
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
        page.get_by_role("button", name="random body").click()
        wait_until(page, "Math.abs(program.betas[1]) > 0")
        page.wait_for_timeout(100)
        assert np.abs(seen(page) - expected(app, model)).max() < 1e-5
        page.reload()                                     # the state is Python's
        open_app(page, server)
        wait_until(page, "Math.abs(program.betas?.[1]) > 0")
        page.wait_for_timeout(200)
        assert np.abs(seen(page) - expected(app, model)).max() < 1e-5
    assert not [error for error in page.errors if "ERR_CONNECTION" not in error]


@pytest.mark.slow
def test_two_models_share_their_sliders(files, page, model):
    app = app_of(files, "worm.npz", "short.npz")
    short = load_model(files / "short.npz")
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
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
    assert not [error for error in page.errors if "ERR_CONNECTION" not in error]


@pytest.mark.slow
def test_a_part_is_dragged_to_where_the_hand_is(files, page):
    app = app_of(files, "worm.npz")
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
        wait_until(page, "program.shownModels?.length === 1")
        page.get_by_label("drag a part").check()
        body = app.controls.shown[0].body
        vertex = int(np.flatnonzero(body.part_of_vertex == 3)[30])
        at = on_screen(page, seen(page)[vertex])
        page.mouse.move(*at)
        page.mouse.down()
        for step in range(1, 9):
            page.mouse.move(at[0] + 8 * step, at[1])
            page.wait_for_timeout(40)
        wait_until(page, f"program.turns[{PART!r}].some((x) => Math.abs(x) > 0.02)")
        page.wait_for_timeout(300)
        one, held = app.controls.held
        before, now = (held.operator.evaluate(pose, app.controls.trans)[0]
                       for pose in (np.zeros((4, 3)), app.controls.pose_of(one.body)))
        moved = on_screen(page, now)
        page.mouse.up()
        assert np.linalg.norm(now - before) > 0.02
        assert abs(moved[0] - (at[0] + 64)) < 8 and abs(moved[1] - at[1]) < 8           # pixels from the hand
        assert page.evaluate("program.figure.panes[0].controls.enabled")
    assert not [error for error in page.errors if "ERR_CONNECTION" not in error]


def test_the_page_fits_a_telephone(files, new_page):
    app = app_of(files, "worm.npz", "body.ply")
    with Server(app, say=lambda line: None) as server:
        page = new_page(viewport={"width": 420, "height": 800}, color_scheme="dark")
        open_app(page, server)
        wait_until(page, "program.sliders?.length === 3")
        assert page.evaluate("document.documentElement.scrollWidth") <= 420
        assert page.evaluate("program.figure.panes.every((pane) => pane.canvas.clientHeight > 150)")
        bodies, panel = (page.evaluate(f"document.querySelector('{one}').getBoundingClientRect().top")
                         for one in (".sk-view", ".sk-panel"))
        assert bodies < panel


@pytest.mark.slow
def test_laid_over_each_other_each_can_be_hidden(files, page):
    app = app_of(files, "body.ply", "worm.npz", over=True)
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
        assert page.evaluate("program.figure.panes.length") == 1
        page.get_by_label("worm.npz", exact=True).last.uncheck()
        assert not page.evaluate("program.figure.layers[2].object.visible")
        page.evaluate("program.send('beta', {index: 0, value: 1})")
        wait_until(page, "program.betas[0] === 1")
        page.wait_for_timeout(150)
        one = app.controls.shown[0]
        assert (one.pane, one.layer) == (0, 2)
        assert np.abs(seen(page, 0, 2) - expected(app, one.body.model)).max() < 1e-5
