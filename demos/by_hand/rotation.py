"""The rotation R(F) of F = R S_F in SO(d) and its derivatives, vectorised over cells.

S_F is the stretch of F. S without an index is the unknown, which does not change with F. A : B is
Σ_ij A_ij B_ij, skew(A) is (A - Aᵀ)/2. The generators E_a of rotations, three in 3D and one in 2D,
span the skew matrices (`demos.by_hand.basis`): E_a : A sees skew(A) alone, which is zero where
E_a : A = 0 for every a.

**Singular values (14).** F = U Σ Vᵀ with U and V in SO(d), so that the smallest singular value
carries the sign of det F and R = U Vᵀ is in SO(d) for inverted cells too.

**Derivatives of U and V (15).** With P = Uᵀ δF V the off-diagonal entries of Uᵀ δU and Vᵀ δV solve
two equations in two unknowns:

    (Uᵀ δU)_ij = (σ_j P_ij + σ_i P_ji) / (σ_j² - σ_i²),
    (Vᵀ δV)_ij = (σ_i P_ij + σ_j P_ji) / (σ_j² - σ_i²).

Both are singular at equal singular values, the rest state among them. In the sum (15) the factor
σ_j - σ_i cancels and leaves the closed form

    (Uᵀ δR V)_ij = (P_ij - P_ji) / (σ_i + σ_j),

which fails only where σ_i + σ_j = 0 for some i ≠ j; there R itself is not unique.

**Without a basis of singular vectors.** W = Rᵀ δR is skew, W = ω_a E_a. With A = Rᵀ δF the
variation of F = R S_F reads A = W S_F + δS_F. Taken against E_a, to which δS_F is nothing:

    T ω = α,   T_ab = E_a : (E_b S_F),   α_a = E_a : A = (R E_a) : δF.

T is symmetric, in 3D tr(S_F) I - S_F. Hence Ω = ∂ω/∂F = T⁻¹ (R E_a) and δS_F = A - ω_a E_a S_F.

**The second derivative, eq. (24).** E_Λ depends on x through Λ : (R(F) S), and F is linear in x. So
(24) is J_Kᵀ (∂²φ/∂F²) J_K with φ(F) = B : R(F), B = Λ S fixed. Let M = RᵀB and m_a = E_a : M. Then
δφ = B : (R W) = m · ω, and ω = T⁻¹ α makes it q · α with

    T q = m.

As α_a = (R E_a) : δF, the gradient is ∂φ/∂F = R Q with the skew Q = q_a E_a. What Q is: by the
definition of T, E_a : (Q S_F) = (T q)_a = m_a = E_a : M for every a, so that Q S_F - M is
symmetric. Its transpose is -S_F Q - Mᵀ, as Qᵀ = -Q, and so

    Q S_F + S_F Q = M - Mᵀ.

Vary once more, in a direction 2, with δ₁F, B and S fixed. δ₂M = -W₂ M, and T q = m gives δ₂q:

    δ₂(R Q) : δ₁F = A₁ : (W₂ Q) + α₁ · δ₂q,
    (T δ₂q)_a     = -E_a : (W₂ M) - E_a : (Q δ₂S_F).

With A₁ = W₁ S_F + δ₁S_F, with α₁ = T ω₁ and with δS_F : (E_a Q) = -E_a : (Q δS_F) this is

    δ²φ = ω₁ᵀ N ω₂ - ω₁ · ℓ(δ₂S_F) - ω₂ · ℓ(δ₁S_F),
    N_ab = (E_a S_F) : (E_b Q) - E_a : (E_b M),   ℓ_a(δS_F) = E_a : (Q δS_F).

In ℓ one may put A for δS_F = A - W S_F: ℓ_a(W S_F) = ω_b E_a : (Q E_b S_F), and what multiplies
ω_b is skew in a and b, so that ω₁ · ℓ(W₂ S_F) + ω₂ · ℓ(W₁ S_F) = 0. In 3D the skew part of N is
([m]× - [q]× S_F - S_F [q]×) / 2 = 0 by the equation for Q. As matrices,

    ∂²φ/∂F² = Ωᵀ N Ω - Ωᵀ L - Lᵀ Ω,   L_a : δF = ℓ_a(A) = E_a : (Q Rᵀ δF),

symmetric, with T⁻¹ as the only inverse: a 3×3 solve a cell, smooth wherever R is. The errata write
it in indices, which is the form that is evaluated from its text.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from demos.by_hand.basis import Array, einsum, skew_basis, symmetric_basis, symmetric_dofs

# Relative gap of singular values below which a derivative counts as undefined.
GAP = 1e-10


def signed_svd(F: Array) -> tuple[Array, Array, Array]:
    """Return (U, σ, V) with F = U diag(σ) Vᵀ, U and V in SO(d) (eq. 14).

    Args:
        F: Deformation gradients, shape (n, d, d).

    Returns:
        U of shape (n, d, d); σ of shape (n, d), descending in magnitude, the last with the sign of
        det F; V of shape (n, d, d).
    """
    U, sigma, Vt = np.linalg.svd(F)
    V = np.swapaxes(Vt, -1, -2).copy()
    for factor in (U, V):
        sign = np.where(np.linalg.det(factor) < 0.0, -1.0, 1.0)
        factor[..., -1] *= sign[..., None]
        sigma[..., -1] *= sign
    return U, sigma, V


@dataclass(frozen=True, eq=False)
class Polar:
    """The polar decomposition F = R S_F of every cell and its derivatives.

    Derivatives with respect to F have trailing indices kl of F_kl.

    Attributes:
        F: Deformation gradients, shape (n, d, d).
    """

    F: Array

    @cached_property
    def svd(self) -> tuple[Array, Array, Array]:
        """(U, σ, V), see `signed_svd`."""
        return signed_svd(self.F)

    @cached_property
    def R(self) -> Array:
        """Rotation U Vᵀ in SO(d) (eq. 14), shape (n, d, d)."""
        U, _, V = self.svd
        return einsum("nia,nja->nij", U, V)

    @cached_property
    def S_F(self) -> Array:
        """Right stretch S_F = V Σ Vᵀ = RᵀF, shape (n, d, d)."""
        _, sigma, V = self.svd
        return einsum("nia,na,nja->nij", V, sigma, V)

    @cached_property
    def svd_derivatives(self) -> tuple[Array, Array]:
        """(∂U/∂F, ∂V/∂F) of eq. (15), each of shape (n, d, d, d, d).

        Raises:
            ValueError: Two singular values of a cell agree in magnitude. ∂R/∂F exists all the same,
                see `dR`.
        """
        U, sigma, V = self.svd
        gap = sigma[:, None, :] ** 2 - sigma[:, :, None] ** 2  # σ_j² - σ_i² at [i, j]
        inverse = self._inverse_off_diagonal(
            gap,
            np.max(sigma**2, axis=1),
            "∂U/∂F and ∂V/∂F do not exist where two singular values agree; use ∂R/∂F there",
        )
        P = einsum("nka,nlb->nabkl", U, V)  # ∂(Uᵀ F V)_ab / ∂F_kl at fixed U and V
        Pt = np.swapaxes(P, 1, 2)
        si, sj = sigma[:, :, None, None, None], sigma[:, None, :, None, None]
        scale = inverse[..., None, None]
        dU = einsum("nia,nabkl->nibkl", U, scale * (sj * P + si * Pt))
        dV = einsum("nia,nabkl->nibkl", V, scale * (si * P + sj * Pt))
        return dU, dV

    @cached_property
    def dR(self) -> Array:
        """∂R_ij/∂F_kl by the closed form with σ_i + σ_j, shape (n, d, d, d, d).

        Raises:
            ValueError: σ_i + σ_j = 0 in a cell, where R is not unique.
        """
        U, sigma, V = self.svd
        inverse = self._inverse_off_diagonal(
            sigma[:, :, None] + sigma[:, None, :],
            np.max(np.abs(sigma), axis=1),
            "R(F) is not unique where two singular values add up to zero",
        )
        P = einsum("nka,nlb->nabkl", U, V)
        twist = inverse[..., None, None] * (P - np.swapaxes(P, 1, 2))
        return einsum("nia,nabkl,njb->nijkl", U, twist, V)

    @cached_property
    def spin(self) -> Array:
        """Ω = ∂ω/∂F, where δR = R ω_a E_a; shape (n, 1 or 3, d, d)."""
        E = skew_basis(self.F.shape[-1])
        n, a, d = len(self.F), len(E), self.F.shape[-1]
        T = einsum("aij,bik,nkj->nab", E, E, self.S_F)
        RE = einsum("nik,akj->naij", self.R, E).reshape(n, a, d * d)
        return np.linalg.solve(T, RE).reshape(n, a, d, d)

    @cached_property
    def dS_F(self) -> Array:
        """∂(S_F)_ij/∂F_kl = ∂A_ij/∂F_kl - Ω_akl (E_a S_F)_ij, shape (n, d, d, d, d)."""
        E = skew_basis(self.F.shape[-1])
        identity = np.eye(self.F.shape[-1])
        return einsum("nki,jl->nijkl", self.R, identity) - einsum(
            "nakl,aim,nmj->nijkl", self.spin, E, self.S_F
        )

    @cached_property
    def ds_F(self) -> Array:
        """∂s_F/∂vec F in dofs, shape (n, d (d + 1) / 2, d²)."""
        n, d = self.F.shape[:2]
        dofs = symmetric_dofs(np.moveaxis(self.dS_F, (1, 2), (-2, -1)))
        return np.moveaxis(dofs, -1, 1).reshape(n, -1, d * d)

    def rotation_gradient(self, B: Array) -> Array:
        """Return ∂(B : R(F))/∂F = R Q for fixed B, shapes (n, d, d)."""
        return einsum("nik,nkj->nij", self.R, self._torque(B))

    def rotation_hessian(self, B: Array) -> Array:
        """Return ∂²(B : R(F))/∂vec F² for fixed B: the core of eq. (24).

        Args:
            B: Fixed matrices, shape (n, d, d); Λ S for eq. (24).

        Returns:
            Symmetric matrices, shape (n, d², d²).
        """
        n, d = self.F.shape[:2]
        E = skew_basis(d)
        Q = self._torque(B)
        M = einsum("nki,nkj->nij", self.R, B)
        N = einsum("aij,njk,bil,nlk->nab", E, self.S_F, E, Q)
        N -= einsum("aij,bik,nkj->nab", E, E, M)
        N = 0.5 * (N + np.swapaxes(N, 1, 2))  # its skew part is round-off
        omega = self.spin.reshape(n, -1, d * d)
        L = einsum("aiq,nik,npk->napq", E, Q, self.R).reshape(n, -1, d * d)
        cross = einsum("nap,naq->npq", omega, L)
        bend = einsum("nap,nab,nbq->npq", omega, N, omega)
        return bend - cross - np.swapaxes(cross, 1, 2)

    def stretch_gradient(self, Y: Array) -> Array:
        """Return ∂(Y : S_F)/∂F = R Y + R Q for fixed symmetric Y, with Q of B = F Y."""
        return einsum("nik,nkj->nij", self.R, Y + self._torque(self.F @ Y))

    def stretch_hessian(self, Y: Array) -> Array:
        """Return ∂²(Y : S_F)/∂vec F² for fixed symmetric Y.

        Y : S_F = (F Y) : R, so that F enters twice: the Hessian of B : R at B = F Y, plus
        (δ₁F Y) : δ₂R and the same with 1 and 2 exchanged. Unlike the form with Z from
        Z S_F + S_F Z = Y it needs no σ_i ≠ 0.

        Args:
            Y: Symmetric matrices, shape (n, d, d).

        Returns:
            Symmetric matrices, shape (n, d², d²).
        """
        n, d = self.F.shape[:2]
        cross = einsum("nim,nmjkl->nijkl", Y, np.moveaxis(self.dR, 2, 1))
        cross = np.moveaxis(cross, 1, 2).reshape(n, d * d, d * d)
        return self.rotation_hessian(self.F @ Y) + cross + np.swapaxes(cross, 1, 2)

    def _torque(self, B: Array) -> Array:
        """Q = q_a E_a with T q = m: skew, shape (n, d, d)."""
        return einsum(
            "nki,nkj->nij",
            self.R,
            einsum("nakl,na->nkl", self.spin, self._skew_components(B)),
        )

    def _skew_components(self, B: Array) -> Array:
        """m_a = E_a : RᵀB, shape (n, 1 or 3)."""
        return einsum("aij,nki,nkj->na", skew_basis(B.shape[-1]), self.R, B)

    @staticmethod
    def _inverse_off_diagonal(denominator: Array, scale: Array, message: str) -> Array:
        """1 / denominator off the diagonal, 0 on it."""
        off = ~np.eye(denominator.shape[-1], dtype=bool)
        bad = np.any((np.abs(denominator) <= GAP * scale[:, None, None]) & off, axis=(1, 2))
        if np.any(bad):
            raise ValueError(f"{message}: cells {np.flatnonzero(bad)[:10].tolist()}")
        return np.where(off, 1.0, 0.0) / np.where(off, denominator, 1.0)


def stretch_operator(R: Array) -> Array:
    """Return W_K(F) of eq. (3), W_K s = vec(R S): shape (n, d², d (d + 1) / 2)."""
    n, d = R.shape[:2]
    W = einsum("nim,kmj->nijk", R, symmetric_basis(d))
    return W.reshape(n, d * d, -1)


def stretch_operator_derivative(dR: Array) -> Array:
    """Return Ŵ_K of eqs. (16)-(17) in the index order that eqs. (18)-(33) use.

    Args:
        dR: ∂R_ij/∂F_kl, shape (n, d, d, d, d).

    Returns:
        Ŵ_jkl = ∂W_kl/∂(vec F)_j, shape (n, d², d², d (d + 1) / 2): first index the entry of F, then
        that of vec(R S), then the dof of S.
    """
    n, d = dR.shape[:2]
    W_hat = einsum("nimpq,kmj->npqijk", dR, symmetric_basis(d))
    return W_hat.reshape(n, d * d, d * d, -1)
