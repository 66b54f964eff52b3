"""A mesh and the unknowns of the discrete system on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from demos.by_hand.basis import Array, IntArray, symmetric_dofs


@dataclass(frozen=True, eq=False)
class State:
    """A mesh and the unknowns on it.

    Attributes:
        X: Rest positions [m], shape (n, d), d = 2 or 3.
        cells: Vertices of each triangle or tetrahedron, shape (n_e, d + 1).
        x: Positions [m], shape (n, d).
        S: Right stretches, symmetric, shape (n_e, d, d).
        Lam: Multipliers [Pa], shape (n_e, d, d): Λ of a `SeedSystem`, the symmetric Y of a
            `SymmetricSystem`.

    Raises:
        ValueError: A shape does not fit, a cell names a vertex that is not there, or S is not
            symmetric.
    """

    X: Array
    cells: IntArray
    x: Array
    S: Array
    Lam: Array

    def __post_init__(self) -> None:
        for name in ("X", "x", "S", "Lam"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        object.__setattr__(self, "cells", np.asarray(self.cells, dtype=np.int64))
        if self.X.ndim != 2 or self.X.shape[1] not in (2, 3):
            raise ValueError(f"X has shape {self.X.shape}; it must be (vertices, 2 or 3)")
        d = self.X.shape[1]
        n_e = len(self.cells)
        expected = {
            "cells": (n_e, d + 1),
            "x": self.X.shape,
            "S": (n_e, d, d),
            "Lam": (n_e, d, d),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}; expected {shape}")
        if n_e and not (0 <= self.cells.min() and self.cells.max() < len(self.X)):
            raise ValueError(f"cells names vertices outside 0..{len(self.X) - 1}")
        if not np.allclose(self.S, np.swapaxes(self.S, 1, 2), rtol=1e-12, atol=1e-12):
            raise ValueError("S is not symmetric")

    @classmethod
    def at_rest(cls, X: Array, cells: IntArray) -> State:
        """Return x = X, S = I, Λ = 0."""
        X, d = np.asarray(X, dtype=np.float64), np.shape(X)[1]
        S = np.tile(np.eye(d), (len(cells), 1, 1))
        return cls(X, cells, X, S, np.zeros_like(S))

    @property
    def s(self) -> Array:
        """Dofs of S, shape (n_e, d (d + 1) / 2)."""
        return symmetric_dofs(self.S)
