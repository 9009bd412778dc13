"""`scape view` of what has layers: statues posed by sliders, motions with and without their soft tissue."""
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from browser import opened, wait_until
from conformance_bodies import KINDS
from viewing_apps import ask, seen

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from completion.motion import Motion
from completion.viewing import statues
from completion.viewing.app import ViewApp
from completion.viewing.files import Files
from completion.viewing.motions import of_motion
from completion.viewing.notebook import view
from completion.viewing.soft import with_soft_tissue
from model.files import load_model
from model.statue.control.files import humanoid
from model.statue.control.model import FOLDED, MEASURED, DisplacementMap, Statue
from model.statue.detail.reconstruction import Reconstruction
from model.statue.detail.subdivision import subdivide_uniform
from model.statue.files import save_statue, write_body
from scanprep import read_mesh

OWN = np.array([0.6, -0.4, 0.3])
TURN = [0.4, -0.2, 0.6]


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Sixteen triangles for one of the control mesh."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statues, "LEVEL", 2)
        yield


def soft_motion(model, count=30):
    """A motion in which the shape changes."""
    t = np.linspace(0, 2 * np.pi, count)
    poses = model.pose_mean + 0.3 * np.sin(t[:, None, None] + np.arange(4)[:, None] + np.arange(3))
    motion = Motion(poses, np.c_[t, 0 * t, 0 * t], OWN, 30.0, np.zeros((count, 0)))
    return SoftTissue(motion, 0.8 * np.sin(3 * t[:, None] + np.arange(3)))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A statue with waves on its skin, and a motion with soft tissue beside its model."""
    folder = tmp_path_factory.mktemp("layers")
    control = humanoid()
    heights = 0.004 * np.sin(np.arange(256)[:, None] / 4 + np.zeros(256))
    coverage = np.full((256, 256), MEASURED, np.uint8)
    coverage[:128] = FOLDED
    texture = np.tile(np.array([200, 120, 60], np.uint8), (256, 256, 1))
    statue = Statue(control, np.zeros((len(control.skeleton.parents), 3)),
                    DisplacementMap(heights.astype(np.float32), coverage), texture)
    save_statue(folder / "statue", statue)
    write_body(folder / "statue", statue)
    model = KINDS["scape-quadratic"]()
    model.save(folder / "worm.npz")
    soft = soft_motion(model)
    (folder / "walk").mkdir()
    soft.motion.save(folder / "walk" / "motion.npz")
    soft.save(folder / "walk" / "soft_tissue.npz")
    return SimpleNamespace(folder=folder, statue=statue, model=model, soft=soft)


def detailed(place, app):
    """The exact surface where the sliders stand, and the control mesh below it."""
    body, control = load_model(place.folder / "statue" / "body.npz"), place.statue.control
    pose = np.array([app.controls.turns[name] for name in app.controls.shown[0].body.parts])
    moved = body.vertices(pose)
    return Reconstruction(control, place.statue.map, subdivide_uniform(control.mesh, control.chart, 2))(moved), moved


def told(app, layer):
    """The vertices of a layer that the app sent last, metres in the world."""
    message = next(m for m in app.greet() if m.kind == "positions" and m.fields["layer"] == layer)
    return np.frombuffer(message.data, "<f4").reshape(-1, 3) + app.cameras[0].target


@pytest.mark.parametrize("name", ["walk", "walk/soft_tissue.npz"])
def test_a_motion_is_shown_with_its_soft_tissue(place, name):
    content = Files((place.folder / name,), place.folder / "worm.npz").entries()[0].load()
    assert [(shape.shape.name, shape.shape.visible) for shape in content.shapes] == [
        ("fixed shape", False), ("with soft tissue", True)]
    assert content.shapes[1].columns[1].shape[0] == len(place.soft.changes)
    assert "soft tissue" in content.shapes[1].shape.shades


def test_markers_are_compared_with_the_body_that_is_seen(place):
    labels, soft, model = ("A", "B", "C"), place.soft, place.model
    bodies = soft.vertices(model)
    markers = MarkerSequence(bodies[:, [10, 100, 300]], labels, 30.0)
    residuals = np.random.default_rng(0).uniform(0, 0.02, (len(bodies), 3))
    soft = SoftTissue(replace(soft.motion, residuals=residuals, labels=labels), soft.changes)
    content = with_soft_tissue(of_motion("walk", soft.motion, model.subject(OWN, np.float32)), soft, model, markers)
    assert [shape.shape.name for shape in content.shapes] == ["fixed shape", "with soft tissue", "markers"]
    assert content.markers.shape == 2 and np.array_equal(content.markers.residuals, residuals)
    assert "with soft tissue" in content.notes[0]


@pytest.mark.parametrize("name", ["statue", "statue/statue.json", "statue/control.npz"])
def test_a_statue_is_known_by_its_folder_and_its_files(place, name):
    entries = Files((place.folder / name,)).entries()
    assert len(entries) == 1
    surface, = entries[0].load().shapes
    assert len(surface.mesh.vertices) > 15 * len(place.statue.control.mesh.vertices)
    assert set(surface.shades) == {"plain", "parts", "what was measured"}
    np.testing.assert_allclose(surface.mesh.colors, np.broadcast_to(np.array([200, 120, 60]) / 255,
                                                                    surface.mesh.vertices.shape), atol=1e-9)


def test_sliders_pose_a_statue_and_the_detail_stands_on_it(place, tmp_path):
    app = ViewApp(Files((place.folder / "statue",)).entries(), output=tmp_path)
    part = "left shoulder"
    ask(app, "turn", part=part, turn=TURN)
    ask(app, "choose", part=part)
    surface, control = detailed(place, app)
    assert np.abs(told(app, 0) - surface).max() < 1e-5
    ask(app, "save_body")
    ask(app, "save_pose")
    assert [path.name for path in app.written] == ["statue_body.ply", "statue_pose.npz"]
    assert np.abs(read_mesh(app.written[0]).vertices - surface).max() < 1e-5
    np.testing.assert_allclose(Motion.load(app.written[1]).vertices(load_model(
        place.folder / "statue" / "body.npz").subject(None))[0], control, atol=1e-6)


@pytest.mark.slow
def test_a_page_shows_both(place, new_page):
    app = ViewApp(Files((place.folder / "statue", place.folder / "walk"), place.folder / "worm.npz").entries())
    both = "window.program?.figure?.panes.length === 2 && program.parts?.includes('left shoulder')"
    with opened(new_page, app, both, width=1300) as page:
        page.evaluate(f"program.send('turn', {{part: 'left shoulder', turn: {TURN}}})")
        wait_until(page, "Math.abs((program.turns['left shoulder'] ?? [0])[0] - 0.4) < 1e-9")
        page.wait_for_timeout(300)
        assert np.abs(seen(page) - detailed(place, app)[0]).max() < 1e-5
        page.evaluate("program.figure.go(12)")
        assert np.abs(seen(page, 1, 1) - place.soft.vertices(place.model, slice(12, 13))[0]).max() < 2e-3
        rigid = place.soft.motion.vertices(place.model.subject(OWN))[12]
        page.get_by_label("fixed shape").check()
        page.get_by_label("with soft tissue").uncheck()
        assert page.evaluate("program.figure.panes[1].layers.map((layer) => layer.object.visible)") == [True, False]
        assert np.abs(seen(page, 1, 0) - rigid).max() < 2e-3


def test_a_notebook_shows_statues_and_soft_tissue(place, tmp_path):
    shown = view(place.statue, (place.soft, place.model), place.folder / "statue")
    assert [len(content.shapes) for content in shown.contents] == [1, 2, 1]
    shown.write(tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 100_000
