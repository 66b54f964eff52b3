"""Time discretisation of the kinetic term."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr


class BackwardEuler:
    """Backward Euler as an incremental potential: ρ/(2h²) |x - x̃|², x̃ = xᵗ + h ẋᵗ + h² f_ext.

    The kinetic term of the seed's eqs. (1), (7) and (8). Make it once; `advance` moves to the next
    step by changing values only.

    Attributes:
        u: The displacement [m] being solved for.
        u_old: Displacement at the start of the step [m].
        v: Velocity at the start of the step [m/s].
        h: Time step [s], a constant whose `value` may be changed between steps.
        acceleration: External acceleration f_ext [m/s²], a constant of shape (d,).
        t: Time at the start of the step [s].
    """

    def __init__(
        self, u: fem.Function, h: float, acceleration: Sequence[float] | None = None
    ) -> None:
        """Start from the current displacement, at rest.

        Args:
            u: Displacement [m], shape (d,).
            h: Time step [s].
            acceleration: External acceleration f_ext [m/s²], d numbers; none by default.

        Raises:
            ValueError: h is not positive, or the acceleration has not d components.
        """
        if not (np.isfinite(h) and h > 0.0):
            raise ValueError(f"h is {h}; the time step [s] must be positive and finite")
        f_ext = np.zeros(len(u)) if acceleration is None else np.array(acceleration, dtype=float)
        if f_ext.shape != (len(u),):
            raise ValueError(
                f"the acceleration has {f_ext.size} components; the body lives in {len(u)}D"
            )
        V = u.function_space
        self.u = u
        self.u_old = fem.Function(V, name="u_old")
        self.u_old.x.array[:] = u.x.array
        self.v = fem.Function(V, name="v")
        self.h = fem.Constant(V.mesh, float(h))
        self.acceleration = fem.Constant(V.mesh, f_ext)
        self.t = 0.0

    def kinetic(self, rho: float | Expr) -> Expr:
        """Return ρ/(2h²) |x - x̃|² [J/m³] for a density rho [kg/m³]."""
        rho = _as_constant(rho, self.u)
        predictor = self.u_old + self.h * self.v + self.h**2 * self.acceleration
        return rho / (2 * self.h**2) * ufl.inner(self.u - predictor, self.u - predictor)

    def advance(self) -> None:
        """Take the current displacement as the end of the step: ẋ = (u - u_old) / h."""
        self.v.x.array[:] = (self.u.x.array - self.u_old.x.array) / self.h.value
        self.u_old.x.array[:] = self.u.x.array
        self.t += float(self.h.value)

    def kinetic_energy(self, rho: float | Expr) -> Expr:
        """Return ρ/2 |ẋ|² [J/m³] at the start of the step."""
        return _as_constant(rho, self.u) / 2 * ufl.inner(self.v, self.v)

    def potential_energy(self, rho: float | Expr) -> Expr:
        """Return -ρ f_ext · u [J/m³] at the start of the step."""
        return -_as_constant(rho, self.u) * ufl.inner(self.acceleration, self.u_old)


def _as_constant(value: float | Expr, u: fem.Function) -> Expr:
    """A plain number as a constant, so that its value is not compiled in."""
    return value if isinstance(value, Expr) else fem.Constant(u.function_space.mesh, float(value))
