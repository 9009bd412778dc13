"""`scape complete SCANS -o OUT --interactive`: results worst first, mended, saved as the command itself would have."""
import json
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from browser import DRAWN, take_away, wait_until
from browser import opened as opened_page
from completion_bodies import MARKS, POSE, TRANS, half_view, worm_with_prior
from config_files import config_file
from hostile_messages import check_it_goes_on

from completion.__main__ import main
from completion.partial import report
from completion.partial.completion import load_completion
from completion.partial.folder import FolderCall
from completion.partial.mend import CompletionsApp
from completion.partial.settings import CompletionConfig
from completion.partial.work import MEANS
from scanprep.batch.workspace import Results
from scanprep.console import Metric, judgement_row
from scanprep.geometry.files import PointCloud, write_points
from scanprep.geometry.landmarks import read_landmarks, write_landmarks
from scanprep.judgement import Judgement
from scanprep.viewer import server
from scanprep.viewer.messages import Message

NAMES = {f"m{v}": v for v in map(int, MARKS)}
WRONG = {"m6": "m396", "m396": "m6", "m75": "m330", "m330": "m75"}          # the two ends of the worm
QUICK = {"random_starts": 3, "rounds": 3, "scan_points": 300, "model_points": 150}


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    """Nobody looks at them here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "HEIGHT", 60)
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Completed scans: a; b, of which the ends are exchanged; c is damaged. d came later."""
    place = tmp_path_factory.mktemp("mend")
    model = worm_with_prior()
    replace(model, info={**model.info, "landmarks": NAMES}).save(place / "model.npz")
    body = model.template.with_vertices(model.vertices(POSE, None, TRANS))
    points, _ = half_view(body, np.array([0.3, -1, 0.5]), count=1500, noise=0.001)
    true = {name: body.vertices[v] for name, v in NAMES.items()}
    (place / "scans").mkdir()
    for name in "ab":
        write_points(place / "scans" / f"{name}.ply", PointCloud(points))
        marks = true if name == "a" else {m: true[WRONG.get(m, m)] for m in NAMES}
        write_landmarks(place / "scans" / f"{name}.landmarks.json", marks)
    (place / "scans" / "c.ply").write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    config_file(place, **QUICK)
    assert run(place) == 1                                                   # c failed
    write_points(place / "scans" / "d.ply", PointCloud(points))
    return place


def run(place, *words):
    return main(["complete", str(place / "scans"), "-m", str(place / "model.npz"), "--subject", "template", "-o",
                 str(place / "out"), "--config", str(place / "config.toml"), "--workers", "1", *words])


def app_of(place, out="out", **changed):
    """The app that the command shows, with other settings if any."""
    call = FolderCall(place / "scans", place / "model.npz", subject="template",
                      config=replace(CompletionConfig(**QUICK), **changed))
    return CompletionsApp(call, place / out)


def figures(place):
    return {row["metric"]: row["value"] for row in json.loads((place / "out" / "report.json").read_text())["metrics"]}


def sent(app, kind, **fields):
    app.handle(Message(kind, fields), lambda message: None)


def told(app):
    return app.greet()[-1].fields


def opened(app, name):
    sent(app, "open", scan=[one.path.name for one in app.scans].index(f"{name}.ply"))


def finished(app):
    end = time.monotonic() + 60
    while app.working is not None:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_results_are_opened_worst_first_with_what_is_stored(place):
    app = app_of(place)
    state = told(app)
    assert [one["name"] for one in state["scans"]] == ["c.ply", "b.ply", "a.ply", "d.ply"]
    verdicts = [one["verdict"] for one in state["verdicts"]]
    assert verdicts[0] == "failed" and verdicts[1] in ("check", "failed") and verdicts[3] == "new"
    assert "c.ply" in state["verdicts"][0]["reasons"][0] and state["verdicts"][1]["reasons"]
    assert state["completed"] is None and "c.ply" in app.note                # nothing is there to show
    opened(app, "b")
    assert told(app)["completed"]["verdict"] == verdicts[1] and not told(app)["completed"]["outdated"]
    assert len(app.scene().data) > 1000 and app.known
    with pytest.raises(ValueError, match="nothing has changed"):
        sent(app, "save")
    sent(app, "slide", pane=1, name="m6", direction=[0, 0, 1], by=0.002)
    with pytest.raises(ValueError, match="complete again, then save"):
        sent(app, "save")
    sent(app, "undo")
    assert not told(app)["completed"]["outdated"]
    opened(app, "d")
    assert told(app)["completed"] is None


def test_another_model_or_setting_makes_results_outdated(place):
    for app, outdated in ((app_of(place), False), (app_of(place, rounds=4), True)):
        opened(app, "a")
        assert told(app)["completed"]["outdated"] == outdated


@pytest.mark.slow
def test_a_folder_is_mended_in_the_browser_and_the_command_keeps_it(place, new_page):
    """The exchanged landmarks are taken away by key, the body, which had failed, completed again, and saved."""
    untouched = (place / "out" / "a" / "completed.ply").stat().st_mtime_ns
    app = app_of(place)
    with opened_page(new_page, app, width=1300) as page:
        page.locator("select[aria-label=scan]").select_option(index=1)
        wait_until(page, "program.state.scan === 1 && program.figure.panes.length === 3")
        wait_until(page, DRAWN)
        assert page.locator(".sk-verdict").get_attribute("data-verdict") == "failed"
        assert page.get_by_role("button", name="save").is_disabled()
        take_away(page, WRONG)
        assert "changed since" in page.locator(".sk-verdict strong").inner_text()
        page.get_by_role("button", name="complete again").click()
        wait_until(page, "program.state.working === null && !program.state.completed.outdated", 60)
        page.get_by_role("button", name="save").click()
        wait_until(page, "Boolean(program.state.completed.saved)", 60)
        page.reload()                                                        # another tab would show the same
        wait_until(page, DRAWN)
        assert page.locator("select option").all_inner_texts()[1] == "good · b.ply (3)"
    assert set(read_landmarks(place / "scans" / "b.landmarks.json")) == set(NAMES) - set(WRONG)
    mended = load_completion(place / "out" / "b")
    assert mended.judgement.verdict == "good" and figures(place)["scans completed"] == "2 of 4"
    made = json.loads((place / "out" / "b" / "report.json").read_text())
    assert made["command"] == "scape complete --interactive"
    assert {"metric": "completed", "value": "in the browser", "unit": ""} in made["metrics"]
    assert "--interactive" in (place / "out" / "report.html").read_text()
    later = (place / "scans" / "d.ply").rename(place / "d.ply")
    assert run(place) == 1 and figures(place)["of them in this run"] == 0    # c fails still
    later.rename(place / "scans" / "d.ply")
    shutil.copy(place / "scans" / "a.landmarks.json", place / "scans" / "d.landmarks.json")
    assert (place / "out" / "a" / "completed.ply").stat().st_mtime_ns == untouched
    kept = load_completion(place / "out" / "b")
    np.testing.assert_array_equal(kept.completed.vertices, mended.completed.vertices)


@pytest.mark.slow
def test_by_the_command_itself_nothing_is_lost_and_new_scans_can_be_begun(place, monkeypatch):
    """Looked at and left alone; then the scan that came later is completed there, in a folder of its own too."""
    before = json.loads((place / "out" / "report.json").read_text())
    monkeypatch.setattr(server, "serve", lambda app: None)
    assert run(place, "--interactive") == 1                                  # c fails still
    after = json.loads((place / "out" / "report.json").read_text())
    assert after["failures"] == before["failures"] and {"metric": "bodies saved", "value": 0, "unit": ""} in \
        after["metrics"]

    def complete_d(app):
        opened(app, "d")
        sent(app, "complete")
        finished(app)
        sent(app, "save")

    (place / "scans" / "c.ply").unlink()
    monkeypatch.setattr(server, "serve", complete_d)
    assert run(place, "--interactive", "-o", str(place / "new")) == 0
    assert sorted(p.name for p in (place / "new").iterdir()) == [".scapekit", "d", "report.html", "report.json"]
    assert [one["verdict"] for one in told(app_of(place, "new"))["verdicts"]][1:] == ["new", "new"]


def test_the_page_has_the_failed_first_and_then_the_worst_explained(tmp_path):
    def figures(share, verdict):
        return [judgement_row(Judgement(verdict, ("why",) if verdict != "good" else ())), Metric(MEANS[1], share, "%")]

    results = {"a": figures(98.0, "good"), "b": figures(99.0, "failed"), "c": figures(70.0, "check"),
               "d": figures(80.0, "good")}
    html = FolderCall(tmp_path).description(tmp_path, "model").page(Results(results, {}, ()), [], tmp_path).html()
    assert sorted("abcd", key=lambda name: html.index(f'href="{name}/report.html"')) == ["b", "c", "d", "a"]


def test_hostile_messages_are_refused_in_a_line(place, tmp_path, capfd):
    shutil.copytree(place, tmp_path / "copy")
    check_it_goes_on(app_of(tmp_path / "copy"), capfd)
