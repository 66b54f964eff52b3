"""The displacement alone, Ψ(S(F)): residual, tangent matrix and energy."""

from __future__ import annotations

from dolfinx import fem

from forms.kernels.cells import Cells, Floats, Ints, MaterialLike


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
            psi: A material of `forms.kernels.MATERIALS`, or the name of one with μ and λ [Pa],
                each a number or an array of shape (owned cells,).

        Raises:
            ModuleNotFoundError: Numba is not installed.
            ValueError: The material is not built in, or u or a parameter does not fit.
        """
        self._cells = Cells("displacement", u, psi)
        self._u = u

    def residual(self, r_u: Floats) -> None:
        """Add the derivative of the energy with respect to u."""
        self._cells.code.residual(*self._arguments, self._cells.vectors(r_u))

    @property
    def couplings(self) -> Ints:
        """Pairs of blocks of u's dofs that share a cell, shape (pairs, 2)."""
        return self._cells.couplings

    def matrix(self, K: Floats, *, projected: bool = False) -> None:
        """Add the tangent matrix to K, its d × d blocks of `couplings`, shape (pairs, d, d).

        Args:
            K: What to add to.
            projected: Whether to raise the negative eigenvalues of each cell's tangent ∂²Ψ/∂F² to
                zero (Smith, de Goes, Kim, 2019).
        """
        cells = self._cells
        cells.code.matrix(*self._arguments, projected, cells.places, cells.blocks(K))

    def energy(self) -> float:
        """Return ∫ Ψ(S(F)) over the cells of this rank [J]."""
        return float(self._cells.code.energy(*self._arguments))

    @property
    def _arguments(self) -> tuple[object, ...]:
        cells = self._cells
        u = cells.vectors(self._u.x.array)
        return *cells.coordinates, cells.u_dofs, u, cells.parameters
