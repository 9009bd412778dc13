"""MHR and SOMA-X through the optional library `body-models`, on small bodies made here in the layout of their files.

The files themselves cannot be had here: how near the real ones come nobody knows but by what every import measures.
"""
import importlib
import sys
from dataclasses import replace

import numpy as np
import pytest
from library_bodies import mhr_folder, soma_folder

from model.body_library import FOLDERS, Library, as_ours, import_any
from model.cli import group
from model.files import load_model

MAKERS = {"MHR": mhr_folder, "SOMA": soma_folder}
MODULES = {name: module for module, name in FOLDERS.values()}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The library, with a cache of its own, that may download nothing."""
    pytest.importorskip("body_models", reason="body-models is an extra")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr("body_models._cache.hf_hub_download", lambda *_, **__: pytest.fail("a download"))
        yield


@pytest.fixture(scope="module", params=[pytest.param(known, marks=pytest.mark.slow) for known in FOLDERS])
def both(request, library, tmp_path_factory):
    """The library's model of a small body, and ours by the command; the file by which a folder is known stands for it.
    """
    name = FOLDERS[request.param][1]
    folder = MAKERS[name](tmp_path_factory.mktemp(name) / "files")
    assert group(["import", str(folder / request.param), "-o", str(folder / "ours.npz")]) == 0
    return theirs(name, folder), load_model(folder / "ours.npz"), folder


def theirs(name, folder):
    return getattr(importlib.import_module(MODULES[name]), name)(model_path=folder)


def distances(body, model, spread, betas, seed=7):
    """(T, N) metres between a model and the library, in random poses and shapes of so many radians and deviations."""
    rng, C = np.random.default_rng(seed), body.rest.shape[1]
    units = body.directions[0]
    controls = body.draw(range(1, len(body.joints)), spread, 60, rng)
    b = betas * rng.normal(size=(60, len(units)))
    exact = body.vertices(controls + b @ units[:, :C], b @ units[:, C:])
    return np.linalg.norm(model.vertices(body.poses(controls), b) - exact, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MAKERS))
def test_what_is_blend_skinning_in_the_library_is_the_same_here(name, library, tmp_path):
    found = theirs(name, MAKERS[name](tmp_path / "files", plain=True))
    body, model = Library(found), as_ours(found, name)
    assert np.abs(model.correctives).max(initial=0) == 0
    assert distances(body, model, 0.5, 0.0).max() < 1e-6
    assert distances(body, model, 0.0, 0.1).max() < 2e-4          # shapes of SOMA-X turn its bones


def test_correctives_and_shapes_come_near_the_library(both):
    body, model = Library(both[0]), both[1]
    bare = replace(model, correctives=0 * model.correctives)
    assert distances(body, model, 0.3, 0.0).mean() < 0.6 * distances(body, bare, 0.3, 0.0).mean()
    error = distances(body, model, 0.3, 1.0).mean()
    assert error < 2.5e-3
    assert model.info["left_out_error"] == pytest.approx(error, rel=0.25)
    # what is left of shapes is of second order: a third of the betas leave a ninth of it
    assert distances(body, model, 0.0, 1 / 3).mean() < distances(body, model, 0.0, 1.0).mean() / 7


def test_joints_are_those_of_people(both):
    found, model, _ = both
    names = model.skeleton.names
    assert names[0] == "pelvis" and {"chest", "neck", "head", "thumb3_left", "index1_right", "toes_left"} <= set(names)
    for part, above in {"forearm_left": "upper_arm_left", "upper_arm_left": "shoulder_left", "shoulder_left": "chest",
                        "foot_right": "shin_right", "abdomen": "pelvis"}.items():
        assert names[model.skeleton.parents[names.index(part)]] == above
    assert not any("twist" in name or "eye" in name for name in names)
    A = model.joint_regressor
    np.testing.assert_allclose(A @ model.template.vertices, model.skeleton.joints, rtol=0, atol=1e-9)
    b = np.random.default_rng(0).normal(size=model.n_betas)
    np.testing.assert_allclose(A @ model.rest_vertices(b), model.rest_joints(b), rtol=0, atol=4e-3)
    sd = np.sqrt(np.diag(model.pose_covariance)).reshape(-1, 3).max(axis=1)
    assert sd[names.index("upper_arm_left")] > 0.3 and sd[names.index("index2_left")] == pytest.approx(0.05)
    bones = "lengths of bones" in model.info["notes"]
    assert bones == (type(found).__name__ == "MHR")


def test_the_command_tells_how_near(both):
    report = (both[2] / "ours.npz.report.json").read_text()
    assert "poses left out of the learning" in report and "no joints here" in report


@pytest.mark.parametrize("name, lost", [
    ("MHR", "corrective_activation.npz"), ("MHR", "corrective_blendshapes_lod1.npz"), ("SOMA", "correctives_model.pt")])
def test_a_folder_that_lacks_a_file_is_told(name, lost, library, tmp_path):
    folder = MAKERS[name](tmp_path / "files")
    (folder / lost).unlink()
    refused(folder, f"{folder}: expected the files of {name}.*{lost}")


def test_damaged_files_are_told(library, tmp_path):
    folder = mhr_folder(tmp_path / "mhr")
    shapes = folder / "corrective_blendshapes_lod1.npz"
    np.savez(shapes, corrective_blendshapes=np.full_like(np.load(shapes)["corrective_blendshapes"], np.nan))
    refused(folder, "expected the files of MHR.*not finite")
    (folder / "mhr_model.pt").write_bytes(b"no archive")
    refused(folder, "expected the files of MHR.*zip")
    folder = soma_folder(tmp_path / "soma")
    np.savez(folder / "SOMA_neutral.npz", mean=np.zeros((3, 3)))
    refused(folder, "expected the files of SOMA.*missing required NPZ fields")


def test_without_the_library_it_is_named(monkeypatch, tmp_path):
    (tmp_path / "mhr_model.pt").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "body_models", None)
    for name in MODULES.values():
        monkeypatch.setitem(sys.modules, name, None)
    refused(tmp_path, "MHR is read by a library that is not installed.*pip install body-models")


def refused(path, words):
    with pytest.raises(ValueError, match=words) as told:
        import_any(path)
    assert "\n" not in str(told.value)
