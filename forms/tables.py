"""Tables: rows of a time [s] and what there is then, straight from row to row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Table = Sequence[Sequence[float]]


def check_table(table: Table, what: str, width: int | None = None) -> None:
    """Check that a table can be used.

    Args:
        table: The table.
        what: Stands beside the time in a row.
        width: Of a row, if not any.

    Raises:
        ValueError: Its rows are others, or their times do not grow.
    """
    widths = {len(row) for row in table}
    sound = len(widths) == 1 and min(widths) > 1 and width in (None, *widths)
    if not sound or np.any(np.diff([row[0] for row in table]) <= 0):
        raise ValueError(f"table must have rows [time, {what}], all alike, of growing times")


def look_up(table: Table, t: float) -> npt.NDArray[np.float64]:
    """Values at time t [s]; before the first row and after the last they stay."""
    times, *columns = np.array(table, dtype=float).T
    return np.array([np.interp(t, times, column) for column in columns])
