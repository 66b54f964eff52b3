"""Loads: a potential energy, or the virtual work of forces that have none, on cells or facets."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.body import BodyLike
from forms.kinematics import deformation_gradient
from forms.tables import Table, check_table, look_up

Vector = Sequence[float] | Callable[[float], Sequence[float]] | Expr
"""Components; a function from time [s] to them; or a `fem.Constant` of the user's own."""

Scalar = float | Callable[[float], float] | Expr
"""A number; a function from time [s] to it; or a `fem.Constant` of the user's own."""


class Load(ABC):
    """A load on a body.

    A new one is a subclass with `energy` or `work`, and an entry in the registry:
    `LOADS["mine"] = Mine`. What it takes from `constant` may be changed at any time, as an
    attribute of the load; forms see it after the next `set_time`, and nothing is compiled anew.
    """

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form | None:
        """Return the potential energy [J], or None if the load has none.

        Args:
            body: The body.
            u: Displacement [m] at which it is taken, shape (d,).
            rho: Density [kg/m³], None if the model has none.
        """
        return None

    def work(self, body: BodyLike, u: Expr, v: Expr) -> ufl.Form | None:
        """Return the work [J] that forces without a potential do on v, or None if there are none.

        Args:
            body: The body.
            u: Displacement [m] at which the forces are taken, shape (d,).
            v: Virtual displacement [m], shape (d,).
        """
        return None

    def set_time(self, t: float) -> None:
        """Put the present values of all attributes, at time t [s], into forms."""
        for (name, _), constant in self._constants.items():
            constant.value[...] = self.at(name, t)

    def at(self, name: str, t: float) -> Any:
        """The value of an attribute at time t [s]."""
        given = getattr(self, name)
        return given(t) if callable(given) else given

    def constant(self, msh: mesh.Mesh, name: str, shape: tuple[int, ...] = ()) -> Expr:
        """Return the attribute of that name as a constant on a mesh; an expression as it is.

        Raises:
            ValueError: It has not that shape.
        """
        given = getattr(self, name)
        if not isinstance(given, Expr):
            constants = self._constants
            if (name, msh) not in constants:
                constants[name, msh] = fem.Constant(msh, np.array(self.at(name, 0.0), dtype=float))
            given = constants[name, msh]
        if isinstance(given, fem.Constant) and not np.isfinite(given.value).all():
            raise ValueError(f"{type(self).__name__}: {name} is {given.value}; it must be finite")
        if given.ufl_shape != shape:
            right = f"{shape[0]} numbers, as the body has dimensions" if shape else "one number"
            raise ValueError(f"{type(self).__name__}: {name} must be {right}")
        return given

    @cached_property
    def _constants(self) -> dict[tuple[str, mesh.Mesh], fem.Constant]:
        return {}


@dataclass(eq=False)
class Timed(Load):
    """A load of a size that a table may make follow the time.

    Attributes:
        table: Rows of a time [s] and what the size is multiplied by then, linear in between, such
            as [[0, 0], [1, 1]]; by default 1 at all times.
        sized: Name of the attribute that it multiplies.
    """

    sized: ClassVar[str]
    table: Table | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Check the table.

        Raises:
            ValueError: It has other rows, or its times do not grow.
        """
        if self.table is None:
            return
        if isinstance(getattr(self, self.sized), Expr):
            raise ValueError(f"a table goes with numbers, and {self.sized} is an expression")
        check_table(self.table, "factor", 2)

    def at(self, name: str, t: float) -> Any:
        """The value of an attribute at time t [s]."""
        value = super().at(name, t)
        if self.table is None or name != self.sized:
            return value
        return look_up(self.table, t)[0] * np.array(value, dtype=float)


@dataclass(eq=False)
class Gravity(Timed):
    """The same acceleration everywhere: -ρ g · u.

    Attributes:
        g: Acceleration [m/s²].
    """

    g: Vector
    sized = "g"

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form:
        """Return -∫ ρ g · u dX.

        Raises:
            ValueError: There is no density.
        """
        g = self.constant(body.mesh, "g", u.ufl_shape)
        if rho is None:
            raise ValueError("Gravity needs a density; give the model one: rho = ... [kg/m³]")
        return -rho * ufl.inner(g, u) * ufl.dx


@dataclass(eq=False)
class BodyForce(Load):
    """A force that depends on place and time: -f(X, t) · u.

    Attributes:
        force: Function from the position at rest X [m] and the time t [s], both UFL expressions, to
            the force by volume at rest [N/m³], d components. Called once.
    """

    force: Callable[[Expr, Expr], Expr | Sequence[Expr | float]]
    time: float = field(default=0.0, init=False, repr=False)

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form:
        """Return -∫ f · u dX."""
        t = self.constant(body.mesh, "time")
        f: Any = self.force(ufl.SpatialCoordinate(body.mesh), t)
        return -ufl.inner(f if isinstance(f, Expr) else ufl.as_vector(f), u) * ufl.dx

    def set_time(self, t: float) -> None:
        """Move to time t [s]."""
        self.time = t
        super().set_time(t)


@dataclass(eq=False)
class Traction(Timed):
    """A dead force on facets, which keeps its direction and its size by area at rest: -t · u.

    Attributes:
        value: Force by area at rest [Pa].
        where: The facets, as the body takes it; by default the whole boundary.
    """

    value: Vector
    where: Any = None
    sized = "value"

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form:
        """Return -∫ t · u dA."""
        t = self.constant(body.mesh, "value", u.ufl_shape)
        return -ufl.inner(t, u) * body.ds(self.where)


@dataclass(eq=False)
class Pressure(Timed):
    """A pressure that follows the surface: the force -p n da, -p cof(F) N dA at rest.

    A closed surface has a potential, p times the volume within, here with the sign of N. Others
    have none, so that their tangent is not symmetric.

    Attributes:
        value: Pressure p [Pa], positive where it pushes on the body.
        where: The facets, as the body takes it; by default the whole boundary, which is closed.
        closed: Whether the facets are closed surfaces, such as that of a cavity.
    """

    value: Scalar
    where: Any = None
    closed: bool = False
    sized = "value"

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form | None:
        """Return p/d ∫ x · cof(F) N dA of a closed surface."""
        if not self._is_closed:
            return None
        x = ufl.SpatialCoordinate(body.mesh) + u
        return ufl.inner(self._push(body, u), x) / len(u) * body.ds(self.where)

    def work(self, body: BodyLike, u: Expr, v: Expr) -> ufl.Form | None:
        """Return -∫ p cof(F) N · v dA of a surface that is not closed."""
        if self._is_closed:
            return None
        return -ufl.inner(self._push(body, u), v) * body.ds(self.where)

    @property
    def _is_closed(self) -> bool:
        return self.closed or self.where is None

    def _push(self, body: BodyLike, u: Expr) -> Expr:
        """The force by area at rest on what lies outside, p cof(F) N."""
        normal = ufl.cofac(deformation_gradient(u)) * ufl.FacetNormal(body.mesh)
        return self.constant(body.mesh, "value") * normal


@dataclass(eq=False)
class PointForce(Timed):
    """A dead force on each of some vertices: -f · u.

    Attributes:
        force: Force [N], in 2D by thickness [N/m].
        where: The vertices, as the body takes them.
    """

    force: Vector
    where: Any
    sized = "force"

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form:
        """Return -Σ f · u."""
        return -ufl.inner(self.constant(body.mesh, "force", u.ufl_shape), u) * body.dP(self.where)


@dataclass(eq=False)
class HalfSpace(Load):
    """Frictionless contact with the half-space n · x < a: the penalty k/2 (a - n · x)² within.

    Where the body reaches into it by δ, it pushes back with k δ by area at rest.

    Attributes:
        plane: Normal n of its plane, to the side where the body is; of any length.
        offset: Distance a [m] of the plane from the origin along n.
        stiffness: Pressure by depth k [Pa/m]; E times 1 to 100 by the size of a cell, say.
        where: The facets that may touch, as the body takes it; by default the whole boundary.
    """

    plane: Sequence[float]
    stiffness: Scalar
    offset: Scalar = 0.0
    where: Any = None

    def energy(self, body: BodyLike, u: Expr, rho: Expr | None) -> ufl.Form:
        """Return k/2 ∫ max(a - n · x, 0)² dA.

        Raises:
            ValueError: The normal has another dimension than the body, or is 0.
        """
        n = np.array(self.plane, dtype=float)
        if n.shape != u.ufl_shape or not np.linalg.norm(n) > 0.0:
            raise ValueError(f"HalfSpace: plane must be a normal of {len(u)} numbers, not all 0")
        x = ufl.SpatialCoordinate(body.mesh) + u
        n /= np.linalg.norm(n)
        depth = self.constant(body.mesh, "offset") - ufl.inner(ufl.as_vector(n.tolist()), x)
        k = self.constant(body.mesh, "stiffness")
        return ufl.conditional(ufl.gt(depth, 0.0), k / 2 * depth**2, 0.0) * body.ds(self.where)


LOADS: dict[str, type[Load]] = {
    "gravity": Gravity,
    "body-force": BodyForce,
    "traction": Traction,
    "pressure": Pressure,
    "point-force": PointForce,
    "half-space": HalfSpace,
}
"""Loads by the name that a scene file uses. To add one: `LOADS["mine"] = Mine`."""
