"""Statues for other programs: GLB with images, read back by a reader of its own."""
import io
import json

import numpy as np
import pytest
from glb_reader import Glb
from PIL import Image

from model.rig import turn_up
from model.statue.control.chart import Chart
from model.statue.control.files import humanoid
from model.statue.detail.subdivision import subdivide_uniform
from model.statue.detail.texels import normal_image, vertex_of_row
from model.statue.files import ABOUT, KIND, load_statue, write_statue_glb
from model.statue.motion.motions import people_motion
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError
from scanprep.synthetic.people import synthesise_walk

NAMES = humanoid().skeleton.names


@pytest.fixture(scope="module")
def motion():
    return people_motion(humanoid(), np.zeros((17, 3)), *synthesise_walk(4, 4), 4.0)


@pytest.fixture(scope="module")
def detailed():
    """Two levels, with waves on the skin."""
    control = humanoid()
    fine = subdivide_uniform(control.mesh, control.chart, 2)
    smooth = fine.mesh(control.mesh)
    return fine, smooth.vertices + 0.004 * np.sin(60 * smooth.vertices[:, [2]]) * smooth.vertex_normals


def picture(glb, texture):
    view = glb.json["bufferViews"][glb.json["images"][glb.json["textures"][texture]["source"]]["bufferView"]]
    return np.asarray(Image.open(io.BytesIO(glb.buffer[view["byteOffset"]:view["byteOffset"] + view["byteLength"]])))


def places(image, uv):
    """Rows and columns of glTF's texture coordinates, whose (0, 0) is the upper left corner."""
    return np.clip((uv[:, ::-1] * image.shape[:2]).astype(int), 0, np.array(image.shape[:2]) - 1).T


def test_the_detailed_statue_moves_and_wears_its_texture(detailed, motion, tmp_path):
    control, (fine, vertices) = humanoid(), detailed
    rows, columns, face, bary = control.chart.texels(256)
    texture = np.zeros((256, 256, 3), np.uint8)
    texture[rows, columns] = 40 + 100 * np.einsum("nc,ncd->nd", bary, np.abs(control.mesh.corners[face]))
    write_statue_glb(tmp_path / "a.glb", control, vertices, fine, texture, motion=motion)
    glb = Glb((tmp_path / "a.glb").read_bytes())
    row = vertex_of_row(Mesh(vertices, fine.faces), fine.chart)
    assert len(row) > len(vertices) and np.array_equal(row[glb.faces], fine.faces)
    assert np.abs(glb.skinned() - vertices[row] @ turn_up(2).T).max() < 1e-6
    # joints carry the detail as they carry the control mesh below it
    corners = control.mesh.faces[fine.parent]
    for t in range(4):
        moved = glb.skinned(t) @ turn_up(2)
        below = np.einsum("nc,ncd->nd", fine.bary,
                          control.rig.vertices(motion.poses[t], motion.trans[t])[corners])[row]
        assert np.abs(moved - below).max() < 0.025 and np.linalg.norm(moved - below, axis=1).mean() < 0.006
    primitive = glb.primitive["attributes"]
    uv = glb.array(primitive["TEXCOORD_0"]).astype(float)
    image = picture(glb, glb.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"])
    assert np.array_equal(image, texture) and glb.json["images"][0]["mimeType"] == "image/png"
    seen = image[tuple(places(image, uv))]
    inside = seen.any(axis=1)
    on = 40 + 100 * np.abs(fine.points(control.mesh)[row])
    assert inside.mean() > 0.7 and np.median(np.abs(seen - on)[inside]) < 1.5
    # both sides of a seam shine alike
    normals = glb.array(primitive["NORMAL"])
    assert np.abs(normals - Mesh(vertices, fine.faces).vertex_normals[row] @ turn_up(2).T).max() < 1e-6


def test_the_control_mesh_with_images_of_detail(detailed, tmp_path):
    control, (fine, vertices) = humanoid(), detailed
    normals = normal_image(control, vertices, fine, 256)
    write_statue_glb(tmp_path / "a.glb", control, normals=normals, up=1)
    glb = Glb((tmp_path / "a.glb").read_bytes())
    material = glb.json["materials"][0]
    assert np.array_equal(picture(glb, material["normalTexture"]["index"]), normals)
    # with nothing but the file, the normals of the detail come back
    uv, n, t = (glb.array(glb.primitive["attributes"][name]).astype(float)
                for name in ("TEXCOORD_0", "NORMAL", "TANGENT"))
    chart = Chart(uv * [1, -1] + [0, 1], glb.faces)
    rows, columns, face, bary = chart.texels(256)
    N, T = (np.einsum("nc,ncd->nd", bary, w[glb.faces[face]]) for w in (n, t))
    B = np.cross(N, T[:, :3]) * np.sign(T[:, 3:])
    x, y, z = (normals[rows, columns].astype(float) / 127.5 - 1).T[..., None]
    shaded = x * T[:, :3] + y * B + z * N
    there = fine.chart.texels(256)
    detail = Mesh(vertices, fine.faces)
    exact = np.zeros((256, 256, 3))
    exact[there[0], there[1]] = np.einsum("nc,ncd->nd", there[3], detail.vertex_normals[detail.faces[there[2]]])
    cosine = np.einsum("nd,nd->n", shaded, exact[rows, columns])
    cosine /= np.linalg.norm(shaded, axis=1) * np.maximum(np.linalg.norm(exact[rows, columns], axis=1), 1e-9)
    flat = np.einsum("nd,nd->n", N, exact[rows, columns]) / np.linalg.norm(N, axis=1)
    assert np.degrees(np.arccos(np.clip(np.percentile(cosine, 1), -1, 1))) < 2
    assert np.degrees(np.arccos(np.clip(np.median(flat), -1, 1))) > 5, "there is detail that the mesh has not"


@pytest.mark.parametrize("about, words", [
    ({"kind": "model", "version": 1}, "expected a statue in JSON, found something else"),
    ({"kind": KIND, "version": 99}, "statue version 99 is not known here"), ([1], "found something else")])
def test_folders_of_something_else_are_refused(tmp_path, about, words):
    (tmp_path / ABOUT).write_text(json.dumps(about))
    with pytest.raises(StorageError, match=words):
        load_statue(tmp_path)
