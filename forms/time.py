"""Time schemes: a step as a potential of the displacement at its end.

A step from uᵗ, ẋᵗ makes an energy stationary,

    kinetic(ρ) + (Ψ and loads at the point u_θ),   u_θ = θ u + (1 - θ) uᵗ,

the kinetic term of the seed's eqs. (1), (7) and (8) with θ = 1 for backward Euler. A mixed form
stands at that point as a whole: its stretch and its multiplier are those of u_θ.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from forms.constants import as_constant
from forms.spaces import function

Array = npt.NDArray[np.floating[Any]]


class Scheme(ABC):
    """A time scheme. Make it once; `advance` moves to the next step by changing values only.

    A new one is a subclass with `kinetic` and `velocity`, with `theta` or `point` where Ψ is not
    taken at the end of the step, and with an entry in the registry: `SCHEMES["mine"] = Mine`. Its
    keyword-only parameters are keys of a scene.

    Attributes:
        u: The displacement [m] being solved for, at the end of the step.
        u_old: Displacement at the start of the step [m].
        v: Velocity at the start of the step [m/s].
        h: Time step [s], a constant whose `value` may be changed between steps.
        t: Time at the start of the step [s].
        theta: Where in the step Ψ and loads are taken, from 0 at its start to 1 at its end.
        inertial: Whether there is inertia.
        order: Of u and v in h.
        error_constant: C of the error of a step, C h^(order + 1) d^(order + 1)u/dt^(order + 1).
    """

    theta: float = 1.0
    inertial: ClassVar[bool] = True
    order: int = 1
    error_constant: float = 1 / 2

    def __init__(self, u: fem.Function, h: float | fem.Constant) -> None:
        """Start from the current displacement, at rest.

        Args:
            u: Displacement [m], shape (d,).
            h: Time step [s]; a constant is shared, for a strain energy in which it appears.

        Raises:
            ValueError: h is not positive.
        """
        value = float(h.value) if isinstance(h, fem.Constant) else h
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"h is {value}; the time step [s] must be positive and finite")
        V = u.function_space
        self.u = u
        self.u_old = function(V, name="u_old")
        self.u_old.x.array[:] = u.x.array
        self.v = function(V, name="v")
        self.h = h if isinstance(h, fem.Constant) else fem.Constant(V.mesh, float(h))
        self.t = 0.0
        self._h_before = 0.0  # of the step before, none as yet
        self._a_before = np.zeros_like(u.x.array)

    @abstractmethod
    def kinetic(self, rho: float | Expr) -> Expr:
        """Return the potential of inertia [J/m³] for a density rho [kg/m³].

        Its derivative by u is that of `point` times ρ ẍ.
        """

    @abstractmethod
    def velocity(self) -> Array:
        """Return the velocity [m/s] at the end of the step, a value a degree of freedom."""

    def point(self, u: Expr) -> Expr:
        """Return where Ψ and loads are taken, for a displacement u at the end of the step."""
        return u if self.theta == 1.0 else self.theta * u + (1.0 - self.theta) * self.u_old

    def point_velocity(self, u: Expr) -> Expr:
        """Return the velocity [m/s] there, for a displacement u at the end of the step."""
        return (u - self.u_old) / self.h

    @property
    def point_rate(self) -> Expr:
        """The derivative of `point_velocity` by u [1/s], a number."""
        return 1 / self.h

    @property
    def end(self) -> float:
        """Time at the end of the step [s]."""
        return self.t + float(self.h.value)

    @property
    def point_time(self) -> float:
        """Time of the point [s]."""
        return self.t + self.theta * float(self.h.value)

    def local_error(self) -> float:
        """Estimate the error of this step's displacement [m], largest component. Collective.

        By differences of velocities; before the first step the acceleration counts as zero.
        """
        if not self.inertial:
            return 0.0
        h, a = float(self.h.value), self._acceleration()
        error = self.error_constant * h**2 * a
        if self.order > 1:
            before = self._h_before or h
            error = 2 * h / (h + before) * self.error_constant * h**2 * (a - self._a_before)
        comm = self.u.function_space.mesh.comm
        return float(comm.allreduce(np.abs(error).max(initial=0.0), MPI.MAX))

    def advance(self) -> None:
        """Take the current displacement as the end of the step."""
        if self.inertial:
            self._h_before = float(self.h.value)
            self._a_before[:] = self._acceleration()
        self.v.x.array[:] = self.velocity()
        self.u_old.x.array[:] = self.u.x.array
        self.t = self.end

    def _acceleration(self) -> Array:
        """The mean acceleration over the step [m/s²]."""
        return (self.velocity() - self.v.x.array) / float(self.h.value)

    def kinetic_energy(self, rho: float | Expr) -> Expr:
        """Return ρ/2 |ẋ|² [J/m³] at the start of the step."""
        return as_constant(rho, self.u.function_space.mesh) / 2 * ufl.inner(self.v, self.v)

    def _inertia(self, predictor: Expr, rho: float | Expr, tau: Expr) -> Expr:
        """ρ/(2τ²) |u - predictor|²."""
        rho = as_constant(rho, self.u.function_space.mesh)
        return rho / (2 * tau**2) * ufl.inner(self.u - predictor, self.u - predictor)


class BackwardEuler(Scheme):
    """Backward Euler: ρ/(2h²) |x - x̃|², x̃ = xᵗ + h ẋᵗ + h² f_ext. First order, damps.

    The kinetic term of the seed's eqs. (1), (7) and (8).

    Attributes:
        acceleration: External acceleration f_ext [m/s²], a constant of shape (d,).
    """

    def __init__(
        self,
        u: fem.Function,
        h: float | fem.Constant,
        acceleration: Sequence[float] | None = None,
    ) -> None:
        """Start from the current displacement, at rest.

        Args:
            u: Displacement [m], shape (d,).
            h: Time step [s].
            acceleration: External acceleration f_ext [m/s²], d numbers; none by default. In a
                `Model` take `Gravity`, of which there is a potential energy.

        Raises:
            ValueError: h is not positive, or the acceleration has not d components.
        """
        super().__init__(u, h)
        f_ext = np.zeros(len(u)) if acceleration is None else np.array(acceleration, dtype=float)
        if f_ext.shape != (len(u),):
            raise ValueError(
                f"the acceleration has {f_ext.size} components; the body lives in {len(u)}D"
            )
        self.acceleration = fem.Constant(u.function_space.mesh, f_ext)

    def kinetic(self, rho: float | Expr) -> Expr:
        """Return ρ/(2h²) |x - x̃|² [J/m³] for a density rho [kg/m³]."""
        predictor = self.u_old + self.h * self.v + self.h**2 * self.acceleration
        return self._inertia(predictor, rho, self.h)

    def velocity(self) -> Array:
        """Return (u - uᵗ) / h."""
        return (self.u.x.array - self.u_old.x.array) / float(self.h.value)

    def potential_energy(self, rho: float | Expr) -> Expr:
        """Return -ρ f_ext · u [J/m³] at the start of the step."""
        rho = as_constant(rho, self.u.function_space.mesh)
        return -rho * ufl.inner(self.acceleration, self.u_old)


class ImplicitMidpoint(Scheme):
    """Implicit midpoint rule: Ψ at (u + uᵗ)/2. Second order, keeps momenta and quadratic energies.

    ρ (ẋ - ẋᵗ)/h + ∂Ψ = 0 and (u - uᵗ)/h = (ẋ + ẋᵗ)/2.
    """

    theta = 0.5
    order = 2
    error_constant = 1 / 12

    def kinetic(self, rho: float | Expr) -> Expr:
        """Return ρ/(2h²) |u - uᵗ - h ẋᵗ|² [J/m³]: half of ρ ẍ, as the point moves by half of u."""
        return self._inertia(self.u_old + self.h * self.v, rho, self.h)

    def velocity(self) -> Array:
        """Return 2 (u - uᵗ)/h - ẋᵗ."""
        return 2 * (self.u.x.array - self.u_old.x.array) / float(self.h.value) - self.v.x.array


class BDF2(Scheme):
    """Backward differences over two steps of any lengths. Second order, damps.

    With ω the ratio of this step to the one before, τ = h (1 + ω)/(1 + 2ω) and

        û = ((1 + ω)² uᵗ - ω² uᵗ⁻¹) / (1 + 2ω),   ẋ = (u - û)/τ,   ẍ = (ẋ - v̂)/τ,

    v̂ likewise. Before the first step lies one of infinite length, ω = 0: it is backward Euler's,
    which keeps the order.

    E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed.,
    Springer, 1993, section III.5.
    """

    order = 2
    error_constant = 2 / 9

    def __init__(self, u: fem.Function, h: float | fem.Constant) -> None:
        """Start from the current displacement, at rest, see `Scheme`."""
        super().__init__(u, h)
        V = u.function_space
        self._u_older, self._v_older = function(V), function(V)
        self._rate_before = fem.Constant(V.mesh, 0.0)  # one over the length of the step before

    def kinetic(self, rho: float | Expr) -> Expr:
        """Return ρ/(2τ²) |u - û - τ v̂|² [J/m³]."""
        omega = self.h * self._rate_before
        tau = _tau(self.h, omega)
        predictor = _past(self.u_old, self._u_older, omega)
        predictor += tau * _past(self.v, self._v_older, omega)
        return self._inertia(predictor, rho, tau)

    def point_velocity(self, u: Expr) -> Expr:
        """Return (u - û)/τ."""
        past = _past(self.u_old, self._u_older, self.h * self._rate_before)
        return (u - past) * self.point_rate

    @property
    def point_rate(self) -> Expr:
        """1/τ."""
        return 1 / _tau(self.h, self.h * self._rate_before)

    def velocity(self) -> Array:
        """Return (u - û)/τ."""
        h = float(self.h.value)
        omega = h * float(self._rate_before.value)
        past = _past(self.u_old.x.array, self._u_older.x.array, omega)
        return (self.u.x.array - past) / _tau(h, omega)

    def advance(self) -> None:
        """Take the current displacement as the end of the step."""
        older = self.u_old.x.array.copy(), self.v.x.array.copy()
        super().advance()
        self._u_older.x.array[:], self._v_older.x.array[:] = older
        self._rate_before.value = 1.0 / self.h.value


class Static(Scheme):
    """Equilibrium at each t, without inertia: t only says how far loads and motions have come."""

    inertial = False

    def __init__(self, u: fem.Function, h: float | fem.Constant = 1.0) -> None:
        """Start from the current displacement, see `Scheme`."""
        super().__init__(u, h)

    def kinetic(self, rho: float | Expr | None = None) -> Expr:
        """Return 0."""
        return ufl.as_ufl(0)

    def velocity(self) -> Array:
        """Return 0."""
        return np.zeros_like(self.u.x.array)


def _tau(h: Any, omega: Any) -> Any:
    """The length τ, of numbers or of expressions."""
    return h * (1 + omega) / (1 + 2 * omega)


def _past(old: Any, older: Any, omega: Any) -> Any:
    """The mean û of two states, of arrays or of expressions."""
    return ((1 + omega) ** 2 * old - omega**2 * older) / (1 + 2 * omega)
