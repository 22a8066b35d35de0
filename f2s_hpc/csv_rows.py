"""CSV files that a user gives, split into rows, however a spreadsheet has saved them."""

from __future__ import annotations

import csv
import os
import pathlib

from f2s_hpc.errors import InputError


def read_rows(path: str | os.PathLike, needed: str) -> list[list[str]]:
    """Return the values of each row of the CSV file at ``path``; see :func:`split_rows`.

    ``needed`` says what file that should be. Raises InputError, also for a file that cannot be read.
    """
    try:
        text = pathlib.Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file in UTF-8"
        raise InputError(f"{path}: cannot be read ({reason}); {needed}") from None
    return split_rows(path, text)


def split_rows(path: str | os.PathLike, text: str) -> list[list[str]]:
    """Return the values of each line of ``text``, the header's too.

    Lines that begin with ``#`` are left out, and those without any value (spreadsheets leave some of commas alone).
    Spreadsheets of many countries put semicolons or tabs between values, and commas into them: where the header has
    such marks and no comma, a comma in a value is that of its decimals.
    Raises InputError, naming the file and the row that cannot be split.
    """
    lines = [line for line in text.splitlines() if line.strip(" \t,;") and not line.lstrip().startswith("#")]
    mark = next((mark for mark in ";\t" if lines and mark in lines[0] and "," not in lines[0]), ",")
    rows: list[list[str]] = []
    try:
        rows.extend(csv.reader(lines, delimiter=mark))
    except csv.Error as error:
        where = f"row {len(rows)}" if rows else "the first line"
        raise InputError(f"{path}: {where}: cannot be split into values ({error}); is a quote left open?") from None
    return rows if mark == "," else [[value.replace(",", ".") for value in row] for row in rows]


def count_error(where: str, row: list[str], header: list[str]) -> InputError:
    """Return the error about a row that does not have as many values as the header."""
    commas = "; do decimals have a comma? they need a point" if len(row) == 2 * len(header) else ""
    return InputError(f"{where}: {len(row)} values, but the header has {len(header)} columns{commas}")
