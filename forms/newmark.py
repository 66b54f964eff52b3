"""Newmark's method and the generalised-α method, as potentials of the displacement.

    u = uᵗ + h ẋᵗ + h² ((1/2 - β) ẍᵗ + β ẍ),   ẋ = ẋᵗ + h ((1 - γ) ẍᵗ + γ ẍ),

ẍᵗ being the acceleration with which the step before was in equilibrium. The first step has β = 1/2
and γ = 1, in which no ẍᵗ is left: its error, of third order in u and of second order in ẋ, is made
once and keeps the order.

N. M. Newmark, A method of computation for structural dynamics, J. Eng. Mech. Div. 85(3), 1959;
J. Chung, G. M. Hulbert, A time integration algorithm for structural dynamics with improved
numerical dissipation: the generalized-α method, J. Appl. Mech. 60(2), 1993.
"""

from __future__ import annotations

import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from forms.spaces import function
from forms.time import Array, Scheme


class Newmark(Scheme):
    """Newmark's method with β, γ: second order for γ = 1/2, else first; damps for γ > 1/2.

    Attributes:
        a: Acceleration at the start of the step [m/s²].
    """

    def __init__(
        self, u: fem.Function, h: float | fem.Constant, *, beta: float = 0.25, gamma: float = 0.5
    ) -> None:
        """Start from the current displacement, at rest.

        Args:
            u: Displacement [m], shape (d,).
            h: Time step [s].
            beta: Weight β of the new acceleration in the displacement; at least γ/2 for stability
                at every h.
            gamma: Weight γ of the new acceleration in the velocity.

        Raises:
            ValueError: h or β is not positive, or γ is below 1/2, where the motion grows.
        """
        super().__init__(u, h)
        if not beta > 0.0:
            raise ValueError(f"beta is {beta}; it must be positive, such as 0.25")
        if not gamma >= 0.5:
            raise ValueError(f"gamma is {gamma}; it must be 0.5 or more, or the motion grows")
        self.order = 2 if gamma == 0.5 else 1
        self.error_constant = abs(beta - 1 / 6) if gamma == 0.5 else abs(gamma - 0.5)
        self.a = function(u.function_space, name="a")
        self._later = beta, gamma
        msh = u.function_space.mesh
        self._beta, self._gamma = fem.Constant(msh, 0.5), fem.Constant(msh, 1.0)

    def kinetic(self, rho: float | Expr) -> Expr:
        """Return ρ/(2βh²) |u - uᵗ - h ẋᵗ - h² (1/2 - β) ẍᵗ|² [J/m³]."""
        return self._inertia(self._predictor(), rho, self.h * ufl.sqrt(self._beta))

    def velocity(self) -> Array:
        """Return ẋᵗ + h ((1 - γ) ẍᵗ + γ ẍ)."""
        h, gamma = float(self.h.value), float(self._gamma.value)
        mean = (1 - gamma) * self.a.x.array + gamma * self._new_acceleration()
        return self.v.x.array + h * mean

    def point_velocity(self, u: Expr) -> Expr:
        """Return ẋ as a function of u."""
        a = (u - self._predictor()) / (self._beta * self.h**2)
        return self.v + self.h * ((1 - self._gamma) * self.a + self._gamma * a)

    @property
    def point_rate(self) -> Expr:
        """γ/(βh)."""
        return self._gamma / (self._beta * self.h)

    def advance(self) -> None:
        """Take the current displacement as the end of the step."""
        a = self._new_acceleration()
        super().advance()
        self.a.x.array[:] = a
        self._beta.value[...], self._gamma.value[...] = self._later

    def _predictor(self) -> Expr:
        return self.u_old + self.h * self.v + self.h**2 * (0.5 - self._beta) * self.a

    def _new_acceleration(self) -> Array:
        h, beta = float(self.h.value), float(self._beta.value)
        change = self.u.x.array - self.u_old.x.array - h * self.v.x.array
        return change / (beta * h**2) - (0.5 - beta) / beta * self.a.x.array


class Trapezoidal(Newmark):
    """Trapezoidal rule, Newmark's method with β = 1/4, γ = 1/2: second order, without damping.

    It keeps quadratic energies from its second step on.
    """

    def __init__(self, u: fem.Function, h: float | fem.Constant) -> None:
        """Start from the current displacement, at rest, see `Scheme`."""
        super().__init__(u, h)


class GeneralisedAlpha(Newmark):
    """Generalised-α method with ρ∞: second order; damps what h does not resolve, and little else.

        (1 - α_m) ẍ + α_m ẍᵗ balances Ψ and loads at (1 - α_f) u + α_f uᵗ,

    α_m = (2ρ∞ - 1)/(ρ∞ + 1), α_f = ρ∞/(ρ∞ + 1), β = (1 - α_m + α_f)²/4, γ = 1/2 - α_m + α_f. The
    first step has α_m = 0.
    """

    def __init__(self, u: fem.Function, h: float | fem.Constant, *, rho_inf: float = 0.8) -> None:
        """Start from the current displacement, at rest.

        Args:
            u: Displacement [m], shape (d,).
            h: Time step [s].
            rho_inf: Factor ρ∞ from 0 to 1 by which a step multiplies what is infinitely fast.

        Raises:
            ValueError: h is not positive, or ρ∞ is not between 0 and 1.
        """
        if not 0.0 <= rho_inf <= 1.0:
            raise ValueError(f"rho_inf is {rho_inf}; it must lie between 0 and 1, both included")
        alpha_m, alpha_f = (2 * rho_inf - 1) / (rho_inf + 1), rho_inf / (rho_inf + 1)
        beta = (1 - alpha_m + alpha_f) ** 2 / 4
        super().__init__(u, h, beta=beta, gamma=0.5 - alpha_m + alpha_f)
        self.order = 2
        self.error_constant = abs(beta + (alpha_m - alpha_f) / 2 - 1 / 6)
        self.theta = 1 - alpha_f
        msh = u.function_space.mesh
        self._theta, self._alpha_m = fem.Constant(msh, self.theta), fem.Constant(msh, 0.0)
        self._later_alpha_m = alpha_m

    def kinetic(self, rho: float | Expr) -> Expr:
        """Return θ (1 - α_m) ρ/(2βh²) |u - predictor|² [J/m³], as the point moves by θ of u."""
        weight = 1 - self._alpha_m
        predictor = self._predictor() - self._alpha_m / weight * self._beta * self.h**2 * self.a
        tau = self.h * ufl.sqrt(self._beta / (self._theta * weight))
        return self._inertia(predictor, rho, tau)

    def point(self, u: Expr) -> Expr:
        """Return (1 - α_f) u + α_f uᵗ."""
        return self._theta * u + (1 - self._theta) * self.u_old

    def point_velocity(self, u: Expr) -> Expr:
        """Return (1 - α_f) ẋ + α_f ẋᵗ."""
        return self._theta * super().point_velocity(u) + (1 - self._theta) * self.v

    @property
    def point_rate(self) -> Expr:
        """(1 - α_f) γ/(βh)."""
        return self._theta * super().point_rate

    def advance(self) -> None:
        """Take the current displacement as the end of the step."""
        super().advance()
        self._alpha_m.value[...] = self._later_alpha_m
