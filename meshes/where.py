"""Clauses that name a set of vertices."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass

AXES = ("x", "y", "z")
_KEYS = (*AXES, "vertices", "tag")

Extent = str | tuple[float, float]


@dataclass(frozen=True)
class Where:
    """A part of a body: the vertices, or the tagged entities, that meet every condition given.

    Attributes:
        extents: Condition on each coordinate named: ``"min"``, ``"max"`` or a closed interval
            in metres.
        vertices: Vertex numbers, from 0, in the order of the mesh file.
        tag: Name or number of a group of the mesh file. It stands for the entities that carry it
            and what bounds them: facets if there are any, else edges, else vertices. A name may
            also be that of a region, of which the cells are meant if it tags nothing else. With
            further conditions, it is those entities all of whose vertices meet them.
    """

    extents: tuple[tuple[str, Extent], ...] = ()
    vertices: tuple[int, ...] | None = None
    tag: str | int | None = None

    @classmethod
    def parse(cls, clause: object) -> Where:
        """Read a clause as it stands in a scene file.

        Args:
            clause: A table such as ``{"x": "max"}``, ``{"x": [0.9, 1.0], "y": "min"}``,
                ``{"vertices": [0, 5]}`` or ``{"tag": "left"}``.

        Raises:
            ValueError: The clause says something else; the message tells what is allowed.
        """
        if not isinstance(clause, Mapping) or not clause:
            raise ValueError('must be a table such as { x = "max" } or { tag = "left" }')
        extents: list[tuple[str, Extent]] = []
        vertices: tuple[int, ...] | None = None
        tag: str | int | None = None
        for key, value in clause.items():
            if key in AXES:
                extents.append((key, _extent(key, value)))
            elif key == "vertices":
                vertices = _vertices(value)
            elif key == "tag":
                if isinstance(value, bool) or not isinstance(value, str | int):
                    raise ValueError("tag must be a name or a whole number")
                tag = value
            else:
                close = difflib.get_close_matches(str(key), _KEYS, n=1)
                hint = f" (did you mean {close[0]}?)" if close else ""
                told = key if str(key).isprintable() else repr(key)
                raise ValueError(f"unknown key {told}{hint}; known: {', '.join(_KEYS)}")
        return cls(tuple(extents), vertices, tag)

    def __str__(self) -> str:
        """The clause as a scene file spells it."""
        parts = [
            f'{axis} = "{e}"' if isinstance(e, str) else f"{axis} = [{e[0]:g}, {e[1]:g}]"
            for axis, e in self.extents
        ]
        if self.vertices is not None:
            shown = [str(v) for v in self.vertices[:4]]
            parts.append(f"vertices = [{', '.join(shown + ['...'] * (len(self.vertices) > 4))}]")
        if self.tag is not None:
            parts.append(
                f'tag = "{self.tag}"' if isinstance(self.tag, str) else f"tag = {self.tag}"
            )
        return "{ " + ", ".join(parts) + " }"


def _extent(axis: str, value: object) -> Extent:
    if isinstance(value, str) and value in ("min", "max"):
        return value
    if isinstance(value, list | tuple) and len(value) == 2:
        low, high = value
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
            if math.isfinite(low) and math.isfinite(high) and low <= high:
                return (float(low), float(high))
            raise ValueError(
                f"{axis} = [{low}, {high}] is empty: the first must not exceed the second"
            )
    raise ValueError(f'{axis} must be "min", "max" or an interval [from, to]')


def _vertices(value: object) -> tuple[int, ...]:
    if isinstance(value, list | tuple) and value:
        if all(isinstance(v, int) and not isinstance(v, bool) and v >= 0 for v in value):
            return tuple(value)
    raise ValueError("vertices must be a list of vertex numbers, counted from 0, such as [0, 5]")
