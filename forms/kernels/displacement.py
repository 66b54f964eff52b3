"""The displacement alone, Ψ(S(F)): residual, tangent matrix and energy."""

from __future__ import annotations

from dolfinx import fem

from forms.kernels.cells import Cells, Floats, MaterialLike


class DisplacementKernel:
    """Newton's system of ∫ Ψ(S(F)), the baseline of comparisons.

    Arrays are local dofs, owned and ghost ones, as in `Function.x.array`; u is read where it stands
    when a method is called. Cells owned by this rank count, so sums over dofs shared by ranks are
    the caller's.
    """

    def __init__(self, u: fem.Function, psi: MaterialLike) -> None:
        """Compile, or load what has been compiled before. Collective.

        Args:
            u: P1 displacement [m] on triangles or tetrahedra.
            psi: A material of `forms.MATERIALS`, or the name of one with μ and λ [Pa], each a
                number or an array of shape (owned cells,).

        Raises:
            ModuleNotFoundError: Numba is not installed.
            ValueError: The material is not built in, or u or a parameter does not fit.
        """
        self._cells = Cells("displacement", u, psi)
        self._u = u

    def residual(self, r_u: Floats) -> None:
        """Add the derivative of the energy with respect to u."""
        self._cells.code.residual(*self._arguments, self._cells.vectors(r_u))

    def matrix_form(self, *, projected: bool = False) -> fem.Form:
        """Return the form of the tangent matrix; assembling it reads u as it is then. Collective.

        Args:
            projected: Whether to raise the negative eigenvalues of each cell's tangent ∂²Ψ/∂F² to
                zero (Smith, de Goes, Kim, 2019).
        """
        return self._cells.form(projected, [self._u])

    def matrices(self, cells: slice = slice(None), *, projected: bool = False) -> Floats:
        """Return the part of each of these owned cells in that matrix, shape (cells, n, n)."""
        return self._cells.matrices(projected, [self._u], cells)

    def energy(self) -> float:
        """Return ∫ Ψ(S(F)) over the cells of this rank [J]."""
        return float(self._cells.code.energy(*self._arguments))

    @property
    def _arguments(self) -> tuple[object, ...]:
        cells = self._cells
        u = cells.vectors(self._u.x.array)
        return *cells.coordinates, cells.u_dofs, u, cells.parameters
