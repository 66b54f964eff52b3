"""The formulation with Λ = R Y, Y symmetric: residual, condensed matrix and back-substitution."""

from __future__ import annotations

from dolfinx import fem

from forms.kernels.cells import Cells, Floats, Ints, MaterialLike


class SymmetricKernel:
    r"""Newton's system of ∫ Ψ(S) - Y : S + Y : S(F), condensed to the displacement.

    Its rows are, with w_k = B_k : B_k the weights of symmetric dofs, H = ∂²Ψ/∂s² and V the volume,

        ∫ Y : ∂²S[δu, v] + ∂Sᵀ w δy = b_u,   V (H δs - w δy) = b_S,   V w (∂S δF - δs) = b_Y,

    so that nothing needs an inverse:

        K δu = b_u + ∂Sᵀ (b_S + H w⁻¹ b_Y),   K = ∫ ∂Sᵀ H ∂S + Y : ∂²S,
        δs = ∂S δF - (V w)⁻¹ b_Y,   δy = w⁻¹ (H δs - V⁻¹ b_S).

    Arrays are local dofs, owned and ghost ones, as in `Function.x.array`; the fields are read where
    they stand when a method is called. Cells owned by this rank count, so sums over dofs shared by
    ranks are the caller's (`ghostUpdate` or `scatter_reverse`).
    """

    def __init__(
        self, u: fem.Function, S: fem.Function, Y: fem.Function, psi: MaterialLike
    ) -> None:
        """Compile, or load what has been compiled before. Collective.

        Args:
            u: P1 displacement [m] on triangles or tetrahedra.
            S: Right stretch [-] in symmetric DG0.
            Y: Rotated first Piola-Kirchhoff stress [Pa] in symmetric DG0.
            psi: A material of `forms.MATERIALS`, or the name of one with μ and λ [Pa], each a
                number or an array of shape (owned cells,).

        Raises:
            ModuleNotFoundError: Numba is not installed.
            ValueError: The material is not built in, or a field or parameter does not fit.
        """
        d = u.function_space.mesh.geometry.dim
        for f in (S, Y):
            element, bs = f.function_space.element.basix_element, f.function_space.dofmap.bs
            if element.degree != 0 or f.ufl_shape != (d, d) or bs != d * (d + 1) // 2:
                raise ValueError(f"the field {f.name} is not a symmetric DG0 tensor")
        self._cells = Cells("symmetric", u, psi)
        self._fields = (u, S, Y)
        n = len(self._cells.parameters)
        self._S_dofs: Ints = S.function_space.dofmap.list[:n]
        self._Y_dofs: Ints = Y.function_space.dofmap.list[:n]

    def residual(self, r_u: Floats, r_S: Floats, r_Y: Floats) -> None:
        """Add the derivatives of the energy with respect to u, S and Y."""
        cells = self._cells
        cells.code.residual(
            *cells.coordinates,
            *self._state,
            cells.tensors(self._fields[2].x.array),
            cells.parameters,
            cells.vectors(r_u),
            cells.tensors(r_S),
            cells.tensors(r_Y),
        )

    def matrix_form(self, *, projected: bool = False) -> fem.Form:
        """Return the form of K; assembling it reads the fields as they are then. Collective.

        Args:
            projected: Whether to make each cell's tangent positive semi-definite, by raising the
                negative eigenvalues of its form on spins to zero and those of H, where Ψ is not
                convex. It is the same where it is positive semi-definite already, and the
                displacement method's projected tangent at S = S(F), Y = Ψ'(S).
        """
        return self._cells.form(projected, self._fields)

    def matrices(self, cells: slice = slice(None), *, projected: bool = False) -> Floats:
        """Return the part of each of these owned cells in that matrix, shape (cells, n, n)."""
        return self._cells.matrices(projected, self._fields, cells)

    def eliminate(self, b_S: Floats, b_Y: Floats, b_u: Floats) -> None:
        """Add ∂Sᵀ (b_S + H w⁻¹ b_Y) to b_u."""
        cells = self._cells
        cells.code.eliminate(
            *cells.coordinates,
            *self._state,
            cells.parameters,
            cells.tensors(b_S),
            cells.tensors(b_Y),
            cells.vectors(b_u),
        )

    def recover(self, du: Floats, b_S: Floats, b_Y: Floats, dS: Floats, dY: Floats) -> None:
        """Set δS and δY on owned cells from δu, of which ghosts are read too."""
        cells = self._cells
        cells.code.recover(
            *cells.coordinates,
            *self._state,
            cells.parameters,
            cells.tensors(b_S),
            cells.tensors(b_Y),
            cells.vectors(du),
            cells.tensors(dS),
            cells.tensors(dY),
        )

    def energy(self) -> float:
        """Return ∫ Ψ(S) over the cells of this rank [J]."""
        cells = self._cells
        S = cells.tensors(self._fields[1].x.array)
        return float(cells.code.energy(*cells.coordinates, self._S_dofs, S, cells.parameters))

    @property
    def _state(self) -> tuple[Ints | Floats, ...]:
        """The arguments that all loops share: u and S as they stand, and the dofs of Y."""
        u, S, _ = (f.x.array for f in self._fields)
        cells = self._cells
        return cells.u_dofs, cells.vectors(u), self._S_dofs, cells.tensors(S), self._Y_dofs
