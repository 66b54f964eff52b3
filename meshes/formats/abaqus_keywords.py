"""The lines of an .inp file: keywords with their options and data, and types of elements."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.formats.listing import cell_kind
from meshes.formats.numbers import parsed, whole
from meshes.groups import Integers

# Families of elements by what their names begin with; the number of nodes follows. Axisymmetric
# elements (CAX) are left out on purpose: they are no plane ones.
_SOLID = {4: "tetra", 8: "hexahedron", 6: "wedge", 5: "pyramid", 10: "tetra10", 20: "hexahedron20"}
_FLAT = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9", 65: "triangle6"}
_LINE = {2: "line", 3: "line3"}
_BEAM = {1: "line", 2: "line3", 3: "line"}
_FAMILIES = {
    **dict.fromkeys(("C3D", "DC3D", "AC3D"), _SOLID | {15: "wedge15"}),
    **dict.fromkeys(("CPS", "CPE", "CPEG", "S", "STRI", "M3D", "R3D", "SFM3D", "DS"), _FLAT),
    **dict.fromkeys(("T2D", "T3D", "R2D"), _LINE),
    **dict.fromkeys(("B2", "B3"), _BEAM),
}
_VERTICES = {"line": 2, "triangle": 3, "quad": 4, "tetra": 4, "hexahedron": 8}
_LONGEST = 10**8  # numbers in a range
_NESTED = 10  # files that include one another, at most


@dataclass
class Keyword:
    """A keyword line and the lines of data below it.

    Attributes:
        name: In capitals, without the star.
        options: By their names in capitals.
        data: The lines, without comments and empty ones.
    """

    name: str
    options: dict[str, str]
    data: list[str]

    def option(self, name: str) -> str:
        """An option that must be there."""
        if name not in self.options:
            raise MeshError(f"has *{self.name} without {name}=")
        return self.options[name]

    def members(self) -> tuple[Integers, list[str]]:
        """The numbers in a set, and the names of the sets in it."""
        if "GENERATE" in self.options:
            given = [[w.strip() for w in line.split(",") if w.strip()] for line in self.data]
            ranges = [[int(w) if w.isdecimal() else -1 for w in words] for words in given]
            if any(len(r) not in (2, 3) or min(r) < 0 or (*r, 1)[2] < 1 for r in ranges):
                raise MeshError(f"has *{self.name}, GENERATE with other than first, last, step")
            if any(r[1] - r[0] > _LONGEST * (*r, 1)[2] for r in ranges):
                raise MeshError(f"has *{self.name}, GENERATE of more than {_LONGEST:.0e} numbers")
            parts = [np.arange(r[0], r[1] + 1, (*r, 1)[2]) for r in ranges]
            return np.concatenate([np.empty(0, dtype=np.int64), *parts]), []
        words = [w for line in self.data for word in line.split(",") if (w := word.strip())]
        numbers = [int(word) for word in words if word.isdecimal()]
        names = [word.strip('"') for word in words if not word.isdecimal()]
        return np.array(numbers, dtype=np.int64), names


def keywords(path: Path, nested: int = 0) -> Iterator[Keyword]:
    """The keywords of a file, and of those that it includes."""
    if nested > _NESTED:
        raise MeshError(f"includes files more than {_NESTED} deep")
    current: Keyword | None = None
    lines = iter(path.read_text(encoding="latin-1").splitlines())
    for line in lines:
        if line.startswith("**") or not line.strip():
            continue
        if line.lstrip().startswith("*"):
            if current is not None:
                yield from _whole(current, path, nested)
            while line.rstrip().endswith(",") and (more := next(lines, None)) is not None:
                line = line.rstrip() + more
            current = _header(line)
        elif current is not None:
            current.data.append(line)
    if current is not None:
        yield from _whole(current, path, nested)


def _header(line: str) -> Keyword:
    name, *words = line.strip().lstrip("*").split(",")
    options = {}
    for word in filter(str.strip, words):
        key, _, value = word.partition("=")
        options[key.strip().upper()] = value.strip().strip('"')
    return Keyword(" ".join(name.upper().split()), options, [])


def _whole(keyword: Keyword, path: Path, nested: int) -> Iterator[Keyword]:
    """A keyword with the data, or the keywords, of the file that it names."""
    if "INPUT" not in keyword.options or keyword.name not in ("INCLUDE", "NODE", "ELEMENT"):
        yield keyword
        return
    other = path.parent / keyword.options["INPUT"]
    if not other.is_file():
        raise MeshError(f"includes {keyword.options['INPUT']}, which is not there")
    if keyword.name == "INCLUDE":
        yield from keywords(other, nested + 1)
        return
    lines = other.read_text(encoding="latin-1").splitlines()
    data = [line for line in lines if line.strip() and not line.startswith("*")]
    yield Keyword(keyword.name, keyword.options, [*keyword.data, *data])


def element_kind(name: str) -> tuple[str, int]:
    """The name that meshio has for a type of element, and the number of its nodes.

    Raises:
        MeshError: A type that cannot be used, such as a second-order one.
    """
    match = re.match(r"(B[23]|[A-Z]+?(?:[23]D)?)(\d+)", name.upper())
    kind = _FAMILIES.get(match[1], {}).get(int(match[2])) if match else None
    if kind is None:
        raise MeshError(
            f"has elements of type {name}; C3D4, C3D8, CPS3, CPS4, CPE3, CPE4 and surfaces and "
            "lines on these are wanted"
        )
    if kind not in _VERTICES:
        cell_kind({kind})
    return kind, _VERTICES[kind]


def integers(keyword: Keyword) -> Integers:
    """All numbers of the data, which are whole."""
    return whole(_numbers(keyword), f"under *{keyword.name}")


def rows(keyword: Keyword) -> npt.NDArray[np.float64]:
    """A number and up to three coordinates a line, those left out being 0."""
    lines = [line.rstrip().rstrip(",") for line in keyword.data]
    width = {line.count(",") for line in lines}
    if len(width) == 1 and not any(",," in line.replace(" ", "") for line in lines):
        count = 1 + width.pop()
        numbers = _numbers(keyword)
        if len(numbers) == count * len(lines) and 1 < count:
            return numbers.reshape(len(lines), count)[:, :4]
    table = np.zeros((len(lines), 4))
    for row, line in zip(table, lines, strict=True):
        words = line.split(",")[:4]
        try:
            row[: len(words)] = [float(word) if word.strip() else 0.0 for word in words]
        except ValueError as e:
            raise MeshError(f"has something else than numbers under *{keyword.name}") from e
    return table


def _numbers(keyword: Keyword) -> npt.NDArray[np.float64]:
    return parsed(" ".join(keyword.data).replace(",", " "), f"under *{keyword.name}")
