"""Records of cases: chosen, grouped, fitted, and set in columns."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Record = dict[str, Any]
"""The parameters of a case and what came of it, as plain as JSON. A case that failed has its reason
under ``failure``."""

Column = str | Callable[[Record], str]
"""What a table shows of a record: a format such as ``"{h:.2e}"``, or a function."""


def of_case(parameters: Mapping[str, Any], found: Record | list[Record]) -> list[Record]:
    """The records that the parameters of a case and what came of it make up."""
    return [{**parameters, **one} for one in (found if isinstance(found, list) else [found])]


def select(records: Iterable[Record], **wanted: Any) -> list[Record]:
    """Those that have these values."""
    return [r for r in records if all(r[name] == value for name, value in wanted.items())]


def groups(records: Iterable[Record], *names: str) -> dict[tuple[Any, ...], list[Record]]:
    """Records by what they have under these names, in the order in which they come."""
    found: dict[tuple[Any, ...], list[Record]] = {}
    for r in records:
        found.setdefault(tuple(r[name] for name in names), []).append(r)
    return found


def power(x: Iterable[float], y: Iterable[float]) -> float:
    """The power of x that y follows: the slope of log y over log x. Of one point nan."""
    logs = np.log(list(x)), np.log(list(y))
    return float(np.polyfit(*logs, 1)[0]) if len(logs[0]) > 1 else float("nan")


def fitted_orders(
    levels: Iterable[Record], size: Callable[[Record], float], errors: Iterable[str]
) -> dict[str, float]:
    """The order of each error over the finest three levels that did not fail.

    Args:
        levels: Records of growing fineness.
        size: The step or mesh size of a record.
        errors: Names of the errors.
    """
    finest = [r for r in levels if not r["failure"]][-3:]
    return {name: power(map(size, finest), [r[name] for r in finest]) for name in errors}


def matrix(
    records: Iterable[Record], row: str, column: str, value: Callable[[Record], float | None]
) -> tuple[list[Any], list[Any], npt.NDArray[np.float64]]:
    """A value over two parameters: those of its rows and columns, and the values, else nan."""
    records = list(records)
    rows, columns = (sorted({r[name] for r in records}) for name in (row, column))
    values = np.full((len(rows), len(columns)), np.nan)
    for r in records:
        found = value(r)
        values[rows.index(r[row]), columns.index(r[column])] = np.nan if found is None else found
    return rows, columns, values


# Tables


def in_columns(
    records: Iterable[Record], columns: Mapping[str, Column], case: int = 0
) -> list[str]:
    """A heading, and a row for each record.

    Args:
        records: What to show.
        columns: The columns by their headings.
        case: How many of the columns tell the case. One that failed shows its reason after them.
    """
    return aligned([list(columns), *(cells(r, columns, case) for r in records)])


def plain_table(records: Sequence[Record]) -> list[str]:
    """A table of all numbers and words in the records."""
    rows = plain(records)
    names = list(dict.fromkeys(name for row in rows for name in row))
    return aligned([names, *([_shown(row.get(name, "")) for name in names] for row in rows)])


def plain(records: Iterable[Record]) -> list[Record]:
    """The records without what is not a number or a word."""
    return [{k: v for k, v in r.items() if not isinstance(v, list | dict)} for r in records]


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def cells(r: Record, columns: Mapping[str, Column], case: int = 0) -> list[str]:
    """The row of a record, see `in_columns`."""
    chosen = list(columns.values())
    reason: list[str] = []
    if case and r["failure"]:
        chosen, reason = chosen[:case], [Remark(f"fails: {r['failure']}")]
    return [*(c.format_map(r) if isinstance(c, str) else c(r) for c in chosen), *reason]


def crossed(
    records: Iterable[Record],
    columns: Mapping[str, Column],
    across: str,
    heading: str,
    value: Callable[[Record], str],
) -> list[str]:
    """A table in two directions: a parameter grows to the right, others from row to row.

    Args:
        records: What to show.
        columns: What tells the rows, by heading.
        across: Name of the parameter that tells the columns.
        heading: The format of their headings.
        value: What to show of a record.
    """
    records = list(records)
    steps = sorted({r[across] for r in records})
    rows: dict[tuple[str, ...], dict[Any, str]] = {}
    for r in records:
        rows.setdefault(tuple(cells(r, columns)), {})[r[across]] = value(r)
    head = [*columns, *(heading.format_map({across: step}) for step in steps)]
    return aligned(
        [head, *([*start, *(row.get(s, "") for s in steps)] for start, row in rows.items())]
    )


class Remark(str):
    """Words at the end of a row, which run on past their column."""


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines with the cells of all rows in columns: numbers to the right, words to the left.

    Args:
        rows: The first is the heading. A row may end early.
    """
    columns: list[list[str]] = [[] for _ in rows[0]]
    for row in rows:
        for column, text in zip(columns, row, strict=False):
            column.append("" if isinstance(text, Remark) else text)
    widths = [max(map(len, column)) for column in columns]
    numbers = [any(re.match(r"[-+]?\d", text) for text in column[1:]) for column in columns]
    return [
        "  ".join(
            text.rjust(width) if number and not isinstance(text, Remark) else text.ljust(width)
            for text, width, number in zip(row, widths, numbers, strict=False)
        ).rstrip()
        for row in rows
    ]
