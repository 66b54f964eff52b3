"""What forms ask of a body; `meshes.Body` is one."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, mesh


class BodyLike(Protocol):
    """A mesh that knows parts of itself, by clauses `where` that are its own matter."""

    @property
    def mesh(self) -> mesh.Mesh:
        """The mesh [m]."""

    def dofs(self, V: fem.FunctionSpace, where: Any) -> npt.NDArray[np.int32]:
        """Sorted local blocks of degrees of freedom in a part, ghosts included. Collective."""

    def ds(self, where: Any = None) -> ufl.Measure:
        """The measure over the boundary facets in a part, by default all of them. Collective."""

    def dP(self, where: Any) -> ufl.Measure:
        """The measure that sums over the vertices in a part, each once. Collective."""
