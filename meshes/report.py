"""What there is to say of a mesh file: sizes, tags, quality, parts, and all that is wrong."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from meshes.checks import BEYOND, Problem, fatal_problems
from meshes.errors import MeshError
from meshes.groups import entity_name
from meshes.interfaces import doubtful
from meshes.parts import joined
from meshes.quality import measure_name, quality, sizes, volumes
from meshes.raw import RawMesh
from meshes.readers import load

_SHOWN = 5  # worst cells, and cells or vertices of a problem in text
_LISTED = 100  # in JSON


@dataclass(frozen=True)
class Spread:
    """Least, mean and largest of some values."""

    min: float
    mean: float
    max: float

    @classmethod
    def of(cls, values: npt.NDArray[np.float64]) -> Spread:
        """Of an array that is not empty."""
        return cls(float(values.min()), float(values.mean()), float(values.max()))


@dataclass(frozen=True)
class GroupReport:
    """Entities of one dimension that a name or number tags."""

    tag: str | int
    dimension: int
    entities: str
    count: int


@dataclass(frozen=True)
class PartReport:
    """Cells that hang together by their vertices."""

    cells: int
    vertices: int
    first_cell: int
    low: list[float]
    high: list[float]


@dataclass(frozen=True)
class ProblemReport:
    """Something wrong: with `unusable`, the mesh is refused by `read`."""

    name: str
    unusable: bool
    message: str
    count: int
    of: str
    numbers: list[int]  # the first of them, from 0 in file order


@dataclass(frozen=True)
class Report:
    """A mesh file in figures. Numbers of cells and vertices count from 0, in file order.

    Attributes:
        file: Its path.
        cell: Kind of the cells.
        dimension: Of the mesh.
        vertices: Their number.
        cells: Their number.
        low: Least coordinates [m].
        high: Largest coordinates [m].
        volume: Of all cells [m³], in 2D their area [m²].
        h: Longest edges of the cells [m].
        untagged: Number of cells without a tag.
        groups: Tagged entities.
        measure: What quality is measured by.
        quality: Of the cells, 1 being best.
        worst: Cells of the least quality with that, the worst first.
        parts: Connected parts, in the order of their first cells.
        problems: All that is wrong, what makes the mesh unusable first.
    """

    file: str
    cell: str
    dimension: int
    vertices: int
    cells: int
    low: list[float]
    high: list[float]
    volume: float
    h: Spread
    untagged: int
    groups: list[GroupReport]
    measure: str
    quality: Spread
    worst: list[tuple[int, float]]
    parts: list[PartReport]
    problems: list[ProblemReport]

    @property
    def usable(self) -> bool:
        """Whether `meshes.read` takes the file."""
        return not any(problem.unusable for problem in self.problems)

    def data(self) -> dict[str, Any]:
        """As JSON has it."""
        return {**asdict(self), "usable": self.usable}

    def lines(self) -> list[str]:
        """As people read it."""
        lines = [
            f"{self.file}: {self.cells} cells ({self.cell}), {self.vertices} vertices, "
            f"{self.dimension}D",
            f"  extent    {_spans(self.low, self.high)} m",
            f"  {'area      ' if self.dimension == 2 else 'volume    '}{self.volume:g} "
            f"{'m²' if self.dimension == 2 else 'm³'}",
            f"  h         {self.h.min:.3g} to {self.h.max:.3g} m, mean {self.h.mean:.3g} m "
            "(longest edge of a cell)",
            f"  quality   {self.quality.min:.3g} to {self.quality.max:.3g}, mean "
            f"{self.quality.mean:.3g} by {self.measure}",
            "  worst     " + ", ".join(f"cell {k} {value:.3g}" for k, value in self.worst),
        ]
        tagged = [
            f"{group.tag}: {_counted(group.count, group.entities)}"
            if isinstance(group.tag, int)
            else f'"{group.tag}": {_counted(group.count, group.entities)}'
            for group in self.groups
        ]
        lines += [f"  {'tags' if k == 0 else '':<10}{line}" for k, line in enumerate(tagged)]
        if not tagged:
            lines.append("  tags      none")
        elif 0 < self.untagged:
            lines.append(f"            0: {_counted(self.untagged, 'cells')} without a tag")
        for k, part in enumerate(self.parts[:_SHOWN] if len(self.parts) > 1 else (), 1):
            lines.append(
                f"  part {k:<5}{_counted(part.cells, 'cells')} from cell {part.first_cell} on; "
                f"{_spans(part.low, part.high)}"
            )
        if len(self.parts) > _SHOWN:
            lines.append(f"            and {len(self.parts) - _SHOWN} more parts")
        for problem in self.problems:
            shown = ", ".join(map(str, problem.numbers[:_SHOWN]))
            more = ", ..." if problem.count > _SHOWN else ""
            mark = "unusable" if problem.unusable else "warning"
            numbers = f" [{problem.of} {shown}{more}]" if problem.numbers else ""
            lines.append(f"  {mark:<10}{problem.name}: {problem.message}{numbers}")
        if not self.problems:
            lines.append("  nothing is wrong with it")
        return lines


def _spans(low: list[float], high: list[float]) -> str:
    ranges = zip("xyz", low, high, strict=False)
    return ", ".join(f"{axis} from {a:g} to {b:g}" for axis, a, b in ranges)


def _counted(count: int, nouns: str) -> str:
    one = {"vertices": "vertex"}.get(nouns, nouns.rstrip("s"))
    return f"{count} {nouns if count != 1 else one}"


def report(path: Path, scale: float = 1.0) -> Report:
    """Read a mesh file on this rank alone and look into it.

    Args:
        path: The file.
        scale: Metres in a unit of the file.

    Raises:
        MeshError: The file cannot be read as a mesh of one kind of straight cells.
    """
    raw = load(path, scale, checked=False)
    problems = list(fatal_problems(raw))
    if any(problem.name in BEYOND for problem in problems):
        raise MeshError(f"{path}: {problems[0].message}")
    problems += doubtful(raw)
    d = raw.points.shape[1]
    shapes = quality(raw)
    worst = np.argsort(shapes, kind="stable")[:_SHOWN]
    return Report(
        file=str(path),
        cell=raw.kind.name,
        dimension=d,
        vertices=len(raw.points),
        cells=len(raw.cells),
        low=raw.points.min(axis=0).tolist(),
        high=raw.points.max(axis=0).tolist(),
        volume=float(volumes(raw).sum()),
        h=Spread.of(sizes(raw)),
        untagged=_untagged(raw),
        groups=[
            GroupReport(key, dim, entity_name(dim, d), len(rows))
            for key, group in raw.groups.items()
            for dim, rows in sorted(group.entities.items())
        ],
        measure=measure_name(raw),
        quality=Spread.of(shapes),
        worst=[(int(k), float(shapes[k])) for k in worst],
        parts=_parts(raw),
        problems=[_told(problem) for problem in problems],
    )


def _told(problem: Problem) -> ProblemReport:
    return ProblemReport(
        problem.name,
        problem.fatal,
        problem.message,
        len(problem.numbers),
        problem.noun,
        problem.numbers[:_LISTED].tolist(),
    )


def _untagged(raw: RawMesh) -> int:
    tagged = np.zeros(len(raw.cells), dtype=np.bool_)
    for group in raw.groups.values():
        tagged[group.entities.get(raw.points.shape[1], np.empty(0, dtype=np.int64))] = True
    return int((~tagged).sum())


def _parts(raw: RawMesh) -> list[PartReport]:
    _, part = joined(raw.cells, len(raw.points))
    of_cells = part[raw.cells[:, 0]]
    names, first, counts = np.unique(of_cells, return_index=True, return_counts=True)
    parts = []
    for k in np.argsort(first):
        x = raw.points[part == names[k]]
        parts.append(
            PartReport(
                int(counts[k]),
                len(x),
                int(first[k]),
                x.min(axis=0).tolist(),
                x.max(axis=0).tolist(),
            )
        )
    return parts
