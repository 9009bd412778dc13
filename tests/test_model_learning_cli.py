"""`scape learn`: every kind, mixes and sexes, from a registered set and from plain folders."""
import json
from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from completion.__main__ import main
from model import LearnConfig, load_model
from model.learning.cli import learn
from model.learning.mixing import MIX
from model.learning.parts import choose_skeleton
from model.learning.skinning import SkinConfig
from scanprep import RegisteredSet, write_mesh
from scanprep.batch.opening import beside
from scanprep.cli import read_poses

QUICK = LearnConfig(refinements=1, components=4, prunings=(0.01,), ridges=(1e-3,))
SEXES = ["female", "male", "female", "male", "female", ""]


@pytest.fixture(scope="module")
def truth():
    return worm_model()


@pytest.fixture(scope="module")
def folder(truth, tmp_path_factory):
    """A registered set of one worm in twelve poses and of six others; as plain folders too."""
    rng = np.random.default_rng(0)
    place = tmp_path_factory.mktemp("learn")
    whole = RegisteredSet.create(place / "set", truth.template)
    poses = random_poses(truth, 12, rng, 0.4)
    poses[0] = 0
    for i, body in enumerate(truth.subject().vertices(poses)):
        whole = whole.add(f"pose{i:02d}", body, subject="anna", pose=str(i), sex="female")
        write_mesh(place / "poses" / f"pose{i:02d}.ply", truth.template.with_vertices(body))
    for i, sex in enumerate(SEXES):
        body = truth.vertices(random_poses(truth, 1, rng, 0.1)[0], rng.normal(size=3))
        whole = whole.add(f"person{i}", body, subject=f"p{i}", sex=sex)
        write_mesh(place / "people" / f"person{i}.ply", truth.template.with_vertices(body))
    whole.with_skeleton(truth.skeleton)
    truth.skeleton.save(place / "skeleton.json")
    return place


def learned(poses, output, *given, **named):
    """The command without its console."""
    with beside(output) as space:
        return learn(poses, output, *given, **named, space=space)


@pytest.mark.parametrize("kind", ["scape", "blendscape", "skinning"])
def test_every_kind_is_learned_and_read_again(folder, truth, tmp_path, kind):
    (folder / "set" / "landmarks.json").write_text("{}")                  # as of scans without landmarks
    path = tmp_path / f"{kind}.npz"
    outcome = learned(folder / "set", path, folder / "set", kind=kind, scape=QUICK,
                      skinning=SkinConfig(rounds=2, components=4))
    model = load_model(path)
    assert model.kind == kind and model.n_betas == 4 and model.skeleton.parents.tolist() == [-1, 0, 0, 2]
    figures = {m.name: m.value for m in outcome.metrics}
    assert figures["poses"] == 12 and figures["people"] == 7 and figures["kind"] == kind
    assert model.info["poses"] == 12 and len(model.info["digest"]) == 64 and model.info["landmarks"] == {}
    assert (tmp_path / f"{kind}.components.png").exists()
    body = truth.subject().vertices(random_poses(truth, 1, np.random.default_rng(3), 0.3)[0])
    off = np.linalg.norm(model.subject().vertices(np.zeros((4, 3))) - truth.template.vertices, axis=1).mean()
    assert off < 0.02 * np.ptp(body, axis=0).max()


@pytest.mark.parametrize("verdict", ["good", "check", "failed"])
def test_what_was_said_about_the_scans_holds_for_the_model(folder, tmp_path, verdict):
    reasons = [] if verdict == "good" else ["pose03: 8% of the scan lies off the template"]
    (folder / "set" / "report.json").write_text(json.dumps({"judgement": {"verdict": verdict, "reasons": reasons}}))
    outcome = learned(folder / "set", tmp_path / "m.npz", kind="skinning", skinning=SkinConfig(rounds=1, components=2))
    (folder / "set" / "report.json").unlink()
    assert any("pose03: 8% of the scan lies off" in why for why in outcome.judgement.reasons) == (verdict != "good")
    assert outcome.judgement.verdict == verdict if verdict != "good" else outcome.judgement.verdict != "failed"


def test_one_person_alone_shows_no_shapes(folder, tmp_path, monkeypatch):
    """It took as long as the skeleton takes to say so."""
    monkeypatch.setattr("model.learning.body.choose_skeleton", None)
    write_mesh(tmp_path / "one" / "anna.ply", RegisteredSet.load(folder / "set").template)
    with pytest.raises(ValueError, match="shapes: expected at least 2 people, got 1 in"):
        learned(folder / "poses", tmp_path / "m.npz", tmp_path / "one")


@pytest.mark.slow
def test_models_by_sex_stand_beside_the_neutral_one(folder, tmp_path):
    outcome = learned(folder / "set", tmp_path / "m.npz", folder / "set", by_sex=True, scape=QUICK)
    count = {name: load_model(tmp_path / f"m{name}.npz").info["shapes"] for name in ("", ".female", ".male")}
    assert count == {"": 7, ".female": 4, ".male": 2}                     # anna counts, the unknown one in none
    assert {m.name: m.value for m in outcome.metrics}["people of the male model"] == 2


@pytest.mark.slow
def test_sexes_of_a_plain_folder_come_from_a_table(folder, tmp_path):
    with pytest.raises(ValueError, match="write sexes"):
        learned(folder / "poses", tmp_path / "n.npz", folder / "people", skeleton=folder / "skeleton.json", by_sex=True)
    rows = "".join(f"person{i},{s}\n" for i, s in enumerate(SEXES))
    (folder / "people" / "sexes.csv").write_text(f"name,sex\n{rows}")
    learned(folder / "poses", tmp_path / "m.npz", folder / "people", skeleton=folder / "skeleton.json", by_sex=True,
            scape=QUICK)
    assert load_model(tmp_path / "m.female.npz").info["shapes"] == 3
    (folder / "people" / "sexes.csv").write_text("name,sex\nnobody,male\n")
    with pytest.raises(ValueError, match="none of its names"):
        learned(folder / "poses", tmp_path / "n.npz", folder / "people", skeleton=folder / "skeleton.json", by_sex=True)


@pytest.mark.slow
def test_a_mix_takes_every_mesh_of_the_set(folder, tmp_path):
    learned(folder / "set", tmp_path / "mix.npz", kind="mixed", mixed=replace(MIX, refinements=1, components=4))
    model = load_model(tmp_path / "mix.npz")
    assert model.info["bodies"] == 18 and model.info["people"] == 7 and model.n_betas == 4


def test_the_published_preset_learns_as_the_paper(folder, tmp_path, capsys):
    learn_set = ["learn", "--poses", str(folder / "set"), "--shapes", str(folder / "set"), "--preset", "published"]
    assert main([*learn_set, "-o", str(tmp_path / "m.npz")]) == 0
    assert load_model(tmp_path / "m.npz").info["pruning"] == LearnConfig.from_paper().prunings[0]
    assert main([*learn_set, "-o", str(tmp_path / "n.npz"), "--kind", "skinning"]) == 2
    assert "--kind skinning: the paper of --preset published has SCAPE alone" in capsys.readouterr().err


@pytest.mark.parametrize("given, words", [
    ({"kind": "mixed", "by_sex": True}, "--kind mixed"), ({"by_sex": True}, "--by-sex")])
def test_ways_of_learning_that_exclude_each_other(folder, tmp_path, given, words):
    with pytest.raises(ValueError, match=words):
        learned(folder / "set", tmp_path / "m.npz", **given)


def test_a_mix_wants_a_set_and_a_skeleton(folder, tmp_path):
    with pytest.raises(ValueError, match="registered set"):
        learned(folder / "poses", tmp_path / "m.npz", kind="mixed")


@pytest.mark.slow
def test_parts_are_found_where_none_are_given(folder, tmp_path):
    """Those that the search alone finds in the same poses."""
    outcome = learned(folder / "poses", tmp_path / "m.npz", scape=QUICK)
    template, poses, _ = read_poses(folder / "poses", None, None, None)
    found = len(choose_skeleton(template, poses).skeleton.parents)
    assert {m.name: m.value for m in outcome.metrics}["parts of the skeleton"] == found > 2
    assert json.loads(json.dumps(load_model(tmp_path / "m.npz").info))["shapes"] == 0
