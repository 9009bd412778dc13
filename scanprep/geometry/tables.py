"""Read and write CSV tables, as spreadsheets save them."""
from __future__ import annotations

import contextlib
import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from .storage import LARGEST_TEXT, UTF_16, StorageError, read_bytes, taking_apart, write_file


def read_table(path: str | Path, columns: Sequence[str], needed: Sequence[str] | None = None
               ) -> list[tuple[int, dict[str, str]]]:
    """Read a CSV table with a heading: line numbers, and cells by column; see `table_rows`.

    Missing `columns` are empty; other columns are returned too. StorageError unless the table has the `needed` columns,
    by default all, each once, and rows of equal length.
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


# spreadsheets run this as a formula, or strip it and then do; with an apostrophe in front it is text
_FORMULA = re.compile(r"'*(\s*[=+\-@]|[\t\r])")


def _as_cell(value: Any) -> Any:
    """Convert a value to a cell; text that begins like a formula gets an apostrophe in front."""
    if not isinstance(value, str) or not _FORMULA.match(value):
        return value
    with contextlib.suppress(ValueError):
        if not value[0].isspace():
            float(value)                   # a number with a sign stays one
            return value
    return "'" + value


def text_of_cell(cell: str) -> str:
    """Return the text for which `csv_text` wrote a cell."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def write_table(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV table, atomically; `read_table` gives back the same text."""
    write_file(path, csv_text([header, *rows]))


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Encode rows as CSV, with text that begins like a formula as text; `text_of_cell` undoes it."""
    lines = list[str]()
    # before Python 3.13 a carriage return is quoted only where it ends lines
    out = SimpleNamespace(write=lambda line: lines.append(line.removesuffix("\r\n") + "\n"))
    csv.writer(out, lineterminator="\r\n").writerows(map(_as_cell, row) for row in rows)
    return "".join(lines)


def number_lines(rows: np.ndarray, number: str = "%.6g", separator: str = ",") -> list[str]:
    """Format each row (K,) of numbers as a line, with the format `number`; NaN becomes an empty cell."""
    line = separator.join([number] * rows.shape[1])
    return [(line % tuple(row.tolist())).replace("nan", "") for row in rows]


def number_table(header: Sequence[str], rows: np.ndarray, number: str = "%.6g") -> str:
    """Format a CSV table of numbers (T, K), K at least 2: a heading and `number_lines`."""
    return csv_text([header]) + "\n".join([*number_lines(rows, number), ""])


def table_rows(path: str | Path, data: bytes, error: type[StorageError] = StorageError, separators: str = ",;\t"
               ) -> tuple[str, list[tuple[int, list[str]]]]:
    """Split a CSV table: its separator, and number and cells of each non-empty line.

    Encodings: UTF-8 with or without byte order mark, UTF-16 with one, or Windows-1252. The separator is the most
    frequent of `separators` in the first line. Empty cells beyond the width of the first line are dropped.
    """
    with taking_apart(path, "a CSV table", error):
        text = decode_text(data)
        separator = max(separators, key=text.split("\n", 1)[0].count)
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
        rows = [(reader.line_num, [text_of_cell(cell.strip()) for cell in cells]) for cells in reader]
    width = 0
    for _, cells in rows:
        while len(cells) > width and not cells[-1]:
            cells.pop()
        width = width or len(cells)
    return separator, [(line, cells) for line, cells in rows if any(cells)]


# how programs print a missing number, in lower case
_NONE = {"", "nan", "-nan", "nan(ind)", "-nan(ind)", "nan(snan)", "-nan(snan)", "1.#qnan", "-1.#qnan", "1.#ind",
         "-1.#ind", "1.#snan", "null", "none", "na", "n/a", "-", "--", "#n/a"}


def number_cells(cells: Sequence[str], decimal_commas: bool = False) -> list[float]:
    """Convert cells to numbers, NaN for empty cells and missing values; ValueError for other text."""
    out = []
    for cell in cells:
        try:
            out.append(float(cell))
        except ValueError:
            word = cell.strip().lower()
            out.append(np.nan if word in _NONE else float(word.replace(",", ".") if decimal_commas else word))
    return out


def decode_text(data: bytes) -> str:
    """Decode the text of a file, without byte order mark; ValueError if it is no text, or too long."""
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


def table_numbers(path: Path, rows: Sequence[tuple[int, Sequence[str]]], width: int, separator: str, fill: bool = False,
                  error: type[StorageError] = StorageError) -> np.ndarray:
    """Read numbers (T, width) from the lines of `table_rows`, NaN for an empty cell.

    With `fill` lines may be short, and are filled up with NaN. An `error` names the line that has other than numbers.
    """
    table = np.full((len(rows), width), np.nan)
    for place, (number, cells) in zip(table, rows, strict=True):
        if len(cells) > width or (len(cells) < width and not fill):
            raise error(f"{path}: line {number}: expected {width} values, found {len(cells)}")
        try:
            place[:len(cells)] = number_cells(cells, separator != ",")
        except ValueError as problem:
            raise error(f"{path}: line {number}: expected numbers, {problem}") from None
    return table
