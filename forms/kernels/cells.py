"""What the kernels share: the cells of a mesh, their materials, and compiled code for them."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.jit import mpi_jit_decorator

from forms.materials import MATERIALS, Material

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
MaterialLike = Material | tuple[str, npt.ArrayLike, npt.ArrayLike]

# Numbers of the materials in compiled code.
AS_RIGID_AS_POSSIBLE, COROTATIONAL, STABLE_NEO_HOOKEAN = 0.0, 1.0, 2.0
_NUMBERS = {
    "as-rigid-as-possible": AS_RIGID_AS_POSSIBLE,
    "corotational": COROTATIONAL,
    "stable-neo-hookean": STABLE_NEO_HOOKEAN,
}


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
            psi: A material of `forms.MATERIALS`, or the name of one (one for all cells) with μ and
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
            or (element.family.name, element.degree) != ("P", 1)
            or V.dofmap.bs != self.dimension
            or any(a.dtype != np.dtype(np.float64) for a in (u.x.array, mesh.geometry.x))
        ):
            raise ValueError(
                "the displacement is not P1 on straight cells, real and in double precision; "
                "compiled kernels exist for no other"
            )
        cells = mesh.topology.index_map(mesh.topology.dim).size_local
        name, mu, lam = _named(psi)
        values = np.empty((cells, 3))
        for column, (symbol, value) in enumerate((("", _NUMBERS[name]), ("mu", mu), ("lam", lam))):
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
        self._V = V
        self._packed: fem.Function | None = None

    def vectors(self, values: Floats) -> Floats:
        """A view of local dofs of a vector field, shape (vertices, d)."""
        return values.reshape(-1, self.dimension)

    def tensors(self, values: Floats) -> Floats:
        """A view of local dofs of a symmetric tensor field, shape (cells, d (d + 1) / 2)."""
        return values.reshape(-1, self.dimension * (self.dimension + 1) // 2)

    def form(self, projected: bool, coefficients: Sequence[fem.Function]) -> fem.Form:
        """Return the bilinear form of the matrix on the displacement's space. Collective.

        The kernel gets the coefficients' values on a cell, then the material's.
        """
        V, mesh = self._V, self._V.mesh
        if self._packed is None:
            # On owned cells only: a form is integrated over no other.
            self._packed = fem.Function(fem.functionspace(mesh, ("DG", 0, (3,))), name="material")
            dofs = self._packed.function_space.dofmap.list[: len(self.parameters), 0]
            self._packed.x.array.reshape(-1, 3)[dofs] = self.parameters
        functions = [*coefficients, self._packed]
        kernel = mpi_jit_decorator(self.code.matrix_kernel)(mesh.comm, projected)
        integral = (
            0,
            kernel,
            np.arange(len(self.parameters), dtype=np.int32),
            np.arange(len(functions), dtype=np.int8),
        )
        form = fem.form_cpp_class(np.float64)(
            [V._cpp_object, V._cpp_object],
            {fem.IntegralType.cell: [integral]},
            [f._cpp_object for f in functions],
            [],
            False,
            [],
            mesh._cpp_object,
        )
        return fem.Form(form)

    def matrices(
        self, projected: bool, coefficients: Sequence[fem.Function], cells: slice
    ) -> Floats:
        """Evaluate the kernel of `form` on some of the owned cells, shape (cells, n, n)."""
        from forms.kernels.compile import call_kernel  # needs numba, which is optional

        corners, x = self.coordinates
        X = x[corners[cells]].reshape(-1, 3 * corners.shape[1])
        packed = []
        for f in coefficients:
            dofmap = f.function_space.dofmap
            dofs = dofmap.list[: len(self.parameters)][cells]
            packed.append(f.x.array.reshape(-1, dofmap.bs)[dofs])
        w = np.hstack([*(p.reshape(len(X), -1) for p in packed), self.parameters[cells]])
        n = self.dimension * self.u_dofs.shape[1]
        A = np.zeros((len(X), n, n))
        call_kernel(self.code.matrix_kernel(projected), w, X, A.reshape(len(X), n * n))
        return A


def _named(psi: MaterialLike) -> tuple[str, npt.ArrayLike, npt.ArrayLike]:
    if isinstance(psi, tuple):
        name, mu, lam = psi
        if name in _NUMBERS:
            return name, mu, lam
    for name in _NUMBERS:
        if type(psi) is MATERIALS[name]:
            return name, psi.mu, psi.lam
    raise ValueError(f"no compiled kernel for {psi!r}; there are {', '.join(_NUMBERS)}")


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
