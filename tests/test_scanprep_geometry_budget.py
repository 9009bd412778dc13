"""No file costs more than its size allows; `fuzz_bombs.py` has a hundred more."""
import gzip
import json
import time

import numpy as np
import pytest
from fuzz_bombs import CORNERS, FACES, HEAD, glb, scene, zeros

from model.statue.control.files import read_control
from scanprep.geometry import budget
from scanprep.geometry.budget import reading, spend
from scanprep.geometry.files import MeshFileError, list_files, read_mesh, read_points
from scanprep.geometry.format_common import load_bytes, polygons

VIEW = {"bufferView": 0, "componentType": 5126, "type": "VEC3"}
SKINNED = [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}}]}]
WEIGHTED = CORNERS + np.ones(12, "<f4").tobytes()
ARRAYS = [{**VIEW, "count": 3}, {"componentType": 5121, "type": "VEC4", "count": 3},
          {**VIEW, "type": "VEC4", "byteOffset": 36, "count": 3}]


@pytest.mark.parametrize(("name", "content", "words"), [
    ("internal.glb", lambda: glb({"buffers": [{}] * 50_000, "nodes": []}, bytes(10**5)), "more than .* MB of arrays"),
    ("weights.glb", lambda: scene([{"mesh": 0, "skin": 0}] + [{}] * 60_000, 3, WEIGHTED, list(range(60_001)),
                                  skins=[{"joints": list(range(1, 60_001))}], accessors=[
        zeros(20_000), {**zeros(20_000, "VEC4"), "componentType": 5121}, zeros(20_000, "VEC4")],
                                  meshes=SKINNED), "more than .* MB of arrays"),
    ("properties.ply", lambda: ("ply\nformat ascii 1.0\nelement vertex 1\n" + "property float x\n" * 100_000
                                + "end_header\n0\n").encode(), "expected 100000 values of element vertex"),
    ("a.ply.gz", lambda: gzip.compress((HEAD.format("binary_little_endian", 3) + FACES.format(3 * 10**6, "uchar"))
                                       .encode() + CORNERS + (b"\3" + bytes(12)) * (3 * 10**6)), "unpack to more"),
    # ten million faces, of one length but the last
    ("rows.ply.gz", lambda: gzip.compress((HEAD.format("binary_little_endian", 3) + FACES.format(10**7, "uchar"))
                                          .encode() + CORNERS + bytes(10**7 - 1) + b"\1" + bytes(4)),
     "show their parts more than")])
def test_small_files_fail_by_name_within_their_budget(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content())
    start = time.process_time()
    with pytest.raises(MeshFileError, match=words) as caught:
        read_points(tmp_path / name)
    assert name in str(caught.value) and time.process_time() - start < 8


def test_joints_below_hidden_nodes_that_hang_below_each_other(tmp_path):
    """The search for the joint above went round for ever."""
    (tmp_path / "control.glb").write_bytes(scene(
        [{"mesh": 0, "skin": 0}, {}, {"children": [3, 1]}, {"children": [2]}], binary=WEIGHTED, roots=[0, 1],
        skins=[{"joints": [1]}], meshes=SKINNED, accessors=ARRAYS))
    with pytest.raises(MeshFileError, match=r"control\.glb"):
        read_control(tmp_path / "control.glb")


def test_files_that_a_file_names_widen_its_budget_once(tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(10**6))
    tree = {"asset": {"version": "2.0"}, "nodes": [], "buffers": [{"uri": "a.bin"}] * 2000}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(MeshFileError, match=r"a\.gltf: its \d{7} bytes would make more than 238 MB"):
        read_mesh(tmp_path / "a.gltf")
    with reading(tmp_path / "a.gltf", MeshFileError):
        for _ in range(3):
            load_bytes(tmp_path / "a.bin")
        spend(memory=budget.FREE + 90 * 10**6)
        with pytest.raises(MeshFileError, match="MB of arrays"):
            spend(memory=10**8)
    spend(memory=10**15)                       # nothing is read


def test_seconds_are_of_the_processor_and_grow_with_the_file(tmp_path, monkeypatch):
    (tmp_path / "a.bin").write_bytes(bytes(2**20))
    now = time.thread_time()
    with reading(tmp_path / "a.bin", MeshFileError):
        monkeypatch.setattr(time, "thread_time", lambda: now + budget.SECONDS + 0.9 * budget.PER_MB)
        spend()
        monkeypatch.setattr(time, "thread_time", lambda: now + budget.SECONDS + 1.1 * budget.PER_MB)
        limit = budget.SECONDS + budget.PER_MB
        with pytest.raises(MeshFileError, match=rf"a\.bin: its 1048576 bytes take more than {limit:.0f} s"):
            spend()


def test_polygons_of_many_corners_that_meet_are_within_the_budget(tmp_path):
    """Every corner of every polygon was tried, and every vertex compared for each that it met."""
    n, rng = 4000, np.random.default_rng(0)
    rings = [rng.permutation(n)[1:] for _ in range(20)]
    (tmp_path / "a.off").write_bytes(bytes(10))
    start = time.process_time()
    with pytest.raises(MeshFileError, match=r"a\.off"), reading(tmp_path / "a.off", MeshFileError):
        polygons(tmp_path / "a.off", np.full(20, n - 1), np.concatenate(rings), n)
    assert time.process_time() - start < 8


def test_the_folder_goes_on(tmp_path):
    (tmp_path / "bomb.glb").write_bytes(glb({"buffers": [{}] * 50_000, "nodes": []}, bytes(10**5)))
    (tmp_path / "good.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    read = []
    for path in list_files(tmp_path, lambda path: True):
        try:
            read.append(len(read_mesh(path, "m").faces))
        except MeshFileError as error:
            read.append(path.name in str(error))
    assert read == [True, 1]
