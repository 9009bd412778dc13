"""`scape label` on people of the built-in model, as users call it."""
import json
import warnings

import numpy as np
import pytest
from labelling import RATE, person, shuffled, unnamed

from completion.__main__ import main
from completion.mocap.files.markers import MarkerSequence, read_markers, write_markers
from completion.mocap.marker_sets.named import choose_layout
from completion.mocap.marker_sets.opensim import opensim_markers
from model import load_model
from scanprep.geometry.landmark_writing import marker_set


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a recording, raw.c3d, and true.c3d with its labels."""
    folder = tmp_path_factory.mktemp("label")
    _, layout, places = person(2, frames=24)
    places = places.copy()
    places[10:14, 3] = np.nan
    write_markers(folder / "true.c3d", MarkerSequence(places, layout.labels, RATE))
    points, _ = shuffled(places)
    write_markers(folder / "raw.c3d", unnamed(points))
    return folder


@pytest.fixture(scope="module")
def out(place):
    """What the command makes of it."""
    assert run(place, "label", "raw.c3d", "--layout", "cmu41", "-o", "labelled.c3d") == 0
    return place


def run(folder, *words):
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.chdir(folder)
        return main([str(word) for word in words])


def test_the_recording_is_labelled_and_nothing_is_lost(out):
    true, found, raw = (read_markers(out / f"{name}.c3d") for name in ("true", "labelled", "raw"))
    markers = found.select(true.labels).positions
    same = np.isclose(markers, true.positions, atol=1e-5, equal_nan=True).all(axis=2)
    assert same.mean() > 0.985
    for before, after in zip(raw.positions, found.positions, strict=True):
        kept = [np.sort(each[np.isfinite(each[:, 0]), 0]) for each in (before, after)]
        assert np.array_equal(*kept)
    told = json.loads((out / "labelled.c3d.report.json").read_text())
    assert told["judgement"]["verdict"] == "good", told["judgement"]
    assert "Where it is unsure" in (out / "labelled.report.html").read_text()


@pytest.mark.parametrize(("words", "said"), [
    (("label", "few.c3d", "--layout", "cmu41", "-o", "x.c3d"), "at least 10 points, the best has 9"),
    (("label", "raw.c3d", "--layout", "cmu41", "--unit", "m", "-o", "x.c3d"), "metres taken for millimetres"),
])
def test_what_cannot_be_labelled_is_told(place, capsys, words, said):
    raw = read_markers(place / "raw.c3d")
    write_markers(place / "few.c3d", MarkerSequence(raw.positions[:, :9], raw.labels[:9], raw.rate))
    assert run(place, *words) in (1, 2)
    assert said in " ".join(capsys.readouterr().err.split()) and not (place / "x.c3d").exists()


def test_a_marker_set_of_opensim_is_a_layout(tmp_path):
    """There and back: markers end within a centimetre of where they began."""
    model = load_model("people")
    layout, _ = choose_layout(model, "plugingait39", ())
    body, skeleton = model.template, model.skeleton
    (tmp_path / "set.xml").write_text(marker_set(opensim_markers(layout, body, skeleton)))
    found, name = choose_layout(model, str(tmp_path / "set.xml"), ())
    assert found.labels == layout.labels and name.endswith("set.xml")
    off = np.linalg.norm(found.skin_points(body.vertices) - layout.skin_points(body.vertices), axis=1)
    assert np.median(off) < 0.03
    for text, words in (("<x", "MarkerSet of OpenSim"), ("<x/>", "expected markers of OpenSim, found none"),
                        ('<x><Marker name="a"><socket_parent_frame>/bodyset/tail</socket_parent_frame>'
                         "<location>0 0 0</location></Marker></x>", "marker 'a': expected one on")):
        (tmp_path / "bad.xml").write_text(text)
        with pytest.raises(ValueError, match=words):
            choose_layout(model, str(tmp_path / "bad.xml"), ())
