"""A result that means nothing is said in the first line, with the likely cause and exit code 1; the files are there."""

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior

from completion import MarkerLayout, MarkerSequence, write_markers
from completion.__main__ import main
from scanprep import Mesh, write_landmarks, write_mesh
from scanprep.geometry.files import PointCloud, write_points

MARKS = {"head": 10, "tail": 380, "left": 100, "right": 200, "middle": 250}
LAYOUT = np.random.default_rng(4).choice(396, 30, replace=False)


def ball(count=3000, radius=0.4):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1)[:, None]


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = worm_with_prior()
    body = model.template
    model.info["landmarks"] = MARKS
    model.save("model.npz")
    write_mesh("template.ply", body)
    write_landmarks("template.landmarks.json", MARKS)
    moved = body.with_vertices(body.vertices * [1, 1.05, 0.97] + [0, 0, 0.05])
    write_mesh("good.ply", moved)
    write_landmarks("good.json", {name: moved.vertices[v] for name, v in MARKS.items()})
    write_points("ball.ply", PointCloud(ball() + body.vertices.mean(axis=0)))
    write_points("ten.ply", PointCloud(moved.vertices[::40]))
    write_mesh("large.ply", Mesh(30 * moved.vertices, moved.faces))
    write_landmarks("large.json", {name: 30 * moved.vertices[v] for name, v in MARKS.items()})
    write_points("half.ply", PointCloud(half_view(body, np.array([0.0, -1.0, 0.0]))[0]))
    layout = MarkerLayout(tuple(f"M{i}" for i in range(30)), LAYOUT, 0.012)
    layout.save("layout.json")
    MarkerLayout(tuple(np.random.default_rng(1).permutation(layout.labels)), LAYOUT, 0.012).save("other.json")
    t = np.arange(12) / 30
    poses = model.pose_mean_turns() if hasattr(model, "pose_mean_turns") else np.zeros((12, 4, 3))
    poses = poses + np.sin(3 * t[:, None, None]) * 0.1
    meshes = model.subject(np.zeros(3)).vertices(poses, np.stack([t, 0 * t, 0 * t], axis=1))
    write_markers("walk.csv", MarkerSequence(np.stack([layout.place(body.with_vertices(v)) for v in meshes]),
                                             layout.labels, 30.0))
    return tmp_path


REGISTER = "prep register {} --template template.ply -o out.ply"
COMPLETE = "complete {} -m model.npz --subject template -o out"
ANIMATE = "animate walk.csv -m model.npz --layout {} -o out --start-axes 1 --keys 6 --subject template"
NOTHING = {
    "a ball to register": (REGISTER.format("ball.ply"), ["% of the scan lies off", "something else"]),
    "ten points to register": (REGISTER.format("ten.ply"), ["has data", "too few points"]),
    "another unit to register": (REGISTER.format("large.ply") + " --landmarks large.json", ["--unit"]),
    "a ball to align": ("prep align ball_mesh.ply good.ply -o out.ply", ["apart"]),
    "another unit to align": ("prep align large.ply good.ply -o out.ply", ["--unit"]),
    "a ball to complete": (COMPLETE.format("ball.ply"), ["explains", "something else"]),
    "another unit to complete": (COMPLETE.format("half.ply") + " --unit in", ["--unit"]),
    "another unit to animate": (ANIMATE.format("layout.json") + " --unit in", ["--unit"]),
    "another layout to animate": (ANIMATE.format("other.json"), ["mm from where the body has them", "another layout"]),
}
GOOD = {
    "register": REGISTER.format("good.ply"),
    "register with landmarks": REGISTER.format("good.ply") + " --landmarks good.json",
    "align": "prep align good.ply template.ply -o out.ply",
    "complete": COMPLETE.format("half.ply"),
    "animate": ANIMATE.format("layout.json"),
}


@pytest.mark.parametrize("case", NOTHING)
def test_nothing_is_said_first(place, capsys, case):

    command, words = NOTHING[case]
    if "ball_mesh" in command:
        from matching_bodies import sphere
        write_mesh("ball_mesh.ply", sphere())
    code = main(command.split())
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("scape ")]
    print(case, code, said)
    assert code == 1


@pytest.mark.parametrize("case", GOOD)
def test_good_results_stay_good(place, capsys, case):
    code = main(GOOD[case].split())
    said = capsys.readouterr().err
    print(case, code, said)
    assert code == 0
