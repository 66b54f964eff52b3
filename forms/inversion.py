"""Cells turned inside out."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from forms.expressions import PointValues
from forms.kinematics import deformation_gradient


class InvertedCells:
    """Counts the cells with det F < 0 at a point of the rule of the strain energy."""

    def __init__(self, u: fem.Function[Any]) -> None:
        """Compile det F of a displacement."""
        self._comm = u.function_space.mesh.comm
        self._det = PointValues(ufl.det(deformation_gradient(u)), u)

    def count(self) -> int:
        """Return how many there are now. Collective."""
        least = self._det.now().min(axis=1, initial=np.inf)
        return int(self._comm.allreduce(int(np.sum(least < 0.0))))
