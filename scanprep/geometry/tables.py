"""Tables as spreadsheets save them."""
from __future__ import annotations

import contextlib
import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .storage import LARGEST_TEXT, UTF_16, StorageError, read_bytes, taking_apart, write_file


def read_table(path: str | Path, columns: Sequence[str], needed: Sequence[str] | None = None
               ) -> list[tuple[int, dict[str, str]]]:
    """Lines and cells, by column, of a CSV table with a heading, as spreadsheets save it: see `table_rows`.

    Every one of `columns` is there, empty where the table does not have it, and other columns too. StorageError unless
    the table has the `needed` ones of them, or all, each once, and lines that are equally long.
    """
    _, rows = table_rows(path, read_bytes(path, f"a table with the columns {','.join(columns)}"))
    head = rows[0][1] if rows else []
    if not set(columns if needed is None else needed) <= set(head) or len(set(head)) < len(head):
        raise StorageError(f"{path}: line 1: expected the columns {','.join(columns)}, each once, "
                           f"found {','.join(head)[:80] or 'an empty file'}")
    for line, cells in rows:
        if len(cells) != len(head):
            raise StorageError(f"{path}: line {line}: expected {len(head)} values, found {len(cells)}")
    return [(line, {**dict.fromkeys(columns, ""), **dict(zip(head, cells, strict=True))}) for line, cells in rows[1:]]


# What spreadsheets take for a formula, and run: with an apostrophe in front it is text to them.
_FORMULA = re.compile(r"'*[=+\-@]")


def _as_cell(value: Any) -> Any:
    """A value as the cell of a table: text that begins as a formula does gets an apostrophe in front."""
    if not isinstance(value, str) or not _FORMULA.match(value):
        return value
    with contextlib.suppress(ValueError):
        float(value)                       # a number with a sign stays one
        return value
    return "'" + value


def _of_cell(cell: str) -> str:
    """What `_as_cell` was given."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def write_table(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV table, whole or not at all; `read_table` gives back the same text."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(header)
    table.writerows(map(_as_cell, row) for row in rows)
    write_file(path, text.getvalue())


def number_lines(rows: np.ndarray, number: str = "%.6g", separator: str = ",") -> list[str]:
    """A line of text for each row (K,) of numbers, all printed as `number` says; nothing where one is NaN."""
    line = separator.join([number] * rows.shape[1])
    return [(line % tuple(row.tolist())).replace("nan", "") for row in rows]


def number_table(header: Sequence[str], rows: np.ndarray, number: str = "%.6g") -> str:
    """A CSV table of numbers (T, K), K at least 2: `number_lines` below a heading."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(map(_as_cell, header))
    return "\n".join([text.getvalue()[:-1], *number_lines(rows, number), ""])


def table_rows(path: str | Path, data: bytes, error: type[StorageError] = StorageError, separators: str = ",;\t"
               ) -> tuple[str, list[tuple[int, list[str]]]]:
    """The separator of a CSV table, and the number and cells of each line that is not empty.

    UTF-8 with or without a mark, UTF-16 with one, or the Windows alphabet of western Europe. The separator is the one
    of `separators` that comes most often in the first line, the earlier one of two. Empty cells beyond the end of the
    first line are left out.
    """
    with taking_apart(path, "a CSV table", error):
        text = decode_text(data)
        separator = max(separators, key=text.split("\n", 1)[0].count)
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        rows = [(reader.line_num, [_of_cell(cell.strip()) for cell in cells]) for cells in reader]
    width = 0
    for _, cells in rows:
        while len(cells) > width and not cells[-1]:
            cells.pop()
        width = width or len(cells)
    return separator, [(line, cells) for line, cells in rows if any(cells)]


# How programs print a number that there is none of, in small letters.
_NONE = {"", "nan", "-nan", "nan(ind)", "-nan(ind)", "nan(snan)", "-nan(snan)", "1.#qnan", "-1.#qnan", "1.#ind",
         "-1.#ind", "1.#snan", "null", "none", "na", "n/a", "-", "--", "#n/a"}


def number_cells(cells: Sequence[str], decimal_commas: bool = False) -> list[float]:
    """The numbers of some cells, NaN for an empty one and for what programs print there; ValueError for other text."""
    out = []
    for cell in cells:
        try:
            out.append(float(cell))
        except ValueError:
            word = cell.strip().lower()
            out.append(np.nan if word in _NONE else float(word.replace(",", ".") if decimal_commas else word))
    return out


def decode_text(data: bytes) -> str:
    """Text of a file as programs save it, without a mark of its encoding; ValueError for what is none, or too long."""
    if len(data) > LARGEST_TEXT:
        raise ValueError(f"{len(data)} bytes, more than {LARGEST_TEXT}")
    if data[:2] in UTF_16:
        return data.decode("utf-16")
    if b"\0" in data:
        raise ValueError("it is not text")
    for encoding in ("utf-8-sig", "cp1252"):
        with contextlib.suppress(UnicodeDecodeError):
            return data.decode(encoding)
    return data.decode("latin-1")
