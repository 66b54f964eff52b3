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
    """

    def __init__(self, motion: Motion, body: BodyLike, V: fem.FunctionSpace) -> None:
        d = V.dofmap.bs
        self._motion = motion
        self._values: fem.Function = fem.Function(V)
        self._blocks = body.dofs(V, motion.where)
        self._X = V.tabulate_dof_coordinates()[self._blocks, :d]
        self.bcs: list[fem.DirichletBC] = []
        if motion.components is None:
            self.bcs.append(fem.dirichletbc(self._values, self._blocks))
        else:
            for i in sorted({axis_number(name, d) for name in motion.components}):
                dofs: Any = [d * self._blocks + i] * 2  # in V.sub(i), and in the values
                self.bcs.append(fem.dirichletbc(self._values, dofs, V.sub(i)))
        self.set_time(0.0)

    def set_time(self, t: float) -> None:
        """Move to time t [s]."""
        values = self._values.x.array.reshape(-1, self._X.shape[1])
        values[self._blocks] = self._motion.displacement(self._X, t)


@dataclass(frozen=True)
class Fixed(Motion):
    """Held where it is at rest; single components make rollers and planes of symmetry."""

    def displacement(self, X: Array, t: float) -> Array:
        """Return 0."""
        return np.zeros_like(X)


@dataclass(frozen=True)
class Translate(Motion):
    """Moved without turning.

    Attributes:
        rate: Velocity [m/s]; or a function from time [s] to the displacement [m].
    """

    rate: Sequence[float] | Callable[[float], Sequence[float]]

    def displacement(self, X: Array, t: float) -> Array:
        """Return the velocity times t."""
        moved = self.rate(t) if callable(self.rate) else t * np.array(self.rate, dtype=float)
        if np.shape(moved) != X.shape[1:]:
            raise ValueError(
                f"Translate: rate has {np.size(moved)} components; the body lives in {X.shape[1]}D"
            )
        return np.tile(moved, (len(X), 1))


@dataclass(frozen=True)
class Stretch(Motion):
    """Stretched along an axis: moved along it in proportion to the distance from a centre.

    Attributes:
        rate: Strain rate [1/s]; or a function from time [s] to the strain [-].
        axis: "x", "y" or "z".
        centre: Coordinate [m] on that axis of what stays.
    """

    rate: float | Callable[[float], float]
    axis: str = "x"
    centre: float = 0.0

    def displacement(self, X: Array, t: float) -> Array:
        """Return the strain times the distance."""
        i = axis_number(self.axis, X.shape[1])
        moved = np.zeros_like(X)
        moved[:, i] = _amount(self.rate, t) * (X[:, i] - self.centre)
        return moved


@dataclass(frozen=True)
class Twist(Motion):
    """Turned as a rigid body about an axis, any number of turns.

    Attributes:
        rate: Angular velocity [rad/s], anticlockwise seen from the tip of the axis; or a function
            from time [s] to the angle [rad].
        axis: "x", "y" or "z"; in 2D "z".
        centre: A point [m] on the axis, d coordinates; by default the origin.
    """

    rate: float | Callable[[float], float]
    axis: str = "z"
    centre: Sequence[float] | None = None

    def displacement(self, X: Array, t: float) -> Array:
        """Return (Q - I) (X - centre)."""
        d = X.shape[1]
        i, j = ((axis_number(self.axis, 3) + k) % 3 for k in (1, 2))
        if max(i, j) >= d:
            raise ValueError(f'Twist: axis is "{self.axis}"; in 2D it must be "z"')
        angle = _amount(self.rate, t)
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


def _amount(rate: float | Callable[[float], float], t: float) -> float:
    return rate(t) if callable(rate) else rate * t


MOTIONS: dict[str, type[Motion]] = {
    "fixed": Fixed,
    "translate": Translate,
    "stretch": Stretch,
    "twist": Twist,
}
"""Motions by the name that a scene file uses. To add one: `MOTIONS["mine"] = Mine`."""
