"""Stored files: what goes in comes out, nothing is half written, and damage is named."""
import json
import pickle

import numpy as np
import pytest

from scanprep.geometry import storage, tables
from scanprep.geometry.storage import StorageError


def test_no_objects_go_in_and_no_pickle_is_loaded(tmp_path):
    with pytest.raises(ValueError, match=r"m\.npz: .*a holds objects"):
        storage.save(tmp_path / "m.npz", "model", 1, {"a": np.array([{}])})
    assert list(tmp_path.iterdir()) == []
    np.savez(tmp_path / "evil.npz", header=np.array([json.dumps({"kind": "model"})], dtype=object))
    with pytest.raises(StorageError, match=r"evil\.npz"):
        storage.load(tmp_path / "evil.npz", "model", (1,))
    (tmp_path / "p.npz").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(StorageError, match=r"p\.npz"):
        storage.load(tmp_path / "p.npz", "model", (1,))


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


def test_json_has_null_for_what_is_not_finite(tmp_path):
    value = {"a": [1.5, float("nan")], "b": (float("inf"), {"c": np.float64(-np.inf)}), "d": "NaN"}
    storage.write_json(tmp_path / "a.json", value)
    plain = {"a": [1.5, None], "b": [None, {"c": None}], "d": "NaN"}
    assert json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail) == plain == storage.as_json(value)
    assert storage.read_json(tmp_path / "a.json", "a tree") == plain


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_json_in_the_alphabets_of_editors(tmp_path, encoding):
    (tmp_path / "a.json").write_bytes('{"Zoë": 1}'.encode(encoding))
    assert storage.read_json(tmp_path / "a.json", "a tree") == {"Zoë": 1}


@pytest.mark.parametrize(("content", "words"), [
    (b'{"a": NaN}', "NaN is not a finite number"), (b'{"a": 1e999}', "1e999 is not a finite number"),
    (b"{\"Zo\xeb\": 1}", "not saved as UTF-8: byte 4"), (b"[" * 10**6, "nested too deeply"), (b"", "Expecting"),
])
def test_json_that_cannot_be_read(tmp_path, content, words):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(StorageError, match=rf"a\.json: expected a tree in JSON, .*{words}"):
        storage.read_json(tmp_path / "a.json", "a tree")
    with pytest.raises(StorageError, match=r"none\.json: no such file; expected a tree"):
        storage.read_json(tmp_path / "none.json", "a tree")


TABLE = "name{0}sex{0} note\r\nZoë{0}f{0}\r\n{0}{0}\r\n Ann {0}m{0}x\r\n"


def test_numbers_are_printed_as_one_by_one_and_nothing_for_nan():
    rows = np.array([[0.1, -2e-9, np.nan, 1234567.0], [np.nan, -0.0, np.inf, 5.0]])
    wanted = [["" if np.isnan(value) else f"{value:.6g}" for value in row] for row in rows]
    assert tables.number_lines(rows, separator="\t") == ["\t".join(row) for row in wanted]
    assert tables.number_table(("a", "nan", 'b "c", d', "e"), rows) == (
        'a,nan,"b ""c"", d",e\n' + "".join(",".join(row) + "\n" for row in wanted))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252", "latin-1"])
def test_tables_as_spreadsheets_save_them(tmp_path, separator, encoding):
    (tmp_path / "a.csv").write_bytes((TABLE.format(separator)).encode(encoding))
    rows = tables.read_table(tmp_path / "a.csv", ("name", "sex", "age"), ("name",))
    assert rows == [(2, {"name": "Zoë", "sex": "f", "age": "", "note": ""}),
                    (4, {"name": "Ann", "sex": "m", "age": "", "note": "x"})]


@pytest.mark.parametrize(("content", "words"), [
    ("", "line 1: expected the columns name,sex, each once, found an empty file"), ("a,b\n", "line 1: .* found a,b"),
    ('"a\nb",c\n', r"line 1: .* found a\\nb,c$"),
    ("name,sex,name\n", "line 1: .* each once"), ("name,sex\na,b\nc\n", "line 3: expected 2 values, found 1"),
    ("name,sex\na,b,c\n", "line 2: expected 2 values, found 3"), ("name,sex\n\0,b\n", ".*it is not text"),
    ('name,sex\n"' + "x" * 200_000 + '",b\n', ".*field larger"),
])
def test_tables_that_cannot_be_read(tmp_path, content, words):
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(StorageError, match=rf"a\.csv: {words}"):
        tables.read_table(tmp_path / "a.csv", ("name", "sex"))


def test_arrays_come_back_as_they_were(tmp_path):
    arrays = {"f": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "none": np.zeros((0, 4)), "one": np.array(2),
              "big": np.arange(3, dtype=">i4"), "words": np.array(["a", "ßé"]), "yes": np.array([True, False])}
    storage.save(tmp_path / "a.npz", "thing", 1, arrays)
    back = storage.load_arrays(tmp_path / "a.npz")
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array)
        assert back[name].dtype == array.dtype and back[name].flags.writeable
