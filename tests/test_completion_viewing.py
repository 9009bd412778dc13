"""`scape view`: what files are, sliders that move bodies in a real browser, poses by dragging, what is saved."""
import json
import warnings

import numpy as np
import pytest
from browser import wait_until
from completion_bodies import worm_with_prior
from model_bodies import worm_model

from completion.__main__ import main
from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.motion import Motion
from completion.partial.completion import Completion, save_completion
from completion.viewing.app import ViewApp
from completion.viewing.contents import Stance
from completion.viewing.dragging import Drag
from completion.viewing.files import Files
from completion.viewing.motions import as_columns
from completion.viewing.movable import FEW, MovableBody, part_in_words
from completion.viewing.notebook import view
from completion.viewing.saving import free_name
from model.files import load_model
from scanprep import RegisteredSet, read_mesh, write_landmarks, write_mesh
from scanprep.geometry import rotations
from scanprep.geometry.files import PointCloud, write_points
from scanprep.geometry.mesh import Mesh
from scanprep.viewer.messages import Message
from scanprep.viewer.server import Server

PART = "part3"                       # the last of the worm's chain of two


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def files(tmp_path_factory, model):
    """A model, a smaller one, a motion, a mesh with landmarks, a cloud."""
    folder = tmp_path_factory.mktemp("view")
    model.save(folder / "worm.npz")
    worm_model(seed=1, components=1, rings=21).save(folder / "short.npz")
    a_motion(40).save(folder / "wave.npz")
    write_mesh(folder / "body.ply", model.template)
    write_landmarks(folder / "body.landmarks.json", {"head": model.template.vertices[0], "tail": 5})
    write_points(folder / "cloud.xyz", PointCloud(model.template.vertices))
    return folder


def a_motion(count, labels=()):
    t = np.linspace(0, 2 * np.pi, count)
    poses = np.zeros((count, 4, 3))
    poses[:, 1:, 1] = 0.6 * np.sin(t)[:, None]
    poses[:, 0, 0] = 0.1 * t
    residuals = np.full((count, len(labels)), 0.004)
    return Motion(poses, np.c_[t, 0 * t, 0 * t], np.array([0.5, -1.0]), 20.0, residuals, labels)


def app_of(folder, *names, **options):
    where = {name: options.pop(name) for name in ("model", "unit") if name in options}
    over = options.get("over", False)
    return ViewApp(Files(tuple(folder / name for name in names), over=over, **where).entries(), **options)


class Told(list):
    """What an app sends."""

    def __call__(self, message):
        self.append(message)


def ask(app, kind, **fields):
    told = Told()
    app.handle(Message(kind, fields), told)
    return told


def seen(page, pane=0, layer=0):
    """The vertices (N, 3) of a layer in the page, metres in the world."""
    values, origin = page.evaluate(f"(() => {{ const p = program.figure.panes[{pane}];"
                                   f"return [Array.from(p.layers[{layer}].positions), p.origin.toArray()]; }})()")
    return np.array(values).reshape(-1, 3) + origin


def on_screen(page, point):
    """Where a point (3,), metres in the world, is in the window, pixels."""
    return page.evaluate(f"""(() => {{ const pane = program.figure.panes[0], box = pane.canvas.getBoundingClientRect();
        const q = pane.project(pane.camera.position.clone().fromArray({point.tolist()}).sub(pane.origin));
        return [box.left + q.x, box.top + q.y]; }})()""")


def open_app(page, server):
    page.goto(server.opening())
    wait_until(page, "Boolean(window.program?.figure && program.entries)", 20)


def expected(app, model):
    turns, betas = app.controls.turns, app.controls.betas[:model.n_betas]
    return model.vertices(np.array([turns[name] for name in model.skeleton.names]), betas, app.controls.trans)


# the body behind the sliders


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
    real = type(model).basis
    monkeypatch.setattr(type(model), "basis", lambda self, betas=None: made.append(betas) or real(self, betas))
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
    assert [part_in_words(name) for name in ("hand_left", "l_hand", "upper_arm_right", "r_upper_arm", "chest", "part3")
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
        pose, trans = drag.moved(pose, trans, target)
    assert np.linalg.norm(drag.operator.evaluate(pose, trans)[0] - target) < 0.01
    assert not pose[[0, 1]].any() and not trans.any()    # only the chain from the trunk turns
    for _ in range(30):
        pose, trans = drag.moved(pose, trans, np.array([50.0, -30, 20]))
    assert np.isfinite(pose).all() and np.linalg.norm(pose, axis=1).max() <= np.pi + 1e-9


def test_the_trunk_moves_as_a_whole(model):
    body, pose = MovableBody(model), np.zeros((4, 3))
    vertex = int(np.flatnonzero(body.part_of_vertex == 0)[0])
    drag = Drag(body, vertex, np.zeros(3), pose)
    turned, trans = drag.moved(pose, np.zeros(3), drag.operator.evaluate(pose)[0] + [0.1, 0.2, 0])
    assert not turned.any() and np.allclose(trans, [0.1, 0.2, 0])


def test_a_motion_as_columns(model):
    motion, subject = a_motion(300), model.subject(np.array([0.5, -1.0]))
    basis, coefficients = as_columns(motion, subject, motion.vertices(subject, np.arange(0, 300, 7)))
    assert basis.shape[1] < 60
    assert np.abs(np.einsum("nr,trc->tnc", basis, coefficients) - motion.vertices(subject)).max() < 2e-3


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_bodies_stand_whatever_axis_is_up(model, axis, sign):
    up = sign * np.eye(3)[axis]
    stance = Stance(np.array([[0, 0, 0], [1.0, 2, 3]]), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]))
    camera = stance.camera(up)
    assert np.allclose(camera.axes @ camera.axes.T, np.eye(3)) and np.linalg.det(camera.axes) > 0
    assert camera.axes[1] @ up > 0.9 and camera.axes[2] @ up > 0         # from a little above
    assert np.allclose(camera.vertical, up)


def test_a_motion_of_another_up_axis_stands(model):
    lying = np.zeros((5, 4, 3))
    lying[:, 0] = rotations.log(np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]))          # x, along the worm, goes to -y
    stands = Stance.of(model.template, lying)
    assert np.allclose(stands.up, [0, -1, 0]) and abs(stands.front @ stands.up) < 1e-9


# what files are


def test_kinds_are_told_by_content(files, tmp_path, model):
    (tmp_path / "walk.model").write_bytes((files / "worm.npz").read_bytes())
    (tmp_path / "old").write_bytes((files / "wave.npz").read_bytes())
    app = app_of(tmp_path, "walk.model", "old")
    assert [one.name for one in app.controls.shown] == ["walk.model"]
    assert len(app.shown) == 2 and not app.problems


def test_landmarks_beside_a_mesh_are_shown_with_it(files):
    app = app_of(files, "body.ply", "cloud.xyz")
    mesh, cloud = app.contents[0], app.contents[1]
    assert [shape.name for shape in mesh.shapes] == ["", "landmarks"]
    assert mesh.shapes[1].labels == ("head", "tail")
    assert len(cloud.shapes[0].points) == len(mesh.shapes[0].mesh.vertices)


def test_a_file_beside_that_has_no_landmarks_hides_nothing(files, tmp_path):
    (tmp_path / "body.ply").write_bytes((files / "body.ply").read_bytes())
    (tmp_path / "body.json").write_text('{"kind": "statue"}')
    content = app_of(tmp_path, "body.ply").contents[0]
    assert len(content.shapes) == 1 and "body.json" in content.notes[0]


def test_landmarks_and_layouts_are_laid_on_what_was_named_before(files, tmp_path, model):
    layout = {"markersets": [{"type": "body", "distance_from_skin": 0.01, "indices": {"A": 3, "B": 40}}]}
    (tmp_path / "layout.json").write_text(json.dumps(layout))
    (tmp_path / "body.ply").write_bytes((files / "body.ply").read_bytes())
    app = app_of(tmp_path, "body.ply", "layout.json")
    dots = app.contents[0].shapes[1]
    assert dots.labels == ("A", "B")
    assert np.allclose(np.linalg.norm(dots.points - model.template.vertices[[3, 40]], axis=1), 0.01, atol=1e-9)
    with pytest.raises(ValueError, match=r"layout.json: landmarks and layouts"):
        app_of(tmp_path, "layout.json")


def test_a_registered_set_is_a_list_with_the_first_shown(model, tmp_path):
    made = RegisteredSet.create(tmp_path / "set", model.template)
    for i in range(3):
        made = made.add(f"scan{i}", model.template.vertices + i)
    app = app_of(tmp_path, "set")
    assert [entry.name for entry in app.entries] == ["scan0", "scan1", "scan2", "template"]
    assert app.shown == [0]
    told = ask(app, "show", entries=[1, 2])
    assert [message.kind for message in told] == ["scene", "state"] and app.shown == [1, 2]


def test_more_than_twelve_files_are_a_list(model, tmp_path):
    for i in range(14):
        write_mesh(tmp_path / f"m{i:02}.ply", model.template)
    app = app_of(tmp_path, ".")
    assert len(app.entries) == 14 and app.shown == [0]
    with pytest.raises(ValueError, match="at most 12"):
        ask(app, "show", entries=list(range(14)))


def test_a_completion_has_its_errors_as_heat(model, tmp_path):
    mesh, N = model.template, len(model.template.vertices)
    done = Completion(mesh, mesh, np.zeros((4, 3)), np.zeros(3), np.zeros(3), np.arange(N) < 50, rms=0.0, explained=1.0,
                      landmark_rms=0.0, converged=True, iterations=3, energies={}, scale=1.0,
                      expected_error=np.linspace(0, 0.05, N), confidence=np.ones(N))
    (tmp_path / "done").mkdir()
    save_completion(tmp_path / "done", done)
    content = app_of(tmp_path, "done").contents[0]
    assert set(content.shapes[0].shades) == {"seen", "expected error"}
    assert [shape.visible for shape in content.shapes] == [True, False]


def test_a_recording_laid_over_its_motion_tells_residuals(files, tmp_path, model, page):
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
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
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


REFUSED = {
    "nothing.ply": (None, "nothing.ply: no such file"),
    "empty.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
                  b"end_header\n", "empty.ply"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "nan.obj"),
    "notes.docx": (b"hello", "notes.docx: expected a mesh"),
    "text.ply": (b"hello", "text.ply"),
    "cut.npz": (b"PK\x03\x04broken", "cut.npz: expected"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_shown_is_refused_in_one_line(name, tmp_path, capsys):
    data, line = REFUSED[name]
    if data is not None:
        (tmp_path / name).write_bytes(data)
    assert main(["view", str(tmp_path / name), "--serve", "0"]) == 1
    told = capsys.readouterr().err
    assert line in told and len(told.strip().splitlines()) == 1 and "unforeseen" not in told


def test_a_motion_wants_its_model(files, tmp_path):
    with pytest.raises(ValueError, match=r"wave.npz: a motion needs its model; name it with -m"):
        app_of(files, "wave.npz")
    assert app_of(files, "wave.npz", "worm.npz").shown == [0, 1]          # there it is
    small = worm_model(components=1)
    small.save(tmp_path / "small.npz")
    with pytest.raises(ValueError, match="at most the 1 betas"):
        app_of(files, "wave.npz", model=tmp_path / "small.npz")


def test_a_bad_file_among_good_ones_is_told_of(files, tmp_path):
    (tmp_path / "bad.ply").write_text("no mesh")
    (tmp_path / "good.ply").write_bytes((files / "body.ply").read_bytes())
    app = app_of(tmp_path, "bad.ply", "good.ply")
    assert app.shown == [1] and "bad.ply" in app.problems[0]
    assert "bad.ply" in app.state().fields["problems"][0]


def test_a_scan_in_millimetres_is_noted(tmp_path, model):
    write_mesh(tmp_path / "mm.ply", Mesh(1000 * model.template.vertices, model.template.faces))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        app = app_of(tmp_path, "mm.ply")
    assert "unit='mm'" in app.state().fields["notes"][0] and "unit='mm'" in str(caught[0].message)
    assert not app_of(tmp_path, "mm.ply", unit="mm").state().fields["notes"]


def test_many_triangles_are_thinned(tmp_path):
    n = 400
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 2, n), indexing="ij")
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    write_mesh(tmp_path / "many.ply", Mesh(np.stack([x, y, 0.1 * np.sin(9 * x)], -1).reshape(-1, 3), faces))
    content = app_of(tmp_path, "many.ply").contents[0]
    assert len(content.shapes[0].mesh.faces) < 200_000 < len(faces)
    assert "fewer" in content.notes[0] and f"{len(faces):,} triangles" in content.about


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
        app.controls.random_body(app.rng)
        drawn.append(app.controls.betas)
    assert np.abs(np.mean(drawn, axis=0)).max() < 0.25 and np.abs(np.std(drawn, axis=0) - 1).max() < 0.2
    ask(app, "random_pose")
    assert not app.controls.turns[model.skeleton.names[0]].any() and app.controls.turns[PART].any()
    ask(app, "reset")
    assert not any(turn.any() for turn in app.controls.turns.values()) and not app.controls.betas.any()


# in a notebook


def test_a_notebook_shows_what_turns_without_a_network(model, new_page, tmp_path):
    subject, motion = model.subject(np.array([0.5, -1.0])), a_motion(20)
    shown = view(model.template, model.template.vertices, model, subject, (motion, subject))
    assert len(shown._repr_html_()) < 2_000_000
    (tmp_path / "notebook.html").write_text(f"<body>{shown._repr_html_()}</body>", encoding="utf-8")
    page = new_page(offline=True)
    page.goto((tmp_path / "notebook.html").as_uri())
    frame = page.frames[-1]
    wait_until(page, "Boolean(document.querySelector('iframe').contentDocument.querySelector('figure')?.sk)", 20)
    assert frame.evaluate("document.querySelector('figure').sk.panes.length") == 5
    assert not page.errors and all(url.startswith(("file:", "about:", "data:", "blob:")) for url in page.requests)


def test_a_notebook_shows_files_and_refuses_the_rest(files):
    assert [content.name for content in view(files / "body.ply", str(files / "worm.npz")).contents] == [
        "body.ply", "worm.npz"]
    with pytest.raises(ValueError, match="got dict"):
        view({})
    with pytest.raises(ValueError, match="got nothing"):
        view()
    with pytest.raises(ValueError, match="up: expected one of"):
        view(files / "body.ply", up="w")


# in the browser


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


def test_a_motion_plays(files, page, model):
    app = app_of(files, "wave.npz", model=files / "worm.npz")
    motion = Motion.load(files / "wave.npz")
    bodies = motion.vertices(model.subject(motion.betas))
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
        page.evaluate("program.figure.go(25)")
        assert np.abs(seen(page) - bodies[25]).max() < 2e-3
        page.keyboard.press("Space")
        wait_until(page, "program.figure.playing && program.figure.frame !== 25")
        page.keyboard.press("Space")
        wait_until(page, "!program.figure.playing")
        frame = page.evaluate("program.figure.frameOf(program.figure.panes[0].layers[0])")
        assert np.abs(seen(page) - bodies[frame]).max() < 2e-3
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


def test_a_recording_at_another_rate_keeps_the_time(files, tmp_path, page, model):
    motion = a_motion(40)
    subject = model.subject(motion.betas)
    positions = motion.vertices(subject)[:, [10, 100, 300]]
    write_markers(tmp_path / "slow.csv", MarkerSequence(positions[::2], ("A", "B", "C"), motion.rate / 2))
    motion.save(tmp_path / "walk.npz")
    app = app_of(tmp_path, "walk.npz", "slow.csv", model=files / "worm.npz")
    with Server(app, say=lambda line: None) as server:
        open_app(page, server)
        page.evaluate("program.figure.go(20)")
        assert np.abs(seen(page, 1) - positions[20]).max() < 2e-3
