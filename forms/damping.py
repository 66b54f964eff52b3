"""Rayleigh damping: in the limit of small motions the force (ηM M + ηK K) ẋ."""

from __future__ import annotations

from dataclasses import dataclass

import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from forms.constants import as_constant
from forms.time import Scheme


@dataclass(frozen=True)
class Rayleigh:
    """Damping by inertia and by stiffness, each the potential of a dissipation.

    By inertia ηM ρ/2 |ẋ|²; by stiffness ηK (μ |Ṡ|² + λ/2 tr² Ṡ) with Hooke's moduli, Ṡ being the
    mean rate of the right stretch between the start of the step and the point where Ψ is taken:
    rigid motions are not damped. It is of first order in h, with the midpoint rule of second where
    motions are small.

    Attributes:
        mass: ηM [1/s].
        stiffness: ηK [s].
        moduli: Lamé parameters (μ, λ) [Pa], numbers or expressions; needed with a stiffness where Ψ
            is no `Material`.
    """

    mass: float = 0.0
    stiffness: float = 0.0
    moduli: tuple[float | Expr, float | Expr] | None = None

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ValueError: A factor is negative.
        """
        for name in ("mass", "stiffness"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; damping must not be negative")

    def of_mass(self, scheme: Scheme, rho: Expr) -> Expr:
        """Return the potential of -ηM ρ ẋ [J/m³], as a function of u at the end of the step."""
        eta = as_constant(self.mass, scheme.u.function_space.mesh)
        velocity = scheme.point_velocity(scheme.u)
        # The point moves by θ of u, its velocity by `point_rate`.
        theta = as_constant(scheme.theta, scheme.u.function_space.mesh)
        return eta * rho * theta / (2 * scheme.point_rate) * ufl.inner(velocity, velocity)

    def of_stiffness(
        self, scheme: Scheme, S: Expr, S_old: fem.Function, moduli: tuple[float | Expr, ...]
    ) -> Expr:
        """Return the potential of the viscous stress [J/m³].

        Args:
            scheme: The scheme.
            S: Right stretch at the point.
            S_old: Right stretch at the start of the step.
            moduli: Lamé parameters (μ, λ) [Pa].
        """
        msh = scheme.u.function_space.mesh
        eta, theta = as_constant(self.stiffness, msh), as_constant(scheme.theta, msh)
        mu, lam = (as_constant(value, msh) for value in moduli)
        change = S - S_old
        quadratic = mu * ufl.inner(change, change) + lam / 2 * ufl.tr(change) ** 2
        return eta / (theta * scheme.h) * quadratic
