"""`scape complete --interactive`: by mouse alone from a half view to a saved body, and what the page says of it."""
import json
import time

import numpy as np
import pytest
from browser import opened, wait_until
from completion_bodies import MARKS, POSE, QUICK, TRANS, half_view, worm_with_prior
from hostile_messages import check_it_goes_on
from test_completion_partial import errors

from completion.partial.clicked_landmarks import landmark_doubts
from completion.partial.completion import complete, load_completion
from completion.partial.interactive import CompleteApp
from completion.partial.work import CompletionTask
from scanprep.batch.opening import workspace
from scanprep.geometry.files import PointCloud, write_points
from scanprep.geometry.landmarks import read_landmarks
from scanprep.viewer.messages import Message

NAMES = [f"mark {i}" for i in range(len(MARKS))]
PLACED = """([pane, place]) => {
    const on = program.figure.panes[pane], box = on.canvas.getBoundingClientRect();
    const at = on.project(on.origin.clone().fromArray(place).sub(on.origin));
    return [box.left + at.x, box.top + at.y];
}"""


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture
def case(model, tmp_path):
    """The body, what was seen of it, and the app with its scan of points."""
    body = model.template.with_vertices(model.vertices(POSE, None, TRANS))
    points, seen = half_view(body, np.array([0.3, -1, 0.5]), noise=0.001)
    write_points(tmp_path / "half.ply", PointCloud(points))
    work = CompletionTask(model, "worm", dict(zip(NAMES, map(int, MARKS), strict=True)), QUICK)
    app = CompleteApp(model, work, [tmp_path / "half.ply"], tmp_path / "out")
    return body, points, seen, app


def sent(app, kind, **fields):
    told = []
    app.handle(Message(kind, fields), told.append)
    return told


def finished(app, page=None):
    """Wait for the work beside the clicks."""
    end = time.monotonic() + 60
    while app.working is not None:
        assert time.monotonic() < end
        page.wait_for_timeout(50) if page else time.sleep(0.05)


def marked(app, body, seen, count=4):
    """Give the scan some landmarks, as clicks do."""
    for name, vertex in list(zip(NAMES, MARKS, strict=True)):
        if seen[vertex] and len(app.scan.places) < count:
            app.scan.places[name] = app.scan.body.nearest(body.vertices[vertex])


def clicked_on_the_scan(page, app, body, seen, toward, count=4):
    """Click landmarks in a page whose second pane is turned to where the camera stood."""
    wait_until(page, "program.figure.panes.every((pane) => pane.drawn > 1)")
    page.evaluate("""(back) => { const pane = program.figure.panes[1]; Object.assign(pane.home,
        { back, width: 2 * pane.home.width, height: 2 * pane.home.height }); pane.reset(); }""",
                  (toward / np.linalg.norm(toward)).tolist())
    for name, vertex in zip(NAMES, MARKS, strict=True):
        if not seen[vertex] or len(app.scan.places) == count:
            continue
        item = page.locator(".sk-names li").filter(has_text=name).first
        item.click() if app.scan.places else item.press("Enter")
        wait_until(page, f"program.state.chosen === {json.dumps(name)}")
        page.mouse.click(*page.evaluate(PLACED, [1, body.vertices[vertex].tolist()]))
        wait_until(page, f"{json.dumps(name)} in program.state.panes[1].places")


def test_a_completion_goes_on_from_the_one_before(case):
    body, _, seen, app = case
    marked(app, body, seen)
    sent(app, "known", known=True)
    sent(app, "complete")
    finished(app)
    first = app.made[app.scan.path]
    assert first.known and max(errors(body, first.completion, seen)) < 0.01
    assert set(app.scan.predicted) <= set(NAMES) and len(app.greet()[0].data) > 1000
    state = app.greet()[1].fields["completed"]
    assert state["verdict"] == str(first.completion.judgement).split(":")[0] and not state["outdated"]
    sent(app, "slide", pane=1, name=next(iter(app.scan.places)), direction=[0, 0, 1], by=0.002)
    assert app.greet()[1].fields["completed"]["outdated"]
    sent(app, "complete")
    finished(app)
    again = app.made[app.scan.path]
    assert again.completion is not first.completion and not app.greet()[1].fields["completed"]["outdated"]
    assert max(errors(body, again.completion, seen)) < 0.01


def test_what_python_completes_the_page_completes(case):
    body, points, seen, app = case
    marked(app, body, seen, 7)
    pairs = np.array([MARKS[NAMES.index(name)] for name in app.scan.places]), np.array(list(app.scan.places.values()))
    want = complete(app.model, PointCloud(points), pairs, QUICK)
    sent(app, "complete")
    finished(app)
    got = app.made[app.scan.path].completion
    np.testing.assert_allclose(got.completed.vertices, want.completed.vertices, atol=1e-6)


def test_landmarks_at_wrong_places_are_told():
    found = {"left toe": np.zeros(3), "right toe": np.array([0.3, 0, 0]), "left knee": np.array([0, 0, 0.5]),
             "right knee": np.array([0.3, 0, 0.5]), "nose": np.array([0.1, 0, 1.6])}
    assert landmark_doubts({name: place + 0.03 for name, place in found.items()},
                           found).startswith("all landmarks are where")
    swapped = {**found, "left toe": found["right toe"], "right toe": found["left toe"],
               "left knee": found["right knee"]}
    assert "left and right are exchanged" in landmark_doubts(swapped, found)
    told = landmark_doubts({**found, "nose": found["left knee"], "left toe": found["right toe"]}, found)
    assert told.endswith("where the rings are: nose (1105 mm), left toe (300 mm)")


@pytest.mark.slow
def test_the_body_is_found_without_the_landmarks_that_are_doubted(case):
    body, _, seen, app = case
    marked(app, body, seen)
    right = {name: place.copy() for name, place in app.scan.places.items()}
    wrong, *_, other = right
    app.scan.places[wrong] = right[other]
    sent(app, "doubt")
    finished(app)
    assert f"where the rings are: {wrong} (" in app.note and other not in app.note
    assert np.linalg.norm(app.scan.predicted[wrong] - right[wrong]) < 0.03
    app.scan.places[wrong] = right[wrong]
    sent(app, "doubt")
    finished(app)
    assert app.note.startswith("all landmarks are where")


def test_too_few_landmarks_and_nothing_to_save_are_refused(case):
    body, _, seen, app = case
    with pytest.raises(ValueError, match="complete the scan first"):
        sent(app, "save")
    marked(app, body, seen, 2)
    with pytest.raises(ValueError, match="at least 3 landmarks"):
        sent(app, "complete")


@pytest.mark.slow
def test_from_a_half_view_to_a_saved_body_by_mouse_alone(case, new_page, tmp_path):
    body, _, seen, app = case
    app.known = True
    with workspace(tmp_path / "out"), opened(new_page, app, width=1300) as page:
        clicked_on_the_scan(page, app, body, seen, np.array([0.3, -1, 0.5]))
        page.get_by_role("button", name="complete with 4 landmarks").click()
        wait_until(page, "Boolean(program.state.completed) && !program.state.working", 60)
        wait_until(page, "program.figure.panes.length === 3 && program.figure.panes[2].drawn > 0")
        assert page.locator(".sk-verdict strong").inner_text() in ("good", "look at it")
        way = "((pane) => pane.view().position.sub(pane.view().target).normalize().toArray())(program.figure.panes[{}])"
        one, other = (page.evaluate(way.format(i)) for i in (1, 2))
        np.testing.assert_allclose(one, other, atol=1e-6)                 # scan and body are seen from one side
        for left in (3, 2):
            page.locator(".sk-names li").filter(has=page.locator(".sk-dots :nth-child(2).sk-on")).first.click()
            wait_until(page, "program.state.chosen in program.state.panes[1].places")
            page.keyboard.press("Delete")
            wait_until(page, f"Object.keys(program.state.panes[1].places).length === {left}")
            assert page.get_by_role("button", name="save").is_disabled()  # it is not of these landmarks
        assert page.get_by_role("button", name="complete", exact=True).is_disabled()
        page.keyboard.press("n")
        wait_until(page, "document.querySelector('.sk-status').textContent.includes('One more, or none')")
        for _ in range(2):
            page.keyboard.press("z")
        wait_until(page, "!program.state.completed.outdated")
        page.get_by_role("button", name="save").click()
        wait_until(page, "Boolean(program.state.completed.saved)", 60)
    saved = load_completion(tmp_path / "out")
    assert max(errors(body, saved, seen)) < 0.015
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {"completed.ply", "report.html", "report.json"}
    clicked = read_landmarks(tmp_path / "half.landmarks.json")
    assert len(clicked) == 4
    for name, place in clicked.items():
        assert np.linalg.norm(place - body.vertices[MARKS[NAMES.index(name)]]) < 0.03


def test_hostile_messages_are_refused_in_a_line(case, capfd):
    check_it_goes_on(case[-1], capfd)
