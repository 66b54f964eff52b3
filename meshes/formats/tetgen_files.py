"""Files of TetGen, and of Triangle in 2D: .node and .ele, with .face and .edge beside them.

Each is a row of counts and then the rows, numbered from 0 or 1; # begins a comment. Vertices,
faces and edges may have a boundary marker, which becomes their tag, and elements attributes, of
which the last is the region's.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.formats.listing import Block, Listing, integral
from meshes.formats.numbers import parsed, places
from meshes.groups import Integers

logger = logging.getLogger("mixed_fem")

_KINDS = {(2, 3): "triangle", (3, 4): "tetra", (2, 6): "triangle6", (3, 10): "tetra10"}

Reals = npt.NDArray[np.float64]


def load_tetgen(path: Path) -> Listing:
    """Read .node and .ele, and .face and .edge where they are. All keep the order of the files."""
    nodes, elements = path.with_suffix(".node"), path.with_suffix(".ele")
    for other in (nodes, elements):
        if not other.is_file():
            raise MeshError(f"needs {other.name} beside it, which is not there")
    (count, d, attributes, markers), numbers = _counted(nodes, [0, 3, 0, 0])
    if d not in (2, 3):
        raise MeshError(f"has {d} coordinates a vertex; 2 or 3 are wanted")
    rows = _rows(nodes, numbers, count, 1 + d + attributes + markers)
    names = rows[:, 0]
    tags = integral(rows[:, -1]) if markers else None
    listing = Listing(rows[:, 1 : 1 + d], [], vertex_tags=tags)

    (count, vertices, attributes), numbers = _counted(elements, [0, d + 1, 0])
    kind = _KINDS.get((d, vertices), f"{vertices} vertices in {d}D")
    rows = _rows(elements, numbers, count, 1 + vertices + attributes)
    corners = _places(elements, names, rows[:, 1 : 1 + vertices])
    listing.blocks.append(Block(kind, corners, _regions(elements, rows[:, 1 + vertices :])))
    for suffix, size in ((".face", 3), (".edge", 2)):
        beside = path.with_suffix(suffix)
        if beside.is_file() and size <= d:
            listing.blocks.append(_tagged(beside, names, size))
    return listing


def _tagged(path: Path, names: Reals, size: int) -> Block:
    """Faces or edges. After the marker may come the elements on both sides, or middle vertices."""
    (count, markers), numbers = _counted(path, [0, 0])
    width = len(numbers) // count if count else 1 + size + markers
    rows = _rows(path, numbers, count, width)
    if width < 1 + size + markers:
        raise MeshError(f"{path.name}: has {width} numbers in a row, too few")
    # Second-order files have the middle vertices before the marker; their cells are refused.
    marks = integral(rows[:, 1 + size]) if markers and width > 1 + size else None
    kind = {3: "triangle", 2: "line"}[size]
    return Block(kind, _places(path, names, rows[:, 1 : 1 + size]), marks)


def _counted(path: Path, default: list[int]) -> tuple[list[int], Reals]:
    """The row of counts, with defaults for those left out, and the numbers after it."""
    lines = [line.partition("#")[0] for line in path.read_text(encoding="latin-1").splitlines()]
    lines = [line for line in lines if line.strip()]
    if not lines:
        raise MeshError(f"{path.name}: is empty")
    try:
        counts = [int(word) for word in lines[0].split()][: len(default)]
    except ValueError as e:
        raise MeshError(f"{path.name}: begins with something else than counts") from e
    numbers = parsed("\n".join(lines[1:]), f"in {path.name}")
    counts += default[len(counts) :]
    if min(counts) < 0:
        raise MeshError(f"{path.name}: begins with a negative count")
    return counts, numbers


def _rows(path: Path, numbers: Reals, count: int, width: int) -> Reals:
    if len(numbers) != count * width:
        raise MeshError(
            f"{path.name}: has {len(numbers)} numbers, where {count} rows of {width} are due"
        )
    return numbers.reshape(count, width)


def _places(path: Path, names: Reals, named: Reals) -> Integers:
    """Places of vertices in the list of those, by their numbers."""
    found = places(names, named)
    if (found < 0).any():
        raise MeshError(f"{path.name}: names a vertex that the .node file does not list")
    return found


def _regions(path: Path, attributes: Reals) -> npt.NDArray[np.integer] | None:
    """The region of each element: its last attribute, written as a whole or a real number."""
    if not attributes.shape[1]:
        return None
    tags = integral(attributes[:, -1])
    if tags is None:
        logger.warning("%s: attributes are no whole numbers, so that no cell gets a tag", path.name)
    return tags
