"""Motions: prescribed displacements of parts of a body, as Dirichlet conditions that move."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from forms.body import BodyLike
from forms.spaces import function
from forms.tables import Table, check_table, look_up

Array = npt.NDArray[np.float64]

AXES = "xyz"


@dataclass(frozen=True)
class Motion(ABC):
    """What a part of a body does.

    A new one is a subclass with `displacement`, and an entry in the registry:
    `MOTIONS["mine"] = Mine`.

    Attributes:
        where: The part, as the body takes it.
        components: Axes along which it is held, such as "x" or "xz"; by default all. Along the
            others it is free.
    """

    where: Any
    components: str | Sequence[str] | None = field(default=None, kw_only=True)

    @abstractmethod
    def displacement(self, X: Array, t: float) -> Array:
        """Return the prescribed displacement [m], shape (n, d).

        Args:
            X: Positions at rest [m], shape (n, d).
            t: Time [s].
        """

    def hold(self, body: BodyLike, V: fem.FunctionSpace) -> Held:
        """Return the Dirichlet conditions in a space, at time 0. Collective.

        Args:
            body: The body.
            V: Lagrange space of its displacement, shape (d,).

        Raises:
            ValueError: `components` names an axis that the body has not; and what the body raises
                for a part that it does not have.
        """
        return Held(self, body, V)


class Held:
    """A motion of one displacement.

    Attributes:
        bcs: Dirichlet conditions, whose values `set_time` changes in place.
        components: Numbers of the axes along which the part is held.
        blocks: Its nodes, as blocks of d degrees of freedom, ghosts included.
    """

    def __init__(self, motion: Motion, body: BodyLike, V: fem.FunctionSpace) -> None:
        d = V.dofmap.bs
        self._motion = motion
        self._values = function(V)
        self.blocks = body.dofs(V, motion.where)
        self._X = V.tabulate_dof_coordinates()[self.blocks, :d]
        self.bcs: list[fem.DirichletBC] = []
        self.components = list(range(d))
        if motion.components is None:
            self.bcs.append(fem.dirichletbc(self._values, self.blocks))
        else:
            self.components = sorted({axis_number(name, d) for name in motion.components})
            for i in self.components:
                dofs: Any = [d * self.blocks + i] * 2  # in V.sub(i), and in the values
                self.bcs.append(fem.dirichletbc(self._values, dofs, V.sub(i)))
        self.set_time(0.0)

    def set_time(self, t: float) -> None:
        """Move to time t [s]."""
        values = self._values.x.array.reshape(-1, self._X.shape[1])
        values[self.blocks] = self._motion.displacement(self._X, t)


@dataclass(frozen=True)
class Fixed(Motion):
    """Held where it is at rest; single components make rollers and planes of symmetry."""

    def displacement(self, X: Array, t: float) -> Array:
        """Return 0."""
        return np.zeros_like(X)


@dataclass(frozen=True)
class Prescribed(Motion):
    """Moved as a function says.

    Attributes:
        function: From positions at rest [m], shape (n, d), and time [s] to displacements [m] of the
            same shape.
    """

    function: Callable[[Array, float], Array]

    def displacement(self, X: Array, t: float) -> Array:
        """Return what the function does."""
        return np.asarray(self.function(X, t), dtype=float)


@dataclass(frozen=True)
class Timed(Motion):
    """A motion that has come so far at a time: by a rate, a function or a table.

    Attributes:
        start: Time [s] from which the rate counts.
        end: Time [s] at which the motion comes to a halt; by default never.
        table: In the place of the rate, rows of a time [s] and how far the motion has come then,
            which goes straight from row to row, and stays before the first and after the last.
    """

    rate: Any = None
    start: float = field(default=0.0, kw_only=True)
    end: float | None = field(default=None, kw_only=True)
    table: Table | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Check what goes together.

        Raises:
            ValueError: Not one of rate and table; a table of rows that are no times with values, or
                out of order; an end before the start.
        """
        if (self.rate is None) == (self.table is None):
            raise ValueError("needs either a rate or a table")
        if self.end is not None and self.end < self.start:
            raise ValueError(f"end is {self.end:g} s, before start, {self.start:g} s")
        if self.table is not None:
            check_table(self.table, "value")

    def come(self, t: float) -> Array:
        """How far the motion has come at time t [s]: a vector, or one number."""
        if self.table is not None:
            return look_up(self.table, t)
        if callable(self.rate):
            return np.atleast_1d(np.asarray(self.rate(t), dtype=float))
        elapsed = max((t if self.end is None else min(t, self.end)) - self.start, 0.0)
        return elapsed * np.atleast_1d(np.asarray(self.rate, dtype=float))

    def amount(self, t: float) -> float:
        """How far, where that is one number.

        Raises:
            ValueError: It is not.
        """
        come = self.come(t)
        if come.size != 1:
            raise ValueError(f"{type(self).__name__} needs one number at a time, not {come.size}")
        return float(come[0])


@dataclass(frozen=True)
class Translate(Timed):
    """Moved without turning.

    Attributes:
        rate: Velocity [m/s]; or a function from time [s] to the displacement [m].
    """

    rate: Sequence[float] | Callable[[float], Sequence[float]] | None = None

    def displacement(self, X: Array, t: float) -> Array:
        """Return the velocity times the time."""
        moved = self.come(t)
        if moved.shape != X.shape[1:]:
            given = "rate" if self.table is None else "table"
            raise ValueError(
                f"Translate: {given} has {moved.size} components; the body lives in {X.shape[1]}D"
            )
        return np.tile(moved, (len(X), 1))


@dataclass(frozen=True)
class Stretch(Timed):
    """Stretched along an axis: moved along it in proportion to the distance from a centre.

    Attributes:
        rate: Strain rate [1/s]; or a function from time [s] to the strain [-].
        axis: "x", "y" or "z".
        centre: Coordinate [m] on that axis of what stays.
    """

    rate: float | Callable[[float], float] | None = None
    axis: str = "x"
    centre: float = 0.0

    def displacement(self, X: Array, t: float) -> Array:
        """Return the strain times the distance."""
        i = axis_number(self.axis, X.shape[1])
        moved = np.zeros_like(X)
        moved[:, i] = self.amount(t) * (X[:, i] - self.centre)
        return moved


@dataclass(frozen=True)
class Bend(Timed):
    """Bent as a part of a bar that becomes a circular arc, cross-sections staying plane.

    Attributes:
        rate: Curvature by time [1/(m s)]; or a function from time [s] to the curvature [1/m].
        axis: Of the bar: "x", "y" or "z".
        towards: The axis to which it bends.
        centre: A point [m] of the line that keeps its length, where the bar stays as it is, d
            coordinates; by default the origin.
    """

    rate: float | Callable[[float], float] | None = None
    axis: str = "x"
    towards: str = "y"
    centre: Sequence[float] | None = None

    def displacement(self, X: Array, t: float) -> Array:
        """Return the way to (sin(κs)/κ - η sin κs, (1 - cos κs)/κ + η cos κs)."""
        d = X.shape[1]
        i, j = axis_number(self.axis, d), axis_number(self.towards, d)
        if i == j:
            raise ValueError(f'Bend: axis and towards are both "{self.axis}"')
        centre = np.zeros(d) if self.centre is None else np.array(self.centre, dtype=float)
        s, eta = X[:, i] - centre[i], X[:, j] - centre[j]
        angle = self.amount(t) * s
        half = s * np.sinc(angle / (2 * np.pi))  # chord of the arc
        moved = np.zeros_like(X)
        moved[:, i] = half * np.cos(angle / 2) - eta * np.sin(angle) - s
        moved[:, j] = half * np.sin(angle / 2) + eta * np.cos(angle) - eta
        return moved


@dataclass(frozen=True)
class Twist(Timed):
    """Turned as a rigid body about an axis, any number of turns.

    Attributes:
        rate: Angular velocity [rad/s], anticlockwise seen from the tip of the axis; or a function
            from time [s] to the angle [rad].
        axis: "x", "y" or "z"; in 2D "z".
        centre: A point [m] on the axis, d coordinates; by default the origin.
    """

    rate: float | Callable[[float], float] | None = None
    axis: str = "z"
    centre: Sequence[float] | None = None

    def displacement(self, X: Array, t: float) -> Array:
        """Return (Q - I) (X - centre)."""
        d = X.shape[1]
        i, j = ((axis_number(self.axis, 3) + k) % 3 for k in (1, 2))
        if max(i, j) >= d:
            raise ValueError(f'Twist: axis is "{self.axis}"; in 2D it must be "z"')
        angle = self.amount(t)
        Q = np.eye(d)
        Q[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        centre = np.zeros(d) if self.centre is None else np.array(self.centre, dtype=float)
        return (X - centre) @ (Q - np.eye(d)).T


def axis_number(name: str, d: int) -> int:
    """The number of an axis.

    Raises:
        ValueError: There is no such axis in d dimensions.
    """
    if name not in tuple(AXES[:d]):
        raise ValueError(f'axis is "{name}"; in {d}D it must be one of {", ".join(AXES[:d])}')
    return AXES.index(name)


MOTIONS: dict[str, type[Motion]] = {
    "fixed": Fixed,
    "translate": Translate,
    "stretch": Stretch,
    "twist": Twist,
    "bend": Bend,
    "prescribed": Prescribed,
}
"""Motions by the name that a scene file uses. To add one: `MOTIONS["mine"] = Mine`."""
