"""The formulation with Λ = R Y, Y symmetric: residual, condensed matrix and back-substitution."""

from __future__ import annotations

import numpy as np
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
            psi: A material of `forms.kernels.MATERIALS`, or the name of one with μ and λ [Pa],
                each a number or an array of shape (owned cells,).

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
        # Per cell, and the displacement and coordinates that it belongs to.
        self._kinematics: Floats = np.empty((n, self._cells.code.KEPT))
        self._known = [np.full_like(values, np.nan) for values in self._configuration]

    def residual(self, r_u: Floats, r_S: Floats, r_Y: Floats) -> None:
        """Add the derivatives of the energy with respect to u, S and Y."""
        cells = self._cells
        cells.code.residual(
            *self._state,
            cells.tensors(self._fields[2].x.array),
            cells.parameters,
            cells.vectors(r_u),
            cells.tensors(r_S),
            cells.tensors(r_Y),
        )

    @property
    def couplings(self) -> Ints:
        """Pairs of blocks of u's dofs that share a cell, shape (pairs, 2)."""
        return self._cells.couplings

    def matrix(self, K: Floats, *, projected: bool = False) -> None:
        """Add the condensed matrix to K, its d × d blocks of `couplings`, shape (pairs, d, d).

        Args:
            K: What to add to.
            projected: Whether to make each cell's tangent positive semi-definite, by raising the
                negative eigenvalues of its form on spins to zero and those of H, where Ψ is not
                convex. It is the same where it is positive semi-definite already, and the
                displacement method's projected tangent at S = S(F), Y = Ψ'(S).
        """
        cells = self._cells
        cells.code.matrix(
            *self._state,
            cells.tensors(self._fields[2].x.array),
            cells.parameters,
            projected,
            cells.places,
            cells.blocks(K),
        )

    def eliminate(self, b_S: Floats, b_Y: Floats, b_u: Floats) -> None:
        """Add ∂Sᵀ (b_S + H w⁻¹ b_Y) to b_u."""
        cells = self._cells
        cells.code.eliminate(
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
    def _configuration(self) -> tuple[Floats, Floats]:
        return self._fields[0].x.array, self._cells.coordinates[1]

    @property
    def _state(self) -> tuple[Ints | Floats, ...]:
        """What all loops share: kinematics and S as they stand, and dofs."""
        cells = self._cells
        current = self._configuration
        if not all(map(np.array_equal, current, self._known)):
            u = cells.vectors(current[0])
            cells.code.kinematics(*cells.coordinates, cells.u_dofs, u, self._kinematics)
            for known, values in zip(self._known, current, strict=True):
                known[:] = values
        S = cells.tensors(self._fields[1].x.array)
        return self._kinematics, cells.u_dofs, self._S_dofs, S, self._Y_dofs
