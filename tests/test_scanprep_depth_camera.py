import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from model.fitting.free_space import PictureView
from model.fitting.upright import PICTURE, Upright
from scanprep.depth_camera.person import room_planes, segment_person
from scanprep.depth_camera.picture import DepthPicture, read_depth
from scanprep.geometry import rotations
from scanprep.synthetic.people import SyntheticPerson

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
ROW, COLUMN = np.indices((240, 320))
SIZE = 1.4                                       # metres, the root of a man's surface area


def room():
    """A wall at 3 m and a floor 1 m below the camera."""
    rays = DepthPicture(np.ones((240, 320)), K).directions(COLUMN, ROW)
    with np.errstate(divide="ignore"):
        return np.minimum(3.0, np.where(rays[..., 1] > 0, 1.0 / rays[..., 1], np.inf))


def standing(depth, column, half_width, top=40, away=1.5):
    """The picture with something round in front, cut off by its lower border."""
    beside = (COLUMN - column) / (half_width * 300 / away)
    inside = (np.abs(beside) < 1) & (top < ROW)
    return np.where(inside, away - 0.7 * half_width * np.sqrt(np.maximum(1 - beside**2, 0)), depth)


def test_a_point_projects_to_its_pixel():
    picture = DepthPicture.of(room(), K)
    row, column, inside = picture.project(picture.points())
    assert inside.all() and (row == ROW).all() and (column == COLUMN).all()
    outside = np.array([[0.0, 0, -1], [2.0, 0, 1], [0, -2.0, 1]])
    assert not picture.project(outside)[2].any()


def test_a_pixel_of_a_halved_picture_is_the_middle_of_four():
    picture = DepthPicture.of(np.full((240, 320), 2.0), K)
    small = picture.halve()
    row, column = np.indices((120, 160))
    assert (small.depth == 2).all()
    np.testing.assert_allclose(small.directions(column, row), picture.directions(2 * column + 0.5, 2 * row + 0.5))


def test_normals_are_those_of_the_plane():
    normal = np.array([0.3, -0.2, -1])
    normal /= np.linalg.norm(normal)
    rays = DepthPicture(np.ones((240, 320)), K).directions(COLUMN, ROW)
    found = DepthPicture.of(-2 / (rays @ normal), K).normals()
    np.testing.assert_allclose(found[3:-3, 3:-3], np.broadcast_to(normal, (234, 314, 3)), atol=1e-6)


def test_what_hangs_between_two_surfaces_is_dropped():
    depth = standing(room(), 160, 0.2)
    flying = np.zeros(depth.shape, dtype=bool)
    flying[60:200:7, 118:122] = True             # a column of them at the left edge, which is at 119.5
    clean = DepthPicture.of(np.where(flying, 2.2, depth), K).without_flying_pixels()
    assert not clean.seen[flying].any()
    assert clean.seen[60:, 125:195].all() and clean.seen[60:, :100].mean() > 0.99


def test_floor_and_wall_are_planes_and_a_person_is_not():
    picture = DepthPicture.of(standing(room(), 160, 0.2), K)
    planes, person = room_planes(picture, SIZE), picture.depth < 1.5
    assert planes[~person].mean() > 0.98 and planes[person].mean() < 0.02


def test_the_person_is_found():
    noise = np.random.default_rng(0).normal(size=(240, 320)) * 0.0015
    depth = standing(room(), 160, 0.2)
    found = segment_person(DepthPicture.of(depth + noise * depth**2, K), SIZE)
    truth = (depth < 1.55)[::2, ::2]
    assert (found.mask & truth).sum() > 0.93 * truth.sum() and (found.mask & ~truth).sum() < 0.05 * truth.sum()
    points, normals, edge = found.points_and_normals()
    assert (np.einsum("nd,nd->n", points, normals) < 0).mean() > 0.99 and 0 < edge.mean() < 0.2


@pytest.mark.parametrize(("depth", "words"), [
    (room(), "nobody"),
    (standing(room(), 160, 0.07), "only a part of a body"),
    (standing(standing(room(), 60, 0.2), 250, 0.2), "2 people"),
    (standing(standing(room(), 90, 0.4), 230, 0.4), "more than a person"),
], ids=["nobody", "a leg", "two", "too large"])
def test_a_picture_of_anything_else_is_refused_with_the_reason(depth, words):
    with pytest.raises(ValueError, match=words):
        segment_person(DepthPicture.of(depth, K), SIZE)


def test_landmarks_say_who_of_two_is_meant():
    picture = DepthPicture.of(standing(standing(room(), 60, 0.2), 250, 0.2), K)
    marks = picture.points()[[80, 120, 200], [250, 240, 260]]
    found = segment_person(picture, SIZE, marks)
    assert found.mask[:, 90:].any() and not found.mask[:, :60].any()


def test_a_body_may_be_behind_what_was_seen_and_beyond_the_border():
    view = PictureView(segment_person(DepthPicture.of(standing(room(), 160, 0.2), K), SIZE))
    places = np.array([[0, 0, 1.6], [0, 1.5, 1.5], [0, 0, 1.1], [0.5, 0, 1.5], [0.5, 0, 3.5], [0, 0, -1.0]])
    behind, beyond, before, beside, in_the_wall, at_the_back = view.violation(places).excess
    assert behind == beyond == in_the_wall == at_the_back == 0
    assert before == pytest.approx(1.36 - 1.1 - 0.03, abs=0.01)
    assert beside == pytest.approx(0.5 - 0.2 - 0.03, abs=0.03)
    reached = view.violation(places)
    assert (view.violation(reached.target).excess < 0.01).all()


def test_rotations_that_stand():
    spread = rotations.exp(np.random.default_rng(0).uniform(-3, 3, (500, 3)))
    one = Upright(np.array([[0, -1.0, 0]]), np.array([0, 0, 1.0]))
    assert ((one.rotations(spread) @ [0, 0, 1.0])[:, 1] < -0.8).all()
    four = Upright(PICTURE, np.array([0, 0, 1.0]))
    assert len(four.rotations(spread)) > 2 * len(one.rotations(spread)) > 10
    x = np.zeros((1, 9))
    x[0, :3] = [np.pi / 2 - 0.3, 0, 0]           # z to -y, nearly
    np.testing.assert_allclose(four.nearest(x)[0], [0, -1, 0])


def test_a_depth_picture_is_read_with_its_camera(tmp_path):
    path, camera = tmp_path / "one.png", tmp_path / "one.camera.json"
    depth = standing(room(), 160, 0.2)
    depth[:5] = 0
    Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(path)
    with pytest.raises(ValueError, match="expected its camera in"):
        read_depth(path)
    for told in ({"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}, {"intrinsic_matrix": K.T.ravel().tolist()}):
        camera.write_text(json.dumps(told))
        picture = read_depth(path)
        np.testing.assert_allclose(picture.intrinsics, K)
        assert not picture.seen[:5].any()
        np.testing.assert_allclose(picture.depth[5:], depth[5:], atol=5.1e-4)
    camera.write_text('{"fx": 300}')
    with pytest.raises(ValueError, match="expected fx, fy, cx and cy"):
        read_depth(path)
    with pytest.raises(ValueError, match="expected metres"):
        DepthPicture.of(1000 * depth, K)


@pytest.mark.parametrize("spell", [str, lambda name: "_".join(name.split("_")[::-1]) if name.endswith("t") else name,
                                   lambda name: re.sub(r"(.*)_(l|r)(eft|ight)$", r"\2_\1", name)],
                         ids=["ours", "side first", "of old"])
def test_which_way_is_up_in_a_body_whatever_its_parts_are_called(spell):
    """Also the built-in people, whose thighs were called l_thigh: --up was refused with them."""
    person = SyntheticPerson()
    skeleton = replace(person.skeleton, names=tuple(map(spell, person.names)))
    found = Upright.of(person.mesh, skeleton, (0.0, 2.0, 0.0), picture=False)
    assert found is not None and (found.of_body == [0, 0, 1]).all() and (found.ups == [[0, 1, 0]]).all()
