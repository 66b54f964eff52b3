"""VTK's legacy files, .vtk: unstructured, structured and image data, as text or binary.

Versions up to 4.2 list the cells as counts and vertices, later ones as offsets and connectivity.
Pixels and voxels become quadrilaterals and hexahedra. The tag of a cell is its first data of whole
numbers, those of a telling name before others.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.formats.listing import Block, Listing, region_tags
from meshes.groups import Integers

_TYPES = {
    **{"unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2"},
    **{"unsigned_int": "u4", "int": "i4", "unsigned_long": "u8", "long": "i8"},
    **{"vtktypeint64": "i8", "vtktypeuint64": "u8", "vtktypeint32": "i4", "vtktypeuint32": "u4"},
    **{"vtkidtype": "i4", "float": "f4", "double": "f8", "bit": "u1"},
}
_DATASETS = ("UNSTRUCTURED_GRID", "STRUCTURED_GRID", "RECTILINEAR_GRID", "STRUCTURED_POINTS")
_MOST_POINTS = 2e8  # of a grid, whose points are not listed
# Numbers of each vertex or cell.
_WIDTHS = {
    **{"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6},
    **{"GLOBAL_IDS": 1, "PEDIGREE_IDS": 1, "EDGE_FLAGS": 1},
}
# Number of a cell type: meshio's name, and the place of each vertex of it among the type's.
_CELLS: dict[int, tuple[str, list[int] | None]] = {
    1: ("vertex", None),
    3: ("line", None),
    5: ("triangle", None),
    8: ("quad", [0, 1, 3, 2]),
    9: ("quad", None),
    10: ("tetra", None),
    11: ("hexahedron", [0, 1, 3, 2, 4, 5, 7, 6]),
    12: ("hexahedron", None),
}
_VERTICES = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4, "tetra": 4, "hexahedron": 8}
# Cells of dimension 0 and 1 of any number of vertices, which tag nothing.
_PASSED_OVER = (0, 2, 4)
_FOREIGN = {
    **{6: "triangle strip", 7: "polygon", 13: "wedge", 14: "pyramid", 21: "line3", 22: "triangle6"},
    **{23: "quad8", 24: "tetra10", 25: "hexahedron20", 26: "wedge15", 27: "pyramid13"},
    **{28: "quad9", 29: "hexahedron27", 42: "polyhedron", 69: "Lagrange triangle"},
    **{70: "Lagrange quadrilateral", 71: "Lagrange tetrahedron", 72: "Lagrange hexahedron"},
}

Array = npt.NDArray[Any]


def load_vtk(path: Path) -> Listing:
    """Read what the file lists. Vertices and cells keep its order."""
    with path.open("rb") as handle:
        file = _File(handle)
    connectivity, offsets, types = file.cells()
    if not len(types) or len(offsets) != len(types) + 1:
        raise MeshError("has no cells, or other numbers of cells and of cell types")
    tags = region_tags({name: [values] for name, values in file.cell_data.items()})
    tags = None if tags is None or len(tags[0]) != len(types) else tags
    numbers = np.zeros(len(types), dtype=np.int64) if tags is None else tags[0]
    points = file.points().astype(np.float64)
    return Listing(points, _blocks(connectivity, offsets, types, numbers))


def _blocks(
    connectivity: Integers, offsets: Integers, types: Integers, tags: npt.NDArray[np.integer]
) -> list[Block]:
    """A block for each run of cells of one type."""
    starts = np.flatnonzero(np.r_[True, types[1:] != types[:-1]])
    blocks = []
    for start, stop in zip(starts, np.r_[starts[1:], len(types)], strict=True):
        number = int(types[start])
        if number in _PASSED_OVER:
            continue
        kind, order = _CELLS.get(number, (_FOREIGN.get(number, f"{number} of VTK"), None))
        size = _VERTICES.get(kind, 1)
        at = offsets[start:stop]
        if kind in _VERTICES:
            if (np.diff(offsets[start : stop + 1]) != size).any():
                raise MeshError(f"has a {kind} with other than {size} vertices")
            if at.min() < 0 or at.max() + size > len(connectivity):
                raise MeshError("ends within its cells")
        elements = connectivity[at[:, None] + np.arange(size)] if kind in _VERTICES else at[:, None]
        blocks.append(
            Block(kind, elements if order is None else elements[:, order], tags[start:stop])
        )
    return blocks


class _File:
    """A legacy file, read keyword after keyword."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        head = [file.readline() for _ in range(3)]
        if not head[0].startswith(b"# vtk DataFile"):
            raise MeshError("is no VTK file: it does not begin with # vtk DataFile Version")
        self._text = head[2].strip().upper() == b"ASCII"
        self._arrays: dict[str, Array] = {}
        self.cell_data: dict[str, Array] = {}
        self._dataset, self._data_of, self._rows, self._connections = "", "", 0, 0
        while line := file.readline():
            words = line.decode("latin-1").split()
            try:
                if words:
                    self._take(words[0].upper(), words[1:])
            except MeshError:
                raise
            except (ValueError, IndexError, OverflowError) as e:
                told = " ".join(words)[:60]
                raise MeshError(f"has a line that is not as VTK has it: {told}") from e

    def points(self) -> Array:
        """Coordinates of all vertices, shape (vertices, 3)."""
        if self._dataset in ("UNSTRUCTURED_GRID", "STRUCTURED_GRID"):
            return self._array("POINTS").reshape(-1, 3)
        if self._dataset == "RECTILINEAR_GRID":
            axes = [self._array(f"{axis}_COORDINATES") for axis in "XYZ"]
        else:
            spacing = self._arrays.get("SPACING", self._arrays.get("ASPECT_RATIO", np.ones(3)))
            origin = self._arrays.get("ORIGIN", np.zeros(3))
            axes = [
                x + step * np.arange(n)
                for x, step, n in zip(origin, spacing, self._dimensions(), strict=True)
            ]
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)

    def cells(self) -> tuple[Integers, Integers, Integers]:
        """Vertices of all cells, where each begins among them and the last ends, and the types."""
        if self._dataset != "UNSTRUCTURED_GRID":
            return self._grid_cells()
        types = self._array("CELL_TYPES").astype(np.int64)
        if "OFFSETS" in self._arrays:
            return (
                self._array("CONNECTIVITY").astype(np.int64),
                self._arrays["OFFSETS"].astype(np.int64),
                types,
            )
        counted = self._array("CELLS").astype(np.int64)
        starts, at = np.empty(len(types), dtype=np.int64), 0
        sizes = np.array([_sizes(number) for number in np.unique(types).tolist()])
        if len(sizes) == 1 and sizes[0] and len(counted) == (sizes[0] + 1) * len(types):
            starts = np.arange(len(types)) * (sizes[0] + 1)
        else:
            for k in range(len(types)):
                if at >= len(counted):
                    raise MeshError("ends within its cells")
                starts[k] = at
                at += 1 + int(counted[at])
        counts = counted[starts]
        kept = np.ones(len(counted), dtype=bool)
        kept[starts] = False
        return counted[kept], np.r_[0, np.cumsum(counts)], types

    def _dimensions(self) -> list[int]:
        dimensions = [int(n) for n in self._array("DIMENSIONS")]
        if len(dimensions) != 3 or min(dimensions) < 1:
            raise MeshError("has DIMENSIONS other than three counts of 1 or more")
        if np.prod(dimensions, dtype=float) > _MOST_POINTS:
            raise MeshError(f"has a grid of more than {_MOST_POINTS:.0e} points")
        return dimensions

    def _grid_cells(self) -> tuple[Integers, Integers, Integers]:
        """The cells of a grid, x fastest, as voxels or pixels."""
        n = self._dimensions()
        active = [i for i in range(3) if n[i] > 1]
        corners = np.zeros(1, dtype=np.int64)
        first = np.arange(n[0] * n[1] * n[2]).reshape(n[::-1])
        for i in active:
            corners = np.concatenate([corners, corners + int(np.prod(n[:i]))])
            first = np.delete(first, -1, axis=2 - i)
        cells = first.ravel()[:, None] + corners
        number = {2: 8, 3: 11}.get(len(active), 3)
        return (
            cells.ravel(),
            np.arange(len(cells) + 1) * len(corners),
            np.full(len(cells), number, dtype=np.int64),
        )

    def _array(self, name: str) -> Array:
        if name not in self._arrays:
            raise MeshError(f"has no {name}")
        return self._arrays[name]

    def _take(self, keyword: str, words: list[str]) -> None:
        if keyword == "DATASET":
            self._dataset = words[0].upper()
            if self._dataset not in _DATASETS:
                raise MeshError(f"is {words[0]}; {', '.join(_DATASETS)} are read")
        elif keyword == "METADATA":
            while self._file.readline().strip():
                pass
        elif keyword == "POINTS":
            self._arrays[keyword] = self._numbers(words[1], 3 * int(words[0]))
        elif keyword == "CELLS":
            here, following = self._file.tell(), self._file.readline().split()
            if following[:1] == [b"OFFSETS"]:
                self._connections = int(words[1])
                self._arrays["OFFSETS"] = self._numbers(following[1].decode(), int(words[0]))
            else:
                self._file.seek(here)
                self._arrays[keyword] = self._numbers("int", int(words[1]))
        elif keyword == "CONNECTIVITY":
            self._arrays[keyword] = self._numbers(words[0], self._connections)
        elif keyword == "CELL_TYPES":
            self._arrays[keyword] = self._numbers("int", int(words[0]))
        elif keyword in ("DIMENSIONS", "ORIGIN", "SPACING", "ASPECT_RATIO"):
            self._arrays[keyword] = np.array([float(word) for word in words])
        elif keyword.endswith("_COORDINATES") and keyword[0] in "XYZ":
            self._arrays[keyword] = self._numbers(words[1], int(words[0]))
        elif keyword in ("CELL_DATA", "POINT_DATA"):
            self._data_of, self._rows = keyword, int(words[0])
        else:
            self._attribute(keyword, words)

    def _attribute(self, keyword: str, words: list[str]) -> None:
        if keyword == "FIELD":
            for _ in range(int(words[1])):
                line = self._words()
                if line[0] == "METADATA":
                    self._take("METADATA", [])
                    line = self._words()
                self._keep(line[0], line[3], int(line[1]) * int(line[2]))
        elif keyword == "SCALARS":
            here = self._file.tell()
            if not self._file.readline().upper().startswith(b"LOOKUP_TABLE"):
                self._file.seek(here)
            self._keep(words[0], words[1], self._rows * int((*words, "1")[2]))
        elif keyword == "LOOKUP_TABLE":
            self._numbers("float" if self._text else "unsigned_char", 4 * int(words[1]))
        elif keyword == "COLOR_SCALARS":
            kind = "float" if self._text else "unsigned_char"
            self._numbers(kind, self._rows * int(words[1]))
        elif keyword == "TEXTURE_COORDINATES":
            self._numbers(words[2], self._rows * int(words[1]))
        elif keyword in _WIDTHS:
            self._keep(words[0], words[1], self._rows * _WIDTHS[keyword])
        else:
            raise MeshError(f"has a keyword {keyword[:20]!r} that is none of VTK's")

    def _words(self) -> list[str]:
        """The words of the next line that is not empty."""
        while line := self._file.readline():
            if line.strip():
                return line.decode("latin-1").split()
        raise MeshError("ends within its data")

    def _keep(self, name: str, kind: str, count: int) -> None:
        values = self._numbers(kind, count)
        if self._data_of == "CELL_DATA" and self._rows and count % self._rows == 0:
            self.cell_data[name] = values.reshape(self._rows, -1)

    def _numbers(self, kind: str, count: int) -> Array:
        """The next numbers of the file; binary ones have their highest byte first."""
        if kind.lower() == "string" and self._text:
            return np.array([self._file.readline() for _ in range(count)])
        if kind.lower() not in _TYPES:
            raise MeshError(f"has data of type {kind}, which are not read")
        dtype = np.dtype(_TYPES[kind.lower()])
        if self._text:
            wide = np.float64 if dtype.kind == "f" else np.int64
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    found = np.fromfile(self._file, dtype=wide, count=count, sep=" ")
                except (DeprecationWarning, ValueError) as e:
                    raise MeshError(f"has something else where {count} numbers are due") from e
        else:
            if kind.lower() == "bit":
                count = (count + 7) // 8
            found = np.fromfile(self._file, dtype=dtype.newbyteorder(">"), count=count)
        if count < 0 or len(found) != count:
            raise MeshError(f"has {len(found)} numbers where {count} are due")
        return found


def _sizes(number: int) -> int:
    return _VERTICES.get(_CELLS.get(number, ("", None))[0], 0)
