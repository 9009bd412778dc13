"""Stored files: what goes in comes out, nothing is half written, and damage is named."""
import json
import pickle

import numpy as np
import pytest

from scanprep.geometry import storage
from scanprep.geometry.storage import StorageError

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([], dtype=np.int64), "c": np.array(["x", "yz"])}


def test_arrays_and_header_come_back(tmp_path):
    storage.save(tmp_path / "deep" / "m.npz", "model", 3, ARRAYS, {"name": "é", "list": [1, None]})
    header, arrays = storage.load(tmp_path / "deep" / "m.npz", "model", (2, 3))
    assert header == {"kind": "model", "version": 3, "name": "é", "list": [1, None]}
    assert set(arrays) == set(ARRAYS)
    for name, value in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], value)
        assert arrays[name].dtype == value.dtype


def test_no_objects_go_in_and_no_pickle_is_loaded(tmp_path):
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        storage.save(tmp_path / "m.npz", "model", 1, {"a": np.array([{}])})
    assert list(tmp_path.iterdir()) == []
    np.savez(tmp_path / "evil.npz", header=np.array([json.dumps({"kind": "model"})], dtype=object))
    with pytest.raises(StorageError, match=r"evil\.npz"):
        storage.load(tmp_path / "evil.npz", "model", (1,))
    (tmp_path / "p.npz").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(StorageError, match=r"p\.npz"):
        storage.load(tmp_path / "p.npz", "model", (1,))


@pytest.mark.parametrize("part", [0, 0.1, 0.5, 0.9, 0.99])
def test_a_file_cut_off_is_refused(tmp_path, part):
    storage.save(tmp_path / "m.npz", "model", 1, {"a": np.random.default_rng(0).random(2000)})
    data = (tmp_path / "m.npz").read_bytes()
    (tmp_path / "m.npz").write_bytes(data[:int(part * len(data))])
    with pytest.raises(StorageError, match=r"m\.npz: expected a model file, cannot read it"):
        storage.load(tmp_path / "m.npz", "model", (1,))


def test_damaged_bytes_inside_are_refused(tmp_path):
    storage.save(tmp_path / "m.npz", "model", 1, {"a": np.random.default_rng(0).random(2000)})
    data = bytearray((tmp_path / "m.npz").read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "m.npz").write_bytes(bytes(data))
    with pytest.raises(StorageError, match=r"m\.npz"):
        storage.load(tmp_path / "m.npz", "model", (1,))


def test_missing_other_kind_other_version_no_header(tmp_path):
    with pytest.raises(StorageError, match=r"none\.npz: no such file"):
        storage.load(tmp_path / "none.npz", "model", (1,))
    storage.save(tmp_path / "m.npz", "model", 9, {})
    with pytest.raises(StorageError, match=r"m\.npz: expected kind 'skeleton', found 'model'"):
        storage.load(tmp_path / "m.npz", "skeleton", (9,))
    with pytest.raises(StorageError, match=r"m\.npz: model version 9 is not known here \(known: 1, 2\)"):
        storage.load(tmp_path / "m.npz", "model", (1, 2))
    np.savez(tmp_path / "plain.npz", a=np.ones(2))
    with pytest.raises(StorageError, match=r"plain\.npz: .* without a header"):
        storage.load(tmp_path / "plain.npz", "model", (1,))


def test_writing_is_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.json"
    storage.write_json(path, {"old": 1})
    with pytest.raises(RuntimeError, match="interrupted"), storage.writing(path) as beside:
        beside.write_text("half")
        assert json.loads(path.read_text()) == {"old": 1}
        raise RuntimeError("interrupted")
    assert json.loads(path.read_text()) == {"old": 1} and [p.name for p in tmp_path.iterdir()] == ["a.json"]
    with pytest.raises(TypeError):
        storage.write_json(path, {"bad": object()})
    assert json.loads(path.read_text()) == {"old": 1}
    storage.write_json(path, {"new": 2})
    assert json.loads(path.read_text()) == {"new": 2} and len(list(tmp_path.iterdir())) == 1
