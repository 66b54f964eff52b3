"""Numbers in text, whole numbers, and the places of named things in a list."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.groups import Integers

# Whole numbers up to this one are exact as floating-point numbers.
_EXACT = 2.0**53


def parsed(text: str, where: str) -> npt.NDArray[np.float64]:
    """The numbers of a text, between blanks.

    Raises:
        MeshError: There is something else in it; `where` says where, as in "under Vertices".
    """
    if not text.strip():
        return np.empty(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as e:
            raise MeshError(f"has something else than numbers {where}") from e


def whole(numbers: npt.NDArray[np.number], where: str) -> Integers:
    """Numbers of any type as whole numbers.

    Raises:
        MeshError: They are not.
    """
    if np.issubdtype(numbers.dtype, np.floating):
        fits = (np.abs(numbers) <= _EXACT) & (numbers == np.rint(numbers))
        if not fits.all():
            raise MeshError(f"has {numbers[~fits].flat[0]:g} {where}, which is no whole number")
    return numbers.astype(np.int64)


def places(names: npt.NDArray[np.number], named: npt.NDArray[np.number]) -> Integers:
    """Where in a list of numbers some of them stand, the first time; -1 where they do not."""
    order = np.argsort(names, kind="stable")
    found = np.append(order, -1)[np.searchsorted(names[order], named)]
    known = np.append(names, np.nan if len(names) == 0 else names[0])[found] == named
    return np.where(known & (found >= 0), found, -1).astype(np.int64)
