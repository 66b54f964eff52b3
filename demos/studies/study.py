"""What a study is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from demos.studies.records import Record, plain_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Parameters = Mapping[str, Any]


@dataclass(frozen=True)
class Study:
    """A grid of cases, a function that computes one, and what to show of them all.

    Attributes:
        name: The name on the command line, and of its files.
        description: One line.
        grid: The parameters of each case, given whether the study is to be quick. Parameters are
            plain numbers, strings and lists, as JSON has them.
        compute: Computes a case; collective, and the same on all ranks where it matters. Its
            result and the parameters together make up the record of the case, which is plain too.
            A list of results makes up as many records.
        table: Lines to show of all records, on rank 0; by default all their numbers and words.
        draw: Draws the records into a figure, on rank 0; None if there is nothing to draw.
        verdict: Lines that name what the records fall short of, on rank 0.
        depends: What its records depend on beside the parameters and the sources of `compute`.
        starts_ranks: Whether it starts runs on several ranks by itself, and must be run in serial.
    """

    name: str
    description: str
    grid: Callable[[bool], Sequence[Parameters]]
    compute: Callable[[MPI.Comm, Parameters], Record | list[Record]]
    table: Callable[[Sequence[Record]], list[str]] = plain_table
    draw: Callable[[Sequence[Record], Figure], None] | None = None
    verdict: Callable[[Sequence[Record]], list[str]] = lambda records: []
    depends: str = ""
    starts_ranks: bool = False
