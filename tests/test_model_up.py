"""Up of bodies that are longer than high: from the files, from `--up`, or from how they stand."""
import json

import numpy as np
import pytest
from animal_bodies import NAMES, ODD, PARENTS, Animal, random_pose
from bvh_reader import Bvh
from glb_reader import Glb

from completion.__main__ import main
from model import load_built_in_model, load_model
from scanprep import Mesh, RegisteredSet, read_mesh, write_mesh
from scanprep.geometry.files import read_registered
from scanprep.geometry.upright import find_up
from scanprep.pictures.camera import guess_upright, look_around
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import SyntheticPerson

WORDS = tuple(name.replace(" ", "_") for name in NAMES)
FEET = [p for p, name in enumerate(NAMES) if name.endswith("cannon")]


def walking_animal():
    """Template, ten poses (10, N, 3) and skeleton of an animal that stands along z and is longest along x."""
    animal, rng = Animal(), np.random.default_rng(0)
    poses = [0.4 * random_pose(rng) for _ in range(10)]
    for pose in poses:
        pose[0] = 0
    parts = animal.skeleton.part_of_face
    skeleton = Skeleton(parts, PARENTS, animal.bones[:, 0], WORDS).with_root_centred(animal.straight)
    return animal.straight, np.stack([animal.posed(pose) @ ODD for pose in poses]), skeleton


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("up")
    template, poses, skeleton = walking_animal()
    for i, vertices in enumerate((template.vertices, *poses)):
        write_mesh(place / "poses" / f"{i:02d}.ply", template.with_vertices(vertices))
    skeleton.save(place / "skeleton.json")
    (place / "quick.toml").write_text("[skinning]\nrounds = 1\ncorrectives = false\n")
    return place


def learn(folder, output, *more):
    assert main(["learn", "--poses", str(folder / "poses"), "--skeleton", str(folder / "skeleton.json"), "--unit", "m",
                 "--kind", "skinning", "--config", str(folder / "quick.toml"), "-o", str(output), *more]) == 0
    return load_model(output)


def heights(vertices, part, axis):
    """Mean height of the feet, and of the barrel."""
    return vertices[np.isin(part, FEET), axis].mean(), vertices[part == 0, axis].mean()


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_an_animal_stands_on_its_feet(axes):
    """Its longest axis is that of its back; the first pose alone, and poses, tell which axis is up."""
    template, poses, _ = walking_animal()
    body, up = template.with_vertices(template.vertices[:, axes]), axes.index(2)
    assert find_up(body).up == find_up(body, poses[..., axes]).up == guess_upright(find_up(body))[0] == up
    camera, = look_around(find_up(body), turns=(0,))
    assert np.array_equal(camera.vertical, np.eye(3)[up])
    # a body that crouches alone is not clear, with the other poses it is
    assert find_up(template.with_vertices(poses[0]), poses).up == 2


def test_people_keep_their_up():
    """The axis of the largest extent, in any axes and in the poses of the built-in people."""
    model, person = load_built_in_model(), SyntheticPerson().mesh
    bodies = model.subject(None).vertices(model.pose_examples[:24])
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        up = axes.index(2)
        assert find_up(person.with_vertices(person.vertices[:, axes])).up == up
        assert find_up(model.template.with_vertices(model.template.vertices[:, axes]), bodies[..., axes]).up == up


def test_the_model_keeps_up_and_all_files_follow(folder, tmp_path):
    """Feet are lowest where y is up: GLB of the body, BVH of its joints, and the mesh of one pose."""
    model = learn(folder, tmp_path / "model.npz")
    part = model.skeleton.part_of_vertex(model.template)
    assert model.template.up == 2
    for name in ("body.glb", "body.bvh"):
        assert main(["model", "export", str(tmp_path / "model.npz"), "--own-body", "-o", str(tmp_path / name)]) == 0
    assert main(["model", "mesh", str(tmp_path / "model.npz"), "--own-body", "-o", str(tmp_path / "mesh.glb")]) == 0
    skinned = Glb((tmp_path / "body.glb").read_bytes()).skinned()
    shown = Glb((tmp_path / "mesh.glb").read_bytes())
    for vertices in (skinned, shown.array(shown.primitive["attributes"]["POSITION"])):
        feet, barrel = heights(vertices, part, 1)
        assert feet < barrel - 0.3 and np.ptp(vertices[:, 1]) < np.ptp(vertices, axis=0).max()
    places = Bvh((tmp_path / "body.bvh").read_text()).positions(0)
    assert max(places[WORDS[p]][1] for p in FEET) < places["barrel"][1] - 10        # centimetres


def test_up_can_be_said(folder, tmp_path):
    assert learn(folder, tmp_path / "y.npz", "--up", "y").template.up == 1
    assert main(["model", "export", str(tmp_path / "y.npz"), "-o", str(tmp_path / "a.glb"), "--own-body", "--up", "z"]
                ) == 0
    assert Glb((tmp_path / "a.glb").read_bytes()).json["asset"]["extras"]["up"] == "z"


def test_files_say_up(folder, tmp_path):
    """GLB of other programs has y up; a registered set keeps the axis of its template."""
    body = walking_animal()[0]
    lying = body.with_vertices(body.vertices, 1)             # the feet look along z, the file says y
    write_mesh(tmp_path / "body.glb", lying)
    assert read_mesh(tmp_path / "body.glb", "m").up == 1
    RegisteredSet.create(tmp_path / "set", lying)
    assert RegisteredSet.load(tmp_path / "set").template.up == 1
    header = json.loads((tmp_path / "set" / "set.json").read_text())
    (tmp_path / "set" / "set.json").write_text(json.dumps(header | {"up": "w"}))
    with pytest.raises(ValueError, match="up: expected x, y or z, found 'w'"):
        RegisteredSet.load(tmp_path / "set")


@pytest.mark.slow
def test_a_man_in_any_pose_keeps_his_up(real_data):
    """Each of the poses of SCAPE as the template of all, bent ones too."""
    poses = read_registered(real_data / "scape_poses", "m")
    for vertices in poses.vertices:
        body = Mesh(vertices, poses.faces)
        assert find_up(body, poses.vertices).up == guess_upright(body)[0]
