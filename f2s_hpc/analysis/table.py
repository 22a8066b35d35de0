"""Tables as text: aligned columns, and the cycle table for a terminal of 160 columns."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

from f2s_hpc.errors import InputError

_MEBIBYTE = 2.0**20


@dataclass(frozen=True)
class Column:
    """One column: the key in ``summary.csv``, three header lines, and how the number is written.

    The number shown is value x ``scale``, written with the format ``form``; an empty ``form`` is text as it is.
    """

    key: str
    group: str
    name: str
    unit: str
    form: str
    scale: float = 1.0


COLUMNS: tuple[Column, ...] = (
    Column("cycle", "", "cycle", "", ".0f"),
    Column("time_s", "", "time", "us", ".3f", 1e6),
    Column("steps", "", "steps", "", ".0f"),
    Column("dt_s", "time step", "dt", "ps", ".1f", 1e12),
    Column("dt_limit", "time step", "limit", "", ""),
    Column("particles", "", "particles", "", ".0f"),
    Column("dense_height_m", "height above substrate", "dense", "um", ".1f", 1e6),
    Column("height_mean_m", "height above substrate", "mean", "um", ".1f", 1e6),
    Column("height_p95_m", "height above substrate", "p95", "um", ".1f", 1e6),
    Column("height_max_m", "height above substrate", "max", "um", ".1f", 1e6),
    Column("peeq_p50", "PEEQ", "p50", "", ".2f"),
    Column("peeq_p95", "PEEQ", "p95", "", ".2f"),
    Column("peeq_max", "PEEQ", "max", "", ".2f"),
    Column("temperature_p50_degC", "temperature", "p50", "degC", ".0f"),
    Column("temperature_p95_degC", "temperature", "p95", "degC", ".0f"),
    Column("mass_drift_relative", "", "mass", "drift", ".1e"),
    Column("numerical_loss_fraction", "", "loss", "%", ".1f", 1e2),
    Column("active_cells", "", "active", "kcells", ".1f", 1e-3),
    Column("active_cell_steps_per_s", "", "Mcell-", "steps/s", ".2f", 1e-6),
    Column("imbalance", "", "imbal-", "ance", ".2f"),
    Column("peak_memory_bytes_per_rank", "memory", "per rank", "MiB", ".0f", 1 / _MEBIBYTE),
)


TABLE_KEY = ("dense: height of all mass in the box, without pores and at no pressure; 'f2s analyse' has that by volume "
             "fraction")
"""What the table means where another one of the same name is about."""


def aligned(lines: Sequence[Sequence[str]], left: Container[int] = (), rule: bool = False) -> list[str]:
    """Return ``lines`` of cells, the first of them the head, as text whose columns are two blanks apart.

    The columns ``left`` are aligned to the left, the others to the right; ``rule``: with a line under the head.
    """
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    told = ["  ".join(cell.ljust(width) if c in left else cell.rjust(width)
                      for c, (cell, width) in enumerate(zip(line, widths))).rstrip() for line in lines]
    if rule:
        told.insert(1, "  ".join("-" * width for width in widths))
    return told


def format_table(rows: Sequence[Mapping[str, str | float | None]]) -> str:
    """Return the cycle table as text: three header lines, a rule, and a line per row of ``summary.csv``.

    ``rows``: one mapping per cycle with the keys of ``COLUMNS`` (SI, temperatures in degC), values as numbers
    or as the text of the CSV file. A key that no row has is left out; an empty or missing value is shown as "-".
    Raises ``InputError`` for a text that is not a number, naming row and key.
    """
    if not rows:
        return "no cycle has finished yet"
    columns = [column for column in COLUMNS if any(column.key in row for row in rows)]
    if not columns:
        raise InputError(f"cycle table: none of the columns {', '.join(c.key for c in COLUMNS[:3])}, ... is there; "
                         "is this the summary.csv of a run?")
    cells = [[_text(column, row, number) for column in columns] for number, row in enumerate(rows, 1)]
    widths = [max(len(column.name), len(column.unit), *(len(line[c]) for line in cells))
              for c, column in enumerate(columns)]
    gaps = ["" if c == 0 else " " if column.group and column.group == columns[c - 1].group else "  "
            for c, column in enumerate(columns)]
    groups = _group_line(columns, widths, gaps)
    head = [_line([getattr(column, part) for column in columns], columns, widths, gaps) for part in ("name", "unit")]
    rule = "".join(" " * len(gap) + "-" * width for gap, width in zip(gaps, widths))
    body = [_line(line, columns, widths, gaps) for line in cells]
    return "\n".join(line for line in (groups, *head, rule, *body) if line)


def where_the_time_went(phases: object) -> str:
    """Return in one line how the wall time of a run divides into phases, most first; what rounds to 0 % is left out.

    ``phases``: those of ``summary.json``, per name ``mean_s`` and ``largest_s`` over the ranks. A share that is larger
    on some rank than in the mean, in whole per cent, stands behind it. Raises ``InputError`` if they are no such thing.
    """
    try:
        found = {str(name): (float(entry["mean_s"]), float(entry["largest_s"])) for name, entry in phases.items()}
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError("phases: must tell mean_s and largest_s (seconds) of each phase") from None
    whole = max(sum(mean for mean, _ in found.values()), 1e-300)
    parts = []
    for name, seconds in sorted(found.items(), key=lambda item: -item[1][0]):
        mean, largest = (round(100.0 * each / whole) for each in seconds)
        if largest:
            parts.append(f"{name} {mean} %" + (f" (up to {largest})" if largest > mean else ""))
    return f"where the time went, {whole:.4g} s: {', '.join(parts) or '-'}"


def _text(column: Column, row: Mapping[str, str | float | None], number: int) -> str:
    """Return the cell of ``column`` in ``row``, the ``number``-th of the table."""
    value = row.get(column.key)
    if value is None or value == "":
        return "-"
    if not column.form:
        return str(value)
    try:
        return f"{float(value) * column.scale:{column.form}}"
    except (TypeError, ValueError):
        raise InputError(f"cycle table, row {number}, {column.key}: {value!r} is not a number") from None


def _line(texts: Sequence[str], columns: Sequence[Column], widths: Sequence[int], gaps: Sequence[str]) -> str:
    """Return one line; numbers to the right, text to the left."""
    return "".join(gap + (text.rjust(width) if column.form else text.ljust(width))
                   for text, column, width, gap in zip(texts, columns, widths, gaps)).rstrip()


def _group_line(columns: Sequence[Column], widths: list[int], gaps: Sequence[str]) -> str:
    """Return the line of group names, centred over their columns; widens a group's last column if needed."""
    line, c = "", 0
    while c < len(columns):
        end = c + 1
        while end < len(columns) and columns[end].group and columns[end].group == columns[c].group:
            end += 1
        span = sum(widths[c:end]) + sum(len(gap) for gap in gaps[c + 1:end])
        widths[end - 1] += max(0, len(columns[c].group) - span)
        span = max(span, len(columns[c].group))
        line += gaps[c] + columns[c].group.center(span)
        c = end
    return line.rstrip()
