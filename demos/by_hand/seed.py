"""The seed's formulation: E_Λ = Σ_K λ_K · (W_K s_K - J_K x) V_K with the full Λ (12).

**The term with ε.** p_a = E_a : RᵀΛ holds skew(RᵀΛ) (`demos.by_hand.basis`), |skew|² = p·p/2, so
the added energy is -(ε/4) p·p V_K. Its second derivatives are A_ε, G_ε and C_ε of (35). It is
quadratic in λ; hence its part of the left-hand side times λ is twice (x rows) and once (λ rows) its
gradient, and r_ε is its gradient with respect to x.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from demos.by_hand.basis import Array, dof_weights, einsum, skew_basis
from demos.by_hand.element import block_diagonal
from demos.by_hand.rotation import stretch_operator, stretch_operator_derivative
from demos.by_hand.system import DiscreteSystem

NULL = 1e-10
"""Work of a multiplier on positions, beside the norm of G, below which it does none."""


@dataclass(frozen=True, eq=False)
class SeedSystem(DiscreteSystem):
    """The seed's formulation: the full multiplier Λ, d² a cell.

    As printed (`eps=0`) the matrices of (35) and (41) have d (d - 1) / 2 null vectors a cell at
    every feasible state, and some at every state of any real mesh; the errata say why.

    Attributes:
        eps: ε [1/Pa] of the added -(ε/2) |skew(RᵀΛ)|²; 0 for the printed system. 1/μ scales well.

    Raises:
        ValueError: eps is negative.
    """

    eps: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.eps >= 0.0:
            raise ValueError(f"eps is {self.eps}; the regularisation [1/Pa] must not be negative")

    @property
    def lam(self) -> Array:
        """λ, flat: λ_K = vec(Λ_K)."""
        return self.state.Lam.ravel()

    def multiplier_tensor(self, lam: Array) -> Array:
        """Return Λ (n_e, d, d) of its flat dofs."""
        return lam.reshape(-1, self.d, self.d)

    @cached_property
    def W(self) -> Array:
        """W_K of (3), shape (n_e, d², m)."""
        return stretch_operator(self.polar.R)

    @cached_property
    def W_hat(self) -> Array:
        """Ŵ_K of (16)-(17), indices (entry of F, entry of R S, dof of S)."""
        return stretch_operator_derivative(self.polar.dR)

    @cached_property
    def c_K(self) -> Array:
        """c_K = W_K s_K - J_K x (20), without volume, shape (n_e, d²)."""
        vec_F = self.deformation_gradient.reshape(len(self.W), -1)
        return einsum("nik,nk->ni", self.W, self.s) - vec_F

    @cached_property
    def W_hat_lam(self) -> Array:
        """Ŵ_K · λ_K, reduced over the middle index (29), shape (n_e, d², m)."""
        return einsum("njkl,nk->njl", self.W_hat, self.lam.reshape(len(self.W_hat), -1))

    @cached_property
    def W_hat_s(self) -> Array:
        """Ŵ_K · s_K, reduced over the last index (31), shape (n_e, d², d²)."""
        return einsum("njkl,nl->njk", self.W_hat, self.s)

    @cached_property
    def E_FF(self) -> Array:
        """∂²(λ_K · W_K s_K)/∂vec F², the core of (24), shape (n_e, d², d²)."""
        return self.polar.rotation_hessian(self.state.Lam @ self.state.S)

    @cached_property
    def E_x(self) -> Array:
        """Σ_K J_Kᵀ (Ŵ_K · s_K - I) λ_K V_K (18), flat."""
        lam = self.lam.reshape(len(self.W_hat), -1)
        g: Array = self.J_w.T @ (einsum("njk,nk->nj", self.W_hat_s, lam) - lam).ravel()
        return g

    @cached_property
    def E_s(self) -> Array:
        """W_Kᵀ λ_K V_K (19), flat."""
        lam = self.lam.reshape(len(self.W), -1)
        return (self.volume[:, None] * einsum("nij,ni->nj", self.W, lam)).ravel()

    @cached_property
    def c(self) -> Array:
        """∂E_Λ/∂λ = V_K c_K (20), flat."""
        return (self.volume[:, None] * self.c_K).ravel()

    @cached_property
    def E_xx(self) -> sp.csr_array:
        """∂²E_Λ/∂x² = Σ_K J_Kᵀ (∂²(λ_K · W_K s_K)/∂F²) J_K V_K (24)."""
        return (self.J_w.T @ block_diagonal(self.E_FF) @ self.J).tocsr()

    @cached_property
    def F(self) -> sp.csr_array:
        """F = -Σ P_sᵀ (Ŵ_K · λ_K)ᵀ J_K^w (32)."""
        return -block_diagonal(np.swapaxes(self.W_hat_lam, 1, 2)) @ self.J_w

    @cached_property
    def G(self) -> sp.csr_array:
        """G = J^w - Σ P_λᵀ (Ŵ_K · s_K)ᵀ J_K^w (33)."""
        return self.J_w - block_diagonal(np.swapaxes(self.W_hat_s, 1, 2)) @ self.J_w

    @cached_property
    def D(self) -> sp.csr_array:
        """D = -Σ P_λᵀ W_K P_s V_K: (34) with the volume that it lacks."""
        return -block_diagonal(self.volume[:, None, None] * self.W)

    # The term -(ε/2) |skew(RᵀΛ)|²

    @cached_property
    def _RE(self) -> Array:
        """R E_a = ∂p_a/∂Λ, shape (n_e, a, d, d)."""
        return einsum("nik,akj->naij", self.polar.R, skew_basis(self.d))

    @cached_property
    def _p(self) -> Array:
        """p_a = E_a : RᵀΛ, shape (n_e, a)."""
        return einsum("naij,nij->na", self._RE, self.state.Lam)

    @cached_property
    def _p_F(self) -> Array:
        """∂p_a/∂vec F, shape (n_e, a, d²)."""
        p_F = einsum("nikpq,akj,nij->napq", self.polar.dR, skew_basis(self.d), self.state.Lam)
        return p_F.reshape(*p_F.shape[:2], -1)

    @cached_property
    def cure_x(self) -> Array:
        """r_ε, the gradient of the term with ε with respect to x, flat."""
        weight = -0.5 * self.eps
        g: Array = self.J_w.T @ (weight * einsum("na,nap->np", self._p, self._p_F)).ravel()
        return g

    @cached_property
    def cure_lam(self) -> Array:
        """Gradient of the term with ε with respect to λ, flat."""
        weight = -0.5 * self.eps * self.volume
        return (weight[:, None, None] * einsum("na,naij->nij", self._p, self._RE)).ravel()

    @cached_property
    def cure_xx(self) -> sp.csr_array:
        """A_ε, the x-x block of the term with ε."""
        skew = einsum("na,akj->njk", self._p, skew_basis(self.d))  # (p_a E_a)ᵀ
        blocks = einsum("nap,naq->npq", self._p_F, self._p_F)
        blocks += self.polar.rotation_hessian(self.state.Lam @ skew)
        return (-0.5 * self.eps * self.J_w.T @ block_diagonal(blocks) @ self.J).tocsr()

    @cached_property
    def cure_lx(self) -> sp.csr_array:
        """G_ε, the λ-x block of the term with ε."""
        n = len(self._p)
        blocks = einsum("na,akj,nikpq->nijpq", self._p, skew_basis(self.d), self.polar.dR)
        blocks += einsum("naij,napq->nijpq", self._RE, self._p_F.reshape(self._RE.shape))
        return -0.5 * self.eps * block_diagonal(blocks.reshape(n, self.d**2, -1)) @ self.J_w

    @cached_property
    def C(self) -> sp.csr_array:
        """C_ε, the λ-λ block: -(ε/2) V_K (R E_a) ⊗ (R E_a), zero as printed."""
        RE = self._RE.reshape(*self._p.shape, -1)
        weight = -0.5 * self.eps * self.volume
        return block_diagonal(einsum("n,nap,naq->npq", weight, RE, RE))

    @cached_property
    def A(self) -> sp.csr_array:
        """The x-x block M/h² + A_ε - ∂²E_Λ/∂x², the last if `second_derivatives`."""
        A = self.M / self.h**2 + self.cure_xx
        return (A - self.E_xx if self.second_derivatives else A).tocsr()

    @cached_property
    def G_lhs(self) -> sp.csr_array:
        """The λ-x block G + G_ε."""
        return (self.G + self.cure_lx).tocsr()

    @cached_property
    def rhs_x(self) -> Array:
        """r_ε - g_x: the new multiplier counts the gradient of the term with ε twice."""
        return self.cure_x - self.g_x

    @property
    def multiplier_basis(self) -> sp.csr_array | None:
        """Multipliers Λ = R Y, which the constraint sees; None if eps > 0."""
        return None if self.eps > 0.0 else self._RY

    @property
    def determined_multipliers(self) -> sp.csr_array:
        """A basis of what is orthogonal to the null space of (35) as printed.

        The columns are Λ = R Y, and those Λ = R skew that do work on positions: none at a feasible
        state.
        """
        RE = block_diagonal(np.moveaxis(self._RE.reshape(*self._p.shape, -1), 1, 2) / np.sqrt(2))
        _, work, directions = np.linalg.svd((self.G.T @ RE).toarray(), full_matrices=False)
        kept = work > NULL * spla.norm(self.G)
        working = RE @ (directions[kept].T / work[kept])  # of one size in the system
        return sp.hstack([self._RY, sp.csr_array(working)], format="csr")

    @cached_property
    def _RY(self) -> sp.csr_array:
        """An orthonormal basis of Λ = R Y."""
        return block_diagonal(self.W / np.sqrt(dof_weights(self.d)))

    def energy(self) -> float:
        """Return the discrete energy (2) [J] with the term in ε."""
        p2 = einsum("na,na->n", self._p, self._p)
        return super().energy() - 0.25 * self.eps * float(self.volume @ p2)

    def gradient(self) -> Array:
        """Return (∂E/∂x, ∂E/∂s, ∂E/∂λ), flat, with the term in ε."""
        cure = np.concatenate([self.cure_x, np.zeros_like(self.g_s), self.cure_lam])
        gradient: Array = super().gradient() + cure
        return gradient
