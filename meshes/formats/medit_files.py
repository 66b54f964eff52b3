"""Medit's .mesh files as text: what mmg, bamg, gmsh, FreeFEM and Inria's programs write.

A keyword, a number of rows, the rows. Programs differ in where they break lines, in the keywords
they add (RequiredEdges, Ridges, Normals, SubDomainFromMesh, ...) and in what follows after End.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.formats.listing import Block, Listing, integral
from meshes.formats.numbers import parsed, whole

_ELEMENTS = {
    "edges": ("line", 2),
    "triangles": ("triangle", 3),
    "quadrilaterals": ("quad", 4),
    "tetrahedra": ("tetra", 4),
    "hexahedra": ("hexahedron", 8),
    "hexaedra": ("hexahedron", 8),
    # told by name, and refused
    "prisms": ("wedge", 6),
    "pyramids": ("pyramid", 5),
    "edgesp2": ("line3", 3),
    "trianglesp2": ("triangle6", 6),
    "quadrilateralsq2": ("quad9", 9),
    "tetrahedrap2": ("tetra10", 10),
    "hexahedraq2": ("hexahedron27", 27),
}
_COMMENT = re.compile(r"#[^\n]*|\"[^\"\n]*\"")
# A keyword begins a line; nan and inf are numbers, if bad ones.
_KEYWORD = re.compile(r"^[ \t]*(?!nan\b|inf\b|infinity\b)([A-Za-z]\w*)", re.I | re.M)


def load_medit(path: Path) -> Listing:
    """Read what the file lists. Vertices and elements keep its order."""
    text = _COMMENT.sub(" ", path.read_text(encoding="latin-1"))
    found = list(_KEYWORD.finditer(text))
    if not found or found[0][1].lower() != "meshversionformatted":
        raise MeshError("is no Medit file: it does not begin with MeshVersionFormatted")
    dimension = 0
    points: npt.NDArray[np.float64] | None = None
    tags: npt.NDArray[np.integer] | None = None
    blocks = []
    for keyword, following in zip(found, [*found[1:], None], strict=True):
        name = keyword[1]
        if name.lower() == "end":
            break
        rows = text[keyword.end() : len(text) if following is None else following.start()]
        if name.lower() == "dimension":
            dimension = int(whole(_numbers(name, rows), f"under {name}")[0])
        elif name.lower() == "vertices":
            table = _table(name, rows, dimension + 1)
            points = table[:, :dimension]
            tags = integral(table[:, dimension])
        elif name.lower() in _ELEMENTS:
            kind, vertices = _ELEMENTS[name.lower()]
            table = _table(name, rows, vertices + 1)
            elements = whole(table, f"under {name}")
            blocks.append(Block(kind, elements[:, :vertices] - 1, elements[:, vertices]))
    if points is None:
        raise MeshError("lists no Vertices")
    return Listing(points, blocks, vertex_tags=tags)


def _numbers(name: str, rows: str) -> npt.NDArray[np.float64]:
    numbers = parsed(rows, f"under {name}")
    if not len(numbers):
        raise MeshError(f"has no number after {name}")
    return numbers


def _table(name: str, rows: str, width: int) -> npt.NDArray[np.float64]:
    """The rows of a section, after their number."""
    numbers = _numbers(name, rows)
    count = int(whole(numbers[:1], f"under {name}")[0])
    if width < 3 and name.lower() == "vertices":
        raise MeshError("lists Vertices before it says Dimension 2 or 3")
    if len(numbers) != 1 + count * width:
        raise MeshError(
            f"has {len(numbers) - 1} numbers under {name}, where {count} rows of {width} are due"
        )
    return numbers[1:].reshape(count, width)
