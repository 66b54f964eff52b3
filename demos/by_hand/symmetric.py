"""The formulation with Λ = R Y, Y symmetric, and the displacement-sized system it condenses to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from demos.by_hand.basis import Array, dof_weights, einsum, symmetric_dofs, symmetric_tensor
from demos.by_hand.element import block_diagonal
from demos.by_hand.system import DiscreteSystem


@dataclass(frozen=True, eq=False)
class SymmetricSystem(DiscreteSystem):
    """Λ = R Y with Y symmetric: E_Λ = Σ_K Y_K : (S_K - S(F_K)) V_K, S(F) = sym(RᵀF).

    Six multipliers a cell in 3D for six constraints. F = 0 and D is diagonal, so that s and λ can
    be eliminated without an inverse, see `condensed`.
    """

    @property
    def lam(self) -> Array:
        """Dofs of Y, flat."""
        return symmetric_dofs(self.state.Lam).ravel()

    def multiplier_tensor(self, lam: Array) -> Array:
        """Return Y (n_e, d, d) of its flat dofs."""
        return symmetric_tensor(lam.reshape(-1, self.d * (self.d + 1) // 2))

    @cached_property
    def Y(self) -> Array:
        """Y of its dofs, shape (n_e, d, d)."""
        return self.multiplier_tensor(self.lam)

    @cached_property
    def weights(self) -> Array:
        """V_K B_k : B_k, shape (n_e, m): Y : S V_K = Σ_k w_k y_k s_k."""
        return self.volume[:, None] * dof_weights(self.d)

    @cached_property
    def c_K(self) -> Array:
        """s_K - s(F_K), without volume and weights, shape (n_e, m)."""
        return self.s - symmetric_dofs(self.polar.S_F)

    @cached_property
    def ds_F(self) -> Array:
        """∂s(F_K)/∂vec F, shape (n_e, m, d²)."""
        return self.polar.ds_F

    @cached_property
    def YS_FF(self) -> Array:
        """∂²(Y : S(F))/∂vec F² = -∂²E_Λ/∂vec F² without volume, shape (n_e, d², d²)."""
        return self.polar.stretch_hessian(self.Y)

    @cached_property
    def E_x(self) -> Array:
        """∂E_Λ/∂x = -∂(Y : S(F))/∂x, flat."""
        g: Array = -(self.J_w.T @ self.polar.stretch_gradient(self.Y).ravel())
        return g

    @cached_property
    def E_s(self) -> Array:
        """∂E_Λ/∂s, flat."""
        g: Array = self.weights.ravel() * self.lam
        return g

    @cached_property
    def c(self) -> Array:
        """∂E_Λ/∂λ, flat."""
        return (self.weights * self.c_K).ravel()

    @cached_property
    def E_xx(self) -> sp.csr_array:
        """∂²E_Λ/∂x² = -Σ_K J_Kᵀ (Y : ∂²S) J_K V_K."""
        return (-self.J_w.T @ block_diagonal(self.YS_FF) @ self.J).tocsr()

    @cached_property
    def F(self) -> sp.csr_array:
        """∂²E/∂s∂x = 0: s meets x through the multiplier only."""
        return sp.csr_array((self.s.size, self.state.x.size))

    @cached_property
    def G(self) -> sp.csr_array:
        """∂²E/∂λ∂x = Σ_K w ∂s(F_K)/∂x."""
        return (block_diagonal(dof_weights(self.d)[:, None] * self.ds_F) @ self.J_w).tocsr()

    @cached_property
    def D(self) -> sp.csr_array:
        """∂²E/∂λ∂s = -diag(w)."""
        return sp.diags_array(-self.weights.ravel(), format="csr")

    def condensed(self) -> tuple[sp.csr_array, Array]:
        """Return the displacement-sized matrix and right-hand side for δx.

        K = A + Σ_K J_Kᵀ ∂Sᵀ H_K ∂S J_K V_K, that is M/h² + ∫ ∂Sᵀ H ∂S + Y : ∂²S, from
        λ = w⁻¹ (g_s + H δs) and δs = ∂S δx - (s - s(F)).
        """
        H_ds = self.H_K @ self.ds_F
        K = self.A + self.J_w.T @ block_diagonal(np.swapaxes(self.ds_F, 1, 2) @ H_ds) @ self.J
        stress = self.g_K - einsum("nij,nj->ni", self.H_K, self.c_K)
        pull = einsum("nip,ni->np", self.ds_F, stress).ravel()
        return K.tocsr(), self.rhs_x - self.J_w.T @ pull

    def recover(self, dx: Array) -> tuple[Array, Array]:
        """Return (δs, λ), flat, of the condensed system's δx."""
        vec = np.ravel(self.J @ dx).reshape(len(self.c_K), -1)
        ds = einsum("nip,np->ni", self.ds_F, vec) - self.c_K
        lam = (self.g_K + einsum("nij,nj->ni", self.H_K, ds)) / dof_weights(self.d)
        return ds.ravel(), lam.ravel()
