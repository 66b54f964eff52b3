"""Tagged entities of a mesh: vertices, edges, facets and cells that share a name or a number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Group:
    """The entities that carry one tag.

    A file may use one name or number for entities of several dimensions, such as a surface and a
    volume. All are kept; a part of the boundary is made of the former, a region of the latter.

    Attributes:
        entities: By dimension. Vertices and cells by their file numbers, sorted, shape (n,); edges
            and facets by the file numbers of their vertices, shape (n, vertices of one), those of
            a quadrilateral in the order in which they go around it.
    """

    entities: Mapping[int, Integers]

    def boundary(self, d: int) -> int | None:
        """The highest dimension below that of the cells, d, of which there are entities."""
        return max((dim for dim in self.entities if dim < d), default=None)


def entity_name(dim: int, d: int) -> str:
    """What entities of a dimension are called in a body of dimension d, in the plural."""
    return {d: "cells", d - 1: "facets", 0: "vertices"}.get(dim, "edges")


def ascending(numbers: Integers) -> Integers:
    """The numbers in ascending order, each once; of many, in less time than `np.unique`."""
    numbers = np.sort(numbers.astype(np.int64))
    return numbers[np.r_[True, numbers[1:] != numbers[:-1]][: len(numbers)]]


def repeated_rows(rows: Integers) -> bool:
    """Whether a row may come twice: False is certain, and cheaper than sorting rows."""
    odd = np.random.default_rng(0).integers(2**62, size=rows.shape[1]) * 2 + 1
    with np.errstate(over="ignore"):
        keys = np.sort((rows * odd).sum(axis=1))
    return bool((keys[1:] == keys[:-1]).any())
