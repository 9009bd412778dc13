"""Pages in a real browser with the network off: bodies are what Python packed, motions play, nothing is fetched."""
import contextlib

import numpy as np
import pytest
from browser import WITHOUT_3D, chromium, wait_until, watched
from scene_reader import scenes_of

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Bones, Dots, Heat, Moving, Solid, sphere

T = 12


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A page with one figure of every kind of shape, and one of a motion; 3 km from the origin."""
    vertices, faces = sphere(3)
    body = Mesh(vertices * [0.3, 0.2, 0.9] + [3000.0, 0, 1], faces)
    far = np.abs(body.vertices[:, 2] - 1) / 90
    far[:50] = np.nan
    points = body.vertices[[3, 40, 200]]
    looks = Solid(body, Heat(far, 0, 0.01, "distance to the scan"), name="body", shades={
        "sure": Heat(far * 100, 0, 1, "sure", "%"), "plain": np.array([0.2, 0.8, 0.4])})
    camera = Camera.around(body)
    sides = [body.vertices.mean(axis=0) + side * 0.32 * camera.axes[2] for side in (1, -1)]
    ghost = Solid(body, (1, 0, 0), name="ghost", visible=False)
    shapes = [looks, ghost, Dots(points, name="marks", labels=["head", "", "hand"], on_top=True),
              Bones(points[:2], points[1:], name="bones"), Dots(np.array(sides), name="skin", labels=["near", "far"])]
    way = np.stack([np.linspace(0, 0.4, T), 0 * np.arange(T), 0.1 * np.sin(np.arange(T))], axis=1)
    moves = body.vertices + way[:, None]
    moves[4:6] = np.nan
    seen = moves[:, [3, 40]].copy()
    seen[7, 1] = np.nan
    moving = [Moving(Solid(body, name="body"), moves, 10.0), Moving(Dots(seen[0], name="dots"), seen, 10.0)]
    page = Page("Bodies").bodies([Pane(shapes, camera, "left"), Pane(shapes[:1], camera, "right")])
    page.text("Below.").bodies([Pane(moving, camera)], "a motion")
    path = tmp_path_factory.mktemp("pages") / "report.html"
    page.write(path)
    return path


@pytest.mark.slow
def test_without_webgl_the_pictures_stay(report):
    with chromium(WITHOUT_3D) as without:
        page = watched(without.new_context(offline=True))
        page.goto(report.as_uri())
        wait_until(page, "document.body.classList.contains('sk-pictures-only')")
        assert page.locator("figure img").count() == 2 and page.locator("canvas").count() == 0
        assert page.evaluate("[...document.images].every((image) => image.naturalWidth > 50)")


@pytest.fixture(scope="module")
def window(browser):
    """A page for all tests, each of which loads the report anew."""
    with contextlib.closing(browser.new_context(offline=True, viewport={"width": 1000, "height": 800})) as context:
        yield watched(context)


@pytest.fixture
def shown(window, report):
    page = window
    page.errors.clear()
    page.requests.clear()
    page.goto(report.as_uri())
    for number in range(2):
        page.locator("figure").nth(number).scroll_into_view_if_needed()
        wait_until(page, f"'turns' in document.querySelectorAll('figure')[{number}].dataset", 30)
    yield page
    assert not page.errors and page.requests == [report.as_uri()]


def layer(page, figure, number):
    """Places (n, 3) of a layer as the browser has them, in the frame of the file."""
    told = page.evaluate("""([figure, number]) => {
        const pane = document.querySelectorAll("figure")[figure].sk.panes[0];
        return [Array.from(pane.layers[number].positions), pane.origin.toArray()]; }""", [figure, number])
    return np.array(told[0]).reshape(-1, 3) + told[1]


def ink(page, figure):
    """Share of the pixels of the first pane that are not its background."""
    return page.evaluate("""(figure) => {
        const pane = document.querySelectorAll("figure")[figure].sk.panes[0];
        pane.draw();
        const { data } = pane.context.getImageData(0, 0, pane.canvas.width, pane.canvas.height);
        let other = 0;
        for (let i = 0; i < data.length; i += 4) {
          other += Math.abs(data[i] - data[0]) + Math.abs(data[i + 1] - data[1]) > 30;
        }
        return other / (data.length / 4); }""", figure)


def test_the_browser_has_the_shapes_that_were_packed(shown, report):
    still, _ = scenes_of(report.read_text())
    for number, one in enumerate(still.header["panes"][0]["layers"]):
        np.testing.assert_allclose(layer(shown, 0, number), still.positions(one), atol=1e-5)
    assert 0.1 < ink(shown, 0) < 0.7
    assert shown.locator(".sk-label").all_inner_texts() == ["left", "right"]


@pytest.mark.slow
def test_legends_are_in_millimetres_and_per_cent(shown):
    legend = shown.locator("figure").first.locator(".sk-legend")
    assert legend.all_inner_texts()[0].split("\n") == ["distance to the scan", "0 mm", "10 mm"]
    shown.locator("figure").first.get_by_label("colour").select_option("sure")
    assert legend.all_inner_texts()[0].split("\n") == ["sure", "0%", "100%"]
    shown.locator("figure").first.get_by_label("colour").select_option("plain")
    assert legend.count() == 0


def test_what_is_hidden_at_first_can_be_shown_and_the_other_way(shown):
    first = shown.locator("figure").first
    assert [first.get_by_label(name, exact=True).is_checked() for name in ("body", "ghost", "marks", "names")] == [
        True, False, True, True]
    before = ink(shown, 0)
    first.get_by_label("body", exact=True).uncheck()
    assert ink(shown, 0) < before / 3
    first.get_by_label("ghost", exact=True).check()
    assert ink(shown, 0) == pytest.approx(before, rel=0.1)


def test_every_frame_is_where_it_was(shown, report):
    _, scene = scenes_of(report.read_text())
    body, dots = (scene.frames(scene.layer(name)) for name in ("body", "dots"))
    for t in (0, 3, 11):
        shown.evaluate("(t) => document.querySelectorAll('figure')[1].sk.go(t)", t)
        np.testing.assert_allclose(layer(shown, 1, 0), body[t], atol=1e-5)
        np.testing.assert_allclose(layer(shown, 1, 1), dots[t], atol=1e-5)
    shown.evaluate("document.querySelectorAll('figure')[1].sk.go(7)")
    assert np.abs(layer(shown, 1, 1)[1]).max() > 1e5                     # not seen: far away
    present = ink(shown, 1)
    shown.evaluate("document.querySelectorAll('figure')[1].sk.go(4)")     # lost
    assert ink(shown, 1) < 0.05 < present
