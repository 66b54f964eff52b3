"""What the kernels share: the cells of a mesh, their materials, and compiled code for them."""

from __future__ import annotations

import functools
import importlib
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.jit import mpi_jit_decorator

from forms.materials import MATERIALS as ALL_MATERIALS
from forms.materials import Material
from forms.points import is_simplicial

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
MaterialLike = Material | tuple[str, npt.ArrayLike, npt.ArrayLike]

AS_RIGID_AS_POSSIBLE, COROTATIONAL, STABLE_NEO_HOOKEAN = 0.0, 1.0, 2.0
MATERIALS = {
    "as-rigid-as-possible": AS_RIGID_AS_POSSIBLE,
    "corotational": COROTATIONAL,
    "stable-neo-hookean": STABLE_NEO_HOOKEAN,
}
"""The materials that have kernels, by name, and their numbers in compiled code."""


class Cells:
    """The owned cells of a P1 displacement's mesh and their material.

    Attributes:
        code: The compiled module for this dimension.
        dimension: Dimension d, 2 or 3.
        coordinates: Vertices of each owned cell among the mesh's, shape (cells, d + 1), and the
            vertices' coordinates [m], shape (vertices, 3).
        u_dofs: Vertices of each owned cell among the displacement's, shape (cells, d + 1).
        parameters: Number of the material, μ [Pa] and λ [Pa] of each owned cell, shape (cells, 3).
    """

    def __init__(
        self, formulation: Literal["symmetric", "displacement"], u: fem.Function, psi: MaterialLike
    ) -> None:
        """Check that kernels exist, and compile or load them. Collective.

        Args:
            formulation: Which kernels.
            u: P1 displacement [m] on straight triangles or tetrahedra.
            psi: A material of `MATERIALS`, or the name of one (one for all cells) with μ and
                λ [Pa], numbers or arrays of shape (owned cells,).

        Raises:
            ModuleNotFoundError: Numba is not installed.
            ValueError: The material is not built in, or parameters or u do not fit.
        """
        V, mesh = u.function_space, u.function_space.mesh
        self.dimension: int = mesh.geometry.dim
        element = V.element.basix_element
        if (
            mesh.geometry.cmaps[0].degree != 1
            or mesh.topology.dim != self.dimension
            or not is_simplicial(mesh)
            or (element.family.name, element.degree) != ("P", 1)
            or V.dofmap.bs != self.dimension
            or any(a.dtype != np.dtype(np.float64) for a in (u.x.array, mesh.geometry.x))
        ):
            raise ValueError(
                "the displacement is not P1 on straight simplices, real and in double precision; "
                "compiled kernels exist for no other"
            )
        cells = mesh.topology.index_map(mesh.topology.dim).size_local
        name, mu, lam = _named(psi)
        values = np.empty((cells, 3))
        for column, (symbol, value) in enumerate((("", MATERIALS[name]), ("mu", mu), ("lam", lam))):
            given = np.asarray(value, dtype=float)
            if given.shape not in ((), (cells,)):
                raise ValueError(
                    f"{symbol} has shape {given.shape}; it must be a number or one for each of "
                    f"the {cells} cells of this rank"
                )
            values[:, column] = given
        self.parameters: Floats = values
        try:
            importlib.import_module("numba")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "compiled kernels need numba, which is not installed: pip install numba",
                name="numba",
            ) from error
        self.code: ModuleType = mpi_jit_decorator(_load)(
            mesh.comm, f"{formulation}_{self.dimension}d"
        )
        self.coordinates: tuple[Ints, Floats] = (mesh.geometry.dofmaps[0][:cells], mesh.geometry.x)
        self.u_dofs: Ints = V.dofmap.list[:cells]

    def vectors(self, values: Floats) -> Floats:
        """A view of local dofs of a vector field, shape (vertices, d)."""
        return values.reshape(-1, self.dimension)

    def tensors(self, values: Floats) -> Floats:
        """A view of local dofs of a symmetric tensor field, shape (cells, d (d + 1) / 2)."""
        return values.reshape(-1, self.dimension * (self.dimension + 1) // 2)

    @property
    def couplings(self) -> Ints:
        """Pairs of the displacement's vertices with a cell in common, shape (pairs, 2)."""
        return self._couplings_and_places[0]

    @property
    def places(self) -> Ints:
        """Where the pairs of vertices of each cell are among them, shape (cells, (d + 1)²)."""
        return self._couplings_and_places[1]

    @functools.cached_property
    def _couplings_and_places(self) -> tuple[Ints, Ints]:
        dofs = self.u_dofs.astype(np.int64)
        stride = int(dofs.max(initial=0)) + 1
        keys = (dofs[:, :, None] * stride + dofs[:, None, :]).reshape(len(dofs), -1)
        pairs, places = np.unique(keys, return_inverse=True)
        couplings = np.stack(np.divmod(pairs, stride), axis=1).astype(np.int32)
        return couplings, places.reshape(keys.shape).astype(np.int32)

    def blocks(self, values: Floats) -> Floats:
        """A view of blocks of a matrix, shape (pairs, d²)."""
        return values.reshape(-1, self.dimension**2)


def _named(psi: MaterialLike) -> tuple[str, npt.ArrayLike, npt.ArrayLike]:
    if isinstance(psi, tuple):
        name, mu, lam = psi
        if name in MATERIALS:
            return name, mu, lam
    for name in MATERIALS:
        if type(psi) is ALL_MATERIALS[name]:
            return name, psi.mu, psi.lam
    raise ValueError(f"no compiled kernel for {psi!r}; there are {', '.join(MATERIALS)}")


def _load(name: str) -> Any:
    """Import a module of compiled code, first without what older sources left in numba's cache.

    Numba looks at the file of a function only, not at those of the functions that it calls.
    """
    folder = Path(__file__).parent
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for cached in (folder / "__pycache__").glob("*.nb[ic]"):
        if cached.stat().st_mtime < newest:
            cached.unlink(missing_ok=True)
    return importlib.import_module(f"forms.kernels.{name}")
