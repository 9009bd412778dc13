"""USD and FBX files, as the programs that they are for show them."""
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.export.cli import export
from model.export.conventions import aimed
from model.export.correctives import motion_correctives
from model.export.glb import write_skinned_glb
from model.export.usd import USD, write_points_usd, write_skinned_usd
from model.rig import joint_places, make_rig
from scanprep.command_line import run
from scanprep.geometry.format_glb import turn_up

BETAS = np.array([0.5, -1.0])
TIMES = np.arange(10)
RATE = 12.5
UP = turn_up(2)


@pytest.fixture(scope="module")
def model():
    return worm_model(rings=17)


@pytest.fixture(scope="module")
def subject(model):
    return model.subject(BETAS)


@pytest.fixture(scope="module")
def motion(model):
    """Ten frames that go over into each other, as programs between frames do."""
    rng = np.random.default_rng(0)
    ends = random_poses(model, 2, rng, 0.7)
    return ends[0] + TIMES[:, None, None] / 9 * (ends[1] - ends[0]), rng.normal(size=(10, 3))


@pytest.fixture(scope="module")
def rig(model, subject, motion):
    found = aimed(make_rig(model, BETAS, 2), 2)
    return replace(found, correctives=motion_correctives(found, subject, motion[0], 4))


@pytest.fixture
def usd():
    pytest.importorskip("pxr", reason="usd-core, the library of USD, is not installed")
    import usd_reader

    return usd_reader


def test_usd_skel_poses_the_body_as_we_do(tmp_path, usd, rig, motion):
    from pxr import Usd, UsdGeom

    for ending in USD:
        for up in ((0, 1, 2) if ending == ".usd" else (2,)):
            path = tmp_path / f"a{up}{ending}"
            write_skinned_usd(path, rig, *motion, RATE, up)
            expected = rig.vertices(*motion, rig.correctives.changes(TIMES)) @ turn_up(up).T
            assert np.abs(usd.skinned(path, TIMES) - expected).max() < 1e-5
            assert usd.complaints(path) == []
            stage = Usd.Stage.Open(str(path))
            assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == RATE
            assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 9)
            assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Y"
            box = np.array(UsdGeom.Boundable(stage.GetDefaultPrim()).GetExtentAttr().Get())
            skinned = rig.vertices(*motion) @ turn_up(up).T
            np.testing.assert_allclose(box, [skinned.min(axis=(0, 1)), skinned.max(axis=(0, 1))], atol=1e-5)
    assert len(list(tmp_path.iterdir())) == 6


def test_the_checker_would_find_what_is_wrong(tmp_path, usd):
    from pxr import Usd

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.GetRootLayer().Save()
    assert usd.complaints(tmp_path / "a.usda")


def test_at_rest_blend_shapes_are_betas_of_both_signs(tmp_path, usd, model, rig):
    write_skinned_usd(tmp_path / "a.usda", replace(rig, correctives=None), up=1)
    assert usd.complaints(tmp_path / "a.usda") == []
    np.testing.assert_allclose(usd.skinned(tmp_path / "a.usda", [0])[0], rig.mesh.vertices, atol=1e-6)
    for name, k, sign in (("beta_1_plus_3", 0, 3), ("beta_2_minus_3", 1, -3)):
        betas = BETAS + 0.5 * sign * np.eye(2)[k]
        np.testing.assert_allclose(usd.morphed(tmp_path / "a.usda", {name: 0.5}),
                                   model.vertices(np.zeros((4, 3)), betas), atol=1e-5)
    with pytest.raises(ValueError, match="correctives: expected the poses"):
        write_skinned_usd(tmp_path / "b.usda", rig)
    assert [p.name for p in tmp_path.iterdir()] == ["a.usda"]


def test_points_are_the_exact_body(tmp_path, usd, subject, motion):
    from pxr import Usd, UsdGeom

    exact = subject.vertices(*motion)
    for ending in USD:
        write_points_usd(tmp_path / f"a{ending}", subject.template, exact, 10, RATE)
        stage = Usd.Stage.Open(str(tmp_path / f"a{ending}"))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/body/mesh"))
        np.testing.assert_allclose(usd.shown(tmp_path / f"a{ending}", TIMES), exact @ turn_up(2).T, atol=1e-6)
        assert np.array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), subject.template.faces)
        assert mesh.GetSubdivisionSchemeAttr().Get() == "none" and usd.complaints(tmp_path / f"a{ending}") == []


def test_commands(tmp_path, model, motion, capsys, monkeypatch):
    model.save(tmp_path / "m.npz")
    np.savez(tmp_path / "w.npz", poses=motion[0].reshape(10, -1), trans=motion[1], betas=BETAS,
             mocap_frame_rate=np.array(RATE), surface_model_type=np.array("scape"))
    words = [str(tmp_path / "m.npz"), "--motion", str(tmp_path / "w.npz"), "--up", "z", "-o"]
    for wrong, told in ((["w.points.usd", "--root", "a"], "--root: it says nothing about a point cache"),
                        (["w.usd", "--unit", "cm"], "--unit: it says nothing about a usd")):
        assert run(export, "scape model export", [*words, str(tmp_path / wrong[0]), *wrong[1:]]) == 2
        assert told in capsys.readouterr().err
    assert run(export, "scape model export", [words[0], "-o", str(tmp_path / "w.points.usd")]) == 1
    assert "name it with --motion" in capsys.readouterr().err
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pxr", None)
        assert run(export, "scape model export", [*words, str(tmp_path / "w.usd")]) == 1
        assert "pip install 'scapekit[usd]'" in capsys.readouterr().err and not (tmp_path / "w.usd").exists()
    pytest.importorskip("pxr", reason="usd-core, the library of USD, is not installed")
    for name in ("w.usd", "w.points.usd"):
        assert run(export, "scape model export", [*words, str(tmp_path / name)]) == 0
        assert (tmp_path / f"{name}.report.json").exists()


@pytest.mark.parametrize("kind", ["skinned", "points"])
def test_blender_shows_the_same(tmp_path, usd, rig, subject, motion, kind):
    pytest.importorskip("bpy", reason="Blender as a module (pip install bpy)")
    from blender_reader import evaluated

    expected = rig.vertices(*motion, rig.correctives.changes(TIMES))
    if kind == "skinned":
        write_skinned_usd(tmp_path / "a.usd", rig, *motion, RATE)
    else:
        expected = subject.vertices(*motion)
        write_points_usd(tmp_path / "a.usd", subject.template, expected, 10, RATE)
    assert np.abs(evaluated(tmp_path / "a.usd", TIMES / RATE, None, RATE) - expected @ UP.T).max() < 5e-5
    if kind == "skinned":
        joints = joint_places(rig.skeleton, *motion) @ UP.T
        assert np.abs(evaluated(tmp_path / "a.usd", TIMES / RATE, rig.skeleton.names, RATE) - joints).max() < 1e-5


def test_the_way_to_fbx_of_the_readme(tmp_path, rig, motion):
    """The command of model/README.md, as it stands there but for the rate, makes an FBX file of the same motion."""
    pytest.importorskip("bpy", reason="Blender as a module (pip install bpy)")
    from blender_reader import evaluated

    told = re.search(r'blender --background --python-expr "(.*?)"', Path("model/README.md").read_text(), re.S)[1]
    assert "fps = 30" in told
    write_skinned_glb(tmp_path / "walk.glb", rig, *motion, 30.0)
    subprocess.run([sys.executable, "-c", told], cwd=tmp_path, check=True, capture_output=True, timeout=200)
    expected = rig.vertices(*motion, rig.correctives.changes(TIMES)) @ UP.T
    assert np.abs(evaluated(tmp_path / "walk.fbx", TIMES / 30, None, 30.0) - expected).max() < 1e-4
    joints = joint_places(rig.skeleton, *motion) @ UP.T
    assert np.abs(evaluated(tmp_path / "walk.fbx", TIMES / 30, rig.skeleton.names, 30.0) - joints).max() < 1e-4
