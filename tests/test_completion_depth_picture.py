"""One picture of a depth camera: what is in front of the wall is completed, what is beyond the border is unknown."""
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MARKS, POSE, QUICK, worm_with_prior
from config_files import config_file
from PIL import Image

from completion.__main__ import main
from completion.partial import report
from completion.partial.completion import complete, completion_doubts, find_stray, load_completion
from completion.partial.inputs import prepare_in_metres
from model.fitting.bodies import as_body
from model.fitting.scan_fit import scan_fit
from scanprep.depth_camera.picture import DepthPicture
from scanprep.geometry.landmarks import write_landmarks
from scanprep.geometry.surface import Rays

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
AWAY = 1.8                           # metres


def taken(body, rows=slice(None)):
    """The body before a wall, without noise; only some rows of the picture."""
    row, column = np.indices((240, 320))
    rays = DepthPicture(np.ones((240, 320)), K).directions(column, row).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    _, far = Rays(body).cast(np.zeros((len(rays), 3)), rays / length[:, None])
    depth = np.nan_to_num(far / length, nan=3.0).reshape(240, 320)
    camera = K.copy()
    camera[1, 2] -= rows.start or 0
    return DepthPicture.of(depth[rows], camera)


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def body(model):
    placed = model.vertices(POSE, np.zeros(3), np.zeros(3))
    return model.template.with_vertices(placed - placed.mean(axis=0) + [0, 0, AWAY])


@pytest.fixture(scope="module")
def marks(body):
    return MARKS, body.vertices[MARKS]


def test_a_body_before_a_wall_is_completed(model, body, marks):
    done = complete(model, taken(body), marks, QUICK)
    assert np.linalg.norm(done.predicted.vertices - body.vertices, axis=1).mean() < 0.02
    assert done.explained > 0.95 and done.completed is done.predicted
    assert done.judgement.verdict != "failed"


def test_what_is_beyond_the_border_is_unknown_and_not_doubted(model, body, marks):
    middle = taken(body).project(body.vertices.mean(axis=0))[0]
    given = prepare_in_metres(as_body(model), taken(body, slice(int(middle), None)), marks, None, QUICK)
    fit = scan_fit(as_body(model), given.cloud, given.vertices, given.points, QUICK)
    x = as_body(model).join(POSE, body.vertices.mean(axis=0))
    x[3 * len(POSE):][:3] += (body.vertices - fit.mesh(x).vertices).mean(axis=0)
    np.testing.assert_allclose(fit.mesh(x).vertices, body.vertices, atol=1e-9)
    above = body.vertices[:, 1] < body.vertices[:, 1].mean() - 0.02
    assert fit.beyond(x)[above].all() and not fit.beyond(x).all()
    assert find_stray(fit, x) == []
    seen, error = np.zeros(len(fit.part), dtype=bool), np.where(fit.beyond(x), 1.0, 0.001)
    within = [p for p in range(4) if not fit.beyond(x)[fit.part == p].any()]
    assert within and completion_doubts(fit, x, np.where(np.isin(fit.part, within), 0.001, 1.0),
                                        seen) != completion_doubts(
        fit, x, np.full(len(seen), 1.0), seen)
    assert len(completion_doubts(fit, x, error, seen)) < 4
    aside = x.copy()
    aside[3 * len(POSE)] += 0.3
    assert len(find_stray(fit, aside)) == 2         # it stands in seen space, and leaves what was seen without a body


def test_what_a_picture_cannot_have_is_refused(model, body):
    picture = taken(body)
    for wrong in ({"free_scale": True}, {"viewpoint": (0.0, 0.0, 0.0)}):
        with pytest.raises(ValueError, match="depth picture"):
            complete(model, picture, None, replace(QUICK, **wrong))
    with pytest.raises(ValueError, match="nobody is in it"):
        complete(model, DepthPicture.of(np.full((240, 320), 3.0), K), None, QUICK)
    with pytest.raises(ValueError, match="no head and legs"):
        complete(model, picture, None, replace(QUICK, up=(0.0, -1.0, 0.0)))


@pytest.mark.slow
def test_a_picture_goes_in_as_a_file_and_a_refusal_says_why(model, body, marks, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(report, "HEIGHT", 60)
    replace(model, info={**model.info, "landmarks": {f"m{v}": int(v) for v in MARKS}}).save(tmp_path / "model.npz")
    write_landmarks(tmp_path / "one.landmarks.json", {f"m{v}": p for v, p in zip(*marks, strict=True)})
    for name, depth in (("one", taken(body).depth), ("wall", np.full((240, 320), 3.0))):
        Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(tmp_path / f"{name}.png")
        (tmp_path / f"{name}.camera.json").write_text('{"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}')
    few = config_file(tmp_path, random_starts=3, rounds=3, scan_points=300, model_points=150)
    words = ["-m", str(tmp_path / "model.npz"), "-o", str(tmp_path / "out"), "--config", str(few)]
    assert main(["complete", str(tmp_path / "one.png"), *words]) == 0
    done = load_completion(tmp_path / "out")
    assert np.linalg.norm(done.predicted.vertices - body.vertices, axis=1).mean() < 0.03
    assert (tmp_path / "out" / "report.html").exists()
    assert main(["complete", str(tmp_path / "wall.png"), *words[:3], str(tmp_path / "none"), *words[4:]]) == 1
    assert "nobody is in it" in capsys.readouterr().err
