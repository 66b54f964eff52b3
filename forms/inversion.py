"""Cells turned inside out."""

from __future__ import annotations

from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem

from forms.expressions import at_points
from forms.kinematics import deformation_gradient
from forms.points import quadrature_degree


class InvertedCells:
    """Counts the cells with det F < 0 at a point of the rule of the strain energy."""

    def __init__(self, u: fem.Function[Any]) -> None:
        """Compile det F of a displacement."""
        self._mesh = u.function_space.mesh
        degree = quadrature_degree(u.function_space)
        points, _ = basix.make_quadrature(self._mesh.basix_cell(), degree)
        self._det = at_points(ufl.det(deformation_gradient(u)), np.array(points, dtype=np.float64))
        cells = self._mesh.topology.index_map(self._mesh.topology.dim).size_local
        self._cells = np.arange(cells, dtype=np.int32)

    def count(self) -> int:
        """Return how many there are now. Collective."""
        det = self._det.eval(self._mesh, self._cells)
        return int(self._mesh.comm.allreduce(int(np.sum(det.min(axis=1, initial=np.inf) < 0.0))))
