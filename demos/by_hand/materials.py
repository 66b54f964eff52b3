"""Strain energy densities by hand: Ψ, g_K = ∂Ψ/∂s and H_K = ∂²Ψ/∂s² (eqs. 10-11).

Derivatives are with respect to the symmetric dofs (`demos.by_hand.basis`), so that off-diagonal
entries carry their factor 2. λ and μ are the plain Lamé parameters of E and ν.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from demos.by_hand.basis import Array, einsum, symmetric_basis, symmetric_tensor


def lame_parameters(E: float, nu: float) -> tuple[float, float]:
    """Return (μ, λ) [Pa] of Young's modulus E [Pa] and Poisson's ratio ν; plane strain in 2D."""
    mu = E / (2 + 2 * nu)
    return mu, 2 * mu * nu / (1 - 2 * nu)


def cofactor(S: Array) -> Array:
    """Return cof S = ∂(det S)/∂S, shape (n, d, d)."""
    if S.shape[-1] == 2:
        a, b, c, d = S[:, 0, 0], S[:, 0, 1], S[:, 1, 0], S[:, 1, 1]
        return np.stack([np.stack([d, -c], -1), np.stack([-b, a], -1)], -2)
    e = _permutation_symbol()
    return 0.5 * einsum("ikm,jlp,nkl,nmp->nij", e, e, S, S)


def cofactor_derivative(S: Array) -> Array:
    """Return ∂(cof S)_ij/∂S_kl, shape (n, d, d, d, d)."""
    if S.shape[-1] == 2:
        e = np.array([[0.0, 1.0], [-1.0, 0.0]])
        return np.broadcast_to(einsum("ik,jl->ijkl", e, e), (len(S), 2, 2, 2, 2))
    e = _permutation_symbol()
    return einsum("ikm,jlp,nmp->nijkl", e, e, S)


def _permutation_symbol() -> Array:
    e = np.zeros((3, 3, 3))
    e[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
    e[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = -1.0
    return e


@dataclass(frozen=True)
class Material(ABC):
    """A strain energy density of the right stretch.

    Attributes:
        mu: First Lamé parameter μ [Pa], a number or one per cell.
        lam: Second Lamé parameter λ [Pa], a number or one per cell.
    """

    mu: float | Array
    lam: float | Array = 0.0

    @abstractmethod
    def psi(self, s: Array) -> Array:
        """Return Ψ [J/m³], shape (n,), of the dofs s, shape (n, d (d + 1) / 2)."""

    @abstractmethod
    def stress(self, S: Array) -> Array:
        """Return ∂Ψ/∂S [Pa] with the entries of S varied independently, shape (n, d, d)."""

    @abstractmethod
    def tangent(self, S: Array) -> Array:
        """Return ∂²Ψ/∂S² [Pa] with the entries varied independently, shape (n, d, d, d, d)."""

    def g(self, s: Array) -> Array:
        """Return g_K = ∂Ψ/∂s [Pa], shape (n, d (d + 1) / 2)."""
        S = symmetric_tensor(s)
        return einsum("kij,nij->nk", symmetric_basis(S.shape[-1]), self.stress(S))

    def H(self, s: Array) -> Array:
        """Return H_K = ∂²Ψ/∂s² [Pa], shape (n, m, m) with m = d (d + 1) / 2."""
        S = symmetric_tensor(s)
        B = symmetric_basis(S.shape[-1])
        return einsum("pij,nijkl,qkl->npq", B, self.tangent(S), B)


def _per_cell(value: float | Array, n: int, indices: int = 0) -> Array:
    """The parameter of each of n cells, with as many trailing axes of length 1."""
    return np.broadcast_to(np.asarray(value, dtype=float), (n,)).reshape(n, *(1,) * indices)


class AsRigidAsPossible(Material):
    """Ψ = μ |S - I|²; λ does not enter."""

    def psi(self, s: Array) -> Array:
        """Return Ψ [J/m³]."""
        E = symmetric_tensor(s)
        E = E - np.eye(E.shape[-1])
        psi: Array = _per_cell(self.mu, len(s)) * einsum("nij,nij->n", E, E)
        return psi

    def stress(self, S: Array) -> Array:
        """Return 2 μ (S - I) [Pa]."""
        stress: Array = 2 * _per_cell(self.mu, len(S), 2) * (S - np.eye(S.shape[-1]))
        return stress

    def tangent(self, S: Array) -> Array:
        """Return 2 μ 𝕀 [Pa]."""
        identity = np.eye(S.shape[-1])
        fourth = einsum("ik,jl->ijkl", identity, identity)
        tangent: Array = 2 * _per_cell(self.mu, len(S), 4) * fourth
        return tangent


class Corotational(AsRigidAsPossible):
    """Ψ = μ |S - I|² + λ/2 tr²(S - I), linear corotational."""

    def psi(self, s: Array) -> Array:
        """Return Ψ [J/m³]."""
        S = symmetric_tensor(s)
        trace = einsum("nii->n", S) - S.shape[-1]
        psi: Array = super().psi(s) + _per_cell(self.lam, len(s)) / 2 * trace**2
        return psi

    def stress(self, S: Array) -> Array:
        """Return 2 μ (S - I) + λ tr(S - I) I [Pa]."""
        identity = np.eye(S.shape[-1])
        trace = (einsum("nii->n", S) - S.shape[-1])[:, None, None]
        stress: Array = super().stress(S) + _per_cell(self.lam, len(S), 2) * trace * identity
        return stress

    def tangent(self, S: Array) -> Array:
        """Return 2 μ 𝕀 + λ I ⊗ I [Pa]."""
        identity = np.eye(S.shape[-1])
        dyad = einsum("ij,kl->ijkl", identity, identity)
        tangent: Array = super().tangent(S) + _per_cell(self.lam, len(S), 4) * dyad
        return tangent


class StableNeoHookean(Material):
    """Ψ = μ (1 - J) + λ/2 (J - 1)² + μ/2 (tr S² - d), J = det S."""

    def psi(self, s: Array) -> Array:
        """Return Ψ [J/m³]."""
        S = symmetric_tensor(s)
        J = np.linalg.det(S)
        mu, lam = _per_cell(self.mu, len(s)), _per_cell(self.lam, len(s))
        psi: Array = (
            mu * (1 - J)
            + lam / 2 * (J - 1) ** 2
            + mu / 2 * (einsum("nij,nij->n", S, S) - S.shape[-1])
        )
        return psi

    def stress(self, S: Array) -> Array:
        """Return (λ (J - 1) - μ) cof S + μ S [Pa]."""
        J = np.linalg.det(S)[:, None, None]
        mu, lam = _per_cell(self.mu, len(S), 2), _per_cell(self.lam, len(S), 2)
        stress: Array = (lam * (J - 1) - mu) * cofactor(S) + mu * S
        return stress

    def tangent(self, S: Array) -> Array:
        """Return (λ (J - 1) - μ) ∂(cof S)/∂S + λ cof S ⊗ cof S + μ 𝕀 [Pa]."""
        J = np.linalg.det(S)[:, None, None, None, None]
        mu, lam = _per_cell(self.mu, len(S), 4), _per_cell(self.lam, len(S), 4)
        cof = cofactor(S)
        identity = np.eye(S.shape[-1])
        tangent: Array = (
            (lam * (J - 1) - mu) * cofactor_derivative(S)
            + lam * einsum("nij,nkl->nijkl", cof, cof)
            + mu * einsum("ik,jl->ijkl", identity, identity)
        )
        return tangent


MATERIALS: dict[str, type[Material]] = {
    "as-rigid-as-possible": AsRigidAsPossible,
    "corotational": Corotational,
    "stable-neo-hookean": StableNeoHookean,
}
"""Materials by the name that a scene file uses."""
