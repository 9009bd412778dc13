"""`learn_body` and `choose_skeleton`: Python learns what the command learns."""
import json

import numpy as np
import pytest
from animal_bodies import Animal, random_pose
from model_bodies import random_poses, worm_model

from completion.__main__ import main
from model import LearnConfig, learn_body, load_built_in_model
from scanprep import Skeleton, read_mesh, write_mesh
from scanprep.cli import read_poses
from scanprep.skeleton.joints import joint_doubts, joint_gaps

QUICK = LearnConfig(refinements=0, components=4, prunings=(0.01,), ridges=(1e-3,))


@pytest.fixture
def folder(tmp_path):
    truth, rng = worm_model(rings=17), np.random.default_rng(0)
    poses = random_poses(truth, 5, rng, 0.4)
    poses[0] = 0
    for i, body in enumerate(truth.subject().vertices(poses)):
        write_mesh(tmp_path / "poses" / f"pose{i}.ply", truth.template.with_vertices(body))
    for i in range(4):
        body = truth.vertices(random_poses(truth, 1, rng, 0.1)[0], rng.normal(size=3))
        write_mesh(tmp_path / "people" / f"person{i}.ply", truth.template.with_vertices(body))
    (tmp_path / "quick.toml").write_text("""[scape]
refinements = 0
components = 4
prunings = [0.01]
ridges = [0.001]
""")
    return tmp_path


@pytest.mark.slow
def test_python_learns_the_bytes_of_the_command(folder):
    assert main(["learn", "--poses", str(folder / "poses"), "--shapes", str(folder / "people"), "--unit", "m",
                 "--config", str(folder / "quick.toml"), "-o", str(folder / "command.npz")]) == 0
    template, poses, _ = read_poses(folder / "poses", None, None, "m")
    people = np.stack([read_mesh(path, "m").vertices for path in sorted((folder / "people").glob("*.ply"))])
    learned = learn_body(template, poses, people, config=QUICK)
    learned.model.save(folder / "python.npz")
    assert (folder / "python.npz").read_bytes() == (folder / "command.npz").read_bytes()
    report = json.loads((folder / "command.npz.report.json").read_text())
    assert report["judgement"]["verdict"] == learned.judgement.verdict
    assert str(len(learned.choice.skeleton.parents)) in str(learned)


def test_a_joint_that_holds_nothing_together_is_named():
    """The head hangs on a fore leg: no point of both stays where the other is."""
    animal, rng = Animal(), np.random.default_rng(0)
    poses = np.stack([animal.posed(random_pose(rng)) for _ in range(8)])
    true = animal.skeleton
    assert joint_doubts(true, joint_gaps(animal.mesh, poses, true)) == []
    parents, head, leg = true.parents.copy(), true.names.index("head"), true.names.index("fore left cannon")
    order = [part for part in range(len(parents)) if part != head] + [head]      # a parent comes before its children
    number = np.argsort(order)
    parents[head] = leg
    wrong = Skeleton(number[true.part_of_face], np.where(parents[order] < 0, -1, number[parents[order]]),
                     true.joints[order], tuple(true.names[part] for part in order))
    doubt, = joint_doubts(wrong, joint_gaps(animal.mesh, poses, wrong))
    assert "head to fore left cannon" in doubt and "edit-skeleton" in doubt


@pytest.mark.parametrize("prior", ["auto", "none"])
def test_people_of_half_a_size_are_refused_with_a_prior_and_doubted_without(prior):
    people = load_built_in_model()
    poses = people.subject(None).vertices(people.pose_examples[:4])
    quick = LearnConfig(refinements=0, prunings=(0.01,), ridges=(0.01,))

    def learn(scale):
        return learn_body(people.template, scale * poses, None, people.skeleton, "scape", quick, prior).judgement

    if prior == "none":
        assert learn(0.5).reasons[0].startswith("the person is 0.8")
        assert not any("tall" in why for why in learn(1).reasons)
    else:
        with pytest.raises(ValueError, match=r"poses: the bodies are 0\.5 times as large as the template"):
            learn(0.5)
