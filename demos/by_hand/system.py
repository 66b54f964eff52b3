"""The hand-derived discrete Newton system of the seed, eqs. (2)-(41), in NumPy.

Two formulations of the discrete energy (2), E = E_M + E_Ψ - E_Λ (6):

- `SeedSystem` in `demos.by_hand.seed`: E_Λ = Σ_K λ_K · (W_K s_K - J_K x) V_K with the full Λ (12),
  and optionally -(ε/2) Σ_K |skew(R_KᵀΛ_K)|² V_K, which fixes the null space of (35) and changes
  neither x, S nor sym(RᵀΛ) of a stationary point.
- `SymmetricSystem` in `demos.by_hand.symmetric`: Λ = R Y with Y symmetric,
  E_Λ = Σ_K Y_K : (S_K - sym(R_KᵀF_K)) V_K.

Either gives a Newton system for (δx, δs, λ), λ the *new* multiplier as in (27)-(41):

    | A        Fᵀ  (G + G_ε)ᵀ | |δx|   | r_ε - g_x |
    | F        H   Dᵀ         | |δs| = | -g_s      |        (35)
    | G + G_ε  D   C_ε        | |λ |   |  c        |

with A = M/h² + A_ε - ∂²E_Λ/∂x². The seed drops ∂²E_Λ/∂x² (24): `second_derivatives=False`. A_ε,
G_ε, C_ε and r_ε are derivatives of the term with ε; as printed, and with Λ = R Y, all are zero.
Every block carries the cell volumes: F = ∂²E/∂s∂x, G = ∂²E/∂λ∂x, D = ∂²E/∂λ∂s, H = ∂²E/∂s²,
c = ∂E_Λ/∂λ, g_s = ∂E_Ψ/∂s, and g_x = ∂E_M/∂x = M (x - x̃)/h². E without ε is meant.

**Orderings.** x dof = d * vertex + component; s dof = m * cell + k, m = d (d + 1) / 2; λ dof =
d² * cell + d * i + j for Λ_ij (seed) or m * cell + k (symmetric). See `demos.by_hand.basis`.

**Blocks** are lazy and derive from one another as in the text (W_hat → F, G → J_tilde → reduced()).
`with_blocks(W_hat=...)` returns a system in which a block is replaced before any other is computed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import scipy.sparse as sp

from demos.by_hand.basis import Array, symmetric_tensor
from demos.by_hand.element import (
    block_diagonal,
    element_jacobians,
    global_jacobian,
    mass_matrix,
    volumes,
)
from demos.by_hand.materials import Material
from demos.by_hand.rotation import Polar
from demos.by_hand.state import State


@dataclass(frozen=True, eq=False)
class DiscreteSystem(ABC):
    """What both formulations share: inertia, material and the algebra of (35)-(41).

    Attributes:
        state: The current iterate, the point of linearisation.
        material: Strain energy density.
        rho: Density ρ [kg/m³], a number or one per cell.
        h: Time step [s].
        v: Velocity at the start of the step [m/s], shape (n, d) or (d,).
        f_ext: External acceleration [m/s²], shape (n, d) or (d,).
        x_n: Positions at the start of the step [m], shape (n, d); those of `state` by default. The
            seed writes x^t for both; they differ from the second Newton iteration of a step on.
        second_derivatives: Whether ∂²E_Λ/∂x² (24) enters; the seed drops it.

    Raises:
        ValueError: h is not positive.
    """

    state: State
    material: Material
    rho: float | Array = 1.0
    h: float = 1.0
    v: Array | float = 0.0
    f_ext: Array | float = 0.0
    x_n: Array | None = None
    second_derivatives: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.h) and self.h > 0.0):
            raise ValueError(f"h is {self.h}; the time step [s] must be positive and finite")

    def with_blocks(self, **blocks: Any) -> Self:
        """Return this system with named blocks replaced; those that depend on them follow.

        Replacements hold for this linearisation alone: `moved` and a further `with_blocks` start
        from the blocks as derived.

        Args:
            **blocks: Any of `block_names()` with its replacement, of the block's own shape.

        Raises:
            ValueError: A name is not that of a block.
        """
        unknown = sorted(set(blocks) - set(self.block_names()))
        if unknown:
            raise ValueError(f"no block {', '.join(unknown)}; one of {self.block_names()}")
        new = replace(self)
        new.__dict__.update(blocks)  # where cached_property keeps what it has computed
        return new

    @classmethod
    def block_names(cls) -> tuple[str, ...]:
        """Return the names that `with_blocks` takes: arrays and sparse matrices."""
        return tuple(
            name
            for name in dir(cls)
            if isinstance(getattr(cls, name, None), cached_property)
            and not (name.startswith("_") or name == "polar")
        )

    def moved(self, dx: Array, ds: Array, dlam: Array) -> Self:
        """Return the system at x + dx, s + ds, λ + dlam (flat or shaped increments).

        The start of the time step stays where it was.
        """
        state = self.state
        new = replace(
            state,
            x=state.x + np.reshape(dx, state.x.shape),
            S=state.S + symmetric_tensor(np.reshape(ds, self.s.shape)),
            Lam=self.multiplier_tensor(self.lam + np.ravel(dlam)),
        )
        return replace(self, state=new, x_n=self.start)

    # Unknowns

    @property
    def d(self) -> int:
        """Space dimension."""
        return int(self.state.X.shape[1])

    @property
    def s(self) -> Array:
        """s_K, shape (n_e, m)."""
        return self.state.s

    @property
    @abstractmethod
    def lam(self) -> Array:
        """The current multipliers, flat."""

    @abstractmethod
    def multiplier_tensor(self, lam: Array) -> Array:
        """Return the multipliers (n_e, d, d) of their flat dofs."""

    @property
    def start(self) -> Array:
        """Positions at the start of the step [m], shape (n, d)."""
        return self.state.x if self.x_n is None else self.x_n

    @property
    def x_tilde(self) -> Array:
        """x̃ = x^t + h ẋ^t + h² f_ext [m], shape (n, d)."""
        x_tilde: Array = (
            self.start + self.h * np.asarray(self.v) + self.h**2 * np.asarray(self.f_ext)
        )
        return x_tilde

    # Cells

    @cached_property
    def volume(self) -> Array:
        """V_K [m³], shape (n_e,)."""
        return volumes(self.state.X, self.state.cells)

    @cached_property
    def J_K(self) -> Array:
        """J_K of (4) on the cell's own dofs, shape (n_e, d², d (d + 1))."""
        return element_jacobians(self.state.X, self.state.cells)

    @cached_property
    def J(self) -> sp.csr_array:
        """All J_K stacked: J x = vec(F), sparse, (d² n_e, d n)."""
        return global_jacobian(self.J_K, self.state.cells, len(self.state.X), self.d)

    @cached_property
    def J_w(self) -> sp.csr_array:
        """J^w, the volume-weighted J of (32)-(33)."""
        return sp.diags_array(np.repeat(self.volume, self.d**2)) @ self.J

    @cached_property
    def deformation_gradient(self) -> Array:
        """F_K(x) by (4), shape (n_e, d, d)."""
        vec_F: Array = self.J @ self.state.x.ravel()
        return vec_F.reshape(-1, self.d, self.d)

    @cached_property
    def polar(self) -> Polar:
        """R_K, S(F_K) and their derivatives."""
        return Polar(self.deformation_gradient)

    # Energies and their derivatives that do not involve the multiplier

    @cached_property
    def M(self) -> sp.csr_array:
        """Consistent mass matrix M [kg]."""
        cells = self.state.cells
        return mass_matrix(self.volume, self.rho, cells, len(self.state.X), self.d)

    @cached_property
    def g_x(self) -> Array:
        """∂E_M/∂x = M (x - x̃)/h², flat: the g_x of (27)-(41), not of (9)."""
        g: Array = self.M @ (self.state.x - self.x_tilde).ravel() / self.h**2
        return g

    @cached_property
    def g_K(self) -> Array:
        """∂Ψ/∂s_K [Pa], shape (n_e, m)."""
        return self.material.g(self.s)

    @cached_property
    def H_K(self) -> Array:
        """∂²Ψ/∂s_K² [Pa], shape (n_e, m, m)."""
        return self.material.H(self.s)

    @cached_property
    def g_s(self) -> Array:
        """∂E_Ψ/∂s = V_K g_K, flat."""
        return (self.volume[:, None] * self.g_K).ravel()

    @cached_property
    def H(self) -> sp.csr_array:
        """∂²E_Ψ/∂s², block diagonal with V_K H_K."""
        return block_diagonal(self.volume[:, None, None] * self.H_K)

    @cached_property
    def H_inv(self) -> sp.csr_array:
        """H⁻¹, cell by cell.

        Raises:
            numpy.linalg.LinAlgError: H_K is singular in a cell.
        """
        return block_diagonal(np.linalg.inv(self.volume[:, None, None] * self.H_K))

    def E_M(self) -> float:
        """Return the kinetic energy term |x - x̃|²_M / (2h²) of (7) [J]."""
        dx = (self.state.x - self.x_tilde).ravel()
        return float(dx @ (self.M @ dx)) / (2.0 * self.h**2)

    def E_Psi(self) -> float:
        """Return Σ_K Ψ(s_K) V_K [J]."""
        return float(self.volume @ self.material.psi(self.s))

    def E_Lambda(self) -> float:
        """Return the constraint energy λ · c of (12) [J]."""
        return float(self.lam @ self.c)

    def energy(self) -> float:
        """Return the discrete energy (2) [J], with the regularisation where there is one."""
        return self.E_M() + self.E_Psi() - self.E_Lambda()

    def gradient(self) -> Array:
        """Return (∂E/∂x, ∂E/∂s, ∂E/∂λ), flat: the residual of Newton's method."""
        return np.concatenate(
            [
                self.g_x - self.E_x,
                self.g_s - self.E_s,
                -self.c,
            ]
        )

    # Blocks that depend on the formulation

    @property
    @abstractmethod
    def E_x(self) -> Array:
        """∂E_Λ/∂x, flat."""

    @property
    @abstractmethod
    def E_s(self) -> Array:
        """∂E_Λ/∂s, flat."""

    @property
    @abstractmethod
    def c(self) -> Array:
        """∂E_Λ/∂λ, volume-weighted, flat."""

    @property
    @abstractmethod
    def E_xx(self) -> sp.csr_array:
        """∂²E_Λ/∂x² (24), volume-weighted."""

    @property
    @abstractmethod
    def F(self) -> sp.csr_array:
        """∂²E/∂s∂x."""

    @property
    @abstractmethod
    def G(self) -> sp.csr_array:
        """∂²E/∂λ∂x."""

    @property
    @abstractmethod
    def D(self) -> sp.csr_array:
        """∂²E/∂λ∂s."""

    @property
    def multiplier_basis(self) -> sp.csr_array | None:
        """Columns that span the multipliers the constraint sees; None where it sees them all."""
        return None

    # The Newton system

    @cached_property
    def A(self) -> sp.csr_array:
        """The x-x block M/h², minus ∂²E_Λ/∂x² if `second_derivatives`."""
        A = self.M / self.h**2
        return (A - self.E_xx if self.second_derivatives else A).tocsr()

    @cached_property
    def G_lhs(self) -> sp.csr_array:
        """The λ-x block of the Newton matrix, G + G_ε."""
        return self.G

    @cached_property
    def C(self) -> sp.csr_array:
        """The λ-λ block C_ε, zero as printed."""
        return sp.csr_array((self.G.shape[0], self.G.shape[0]))

    @cached_property
    def rhs_x(self) -> Array:
        """The x rows of the right-hand side, -g_x as printed, r_ε - g_x with ε."""
        return -self.g_x

    def kkt(self) -> tuple[sp.csr_array, Array]:
        """Return matrix and right-hand side of (35) for (δx, δs, λ), λ the new multiplier."""
        matrix = sp.block_array(
            [
                [self.A, self.F.T, self.G_lhs.T],
                [self.F, self.H, self.D.T],
                [self.G_lhs, self.D, self.C],
            ],
            format="csr",
        )
        return matrix, np.concatenate([self.rhs_x, -self.g_s, self.c])

    @cached_property
    def M_tilde(self) -> sp.csr_array:
        """M̃ = A - Fᵀ H⁻¹ F (39)."""
        return (self.A - self.F.T @ self.H_inv @ self.F).tocsr()

    @cached_property
    def J_tilde(self) -> sp.csr_array:
        """J̃ = G - D H⁻¹ F (40)."""
        return (self.G_lhs - self.D @ self.H_inv @ self.F).tocsr()

    @cached_property
    def DHD(self) -> sp.csr_array:
        """D H⁻¹ Dᵀ of (38) and (41), block diagonal."""
        return (self.D @ self.H_inv @ self.D.T).tocsr()

    def reduced(self) -> tuple[sp.csr_array, Array]:
        """Return matrix and right-hand side of (41) for (δx, λ)."""
        matrix = sp.block_array(
            [[self.M_tilde, self.J_tilde.T], [self.J_tilde, self.C - self.DHD]], format="csr"
        )
        H_inv_g = self.H_inv @ self.g_s
        return matrix, np.concatenate([self.F.T @ H_inv_g + self.rhs_x, self.c + self.D @ H_inv_g])

    def recover_ds(self, dx: Array, lam: Array) -> Array:
        """Return δs = H⁻¹ (-g_s - Dᵀ λ - F δx) of (36), flat."""
        ds: Array = self.H_inv @ (-self.g_s - self.D.T @ lam - self.F @ dx)
        return ds
