"""What is compared: two arrays that must agree, one of the witness and one of UFL."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from demos.by_hand.compare.assembly import Array

CONDENSED = 0
"""In place of an equation's number: the system that the symmetric formulation condenses to."""

Hook = Callable[[Any], Any]
"""From a system of the witness to one of the same kind."""


class Item(NamedTuple):
    """Two arrays that must agree.

    Attributes:
        equation: Number in the seed, or `CONDENSED`.
        what: What is compared.
        witness: From `demos.by_hand`.
        expected: From UFL.
        part: Which of the arrays of one row.
        tolerance: Largest relative difference, `None` for that of the whole comparison.
    """

    equation: int
    what: str
    witness: Array
    expected: Array
    part: str = ""
    tolerance: float | None = None


def one(value: float | Array) -> Array:
    """A number as an array."""
    return np.array([value], dtype=float)


def dense(matrix: sp.sparray) -> Array:
    """A sparse matrix as an array."""
    array: Array = matrix.toarray()
    return array
