"""Bodies: meshes with tags, and the way back to the order of their files.

`box` generates, `read` reads; both give a `Body`. Which vertices are meant by a clause such
as ``{ x = "max" }`` is the business of `Where`.
"""

from __future__ import annotations

from mpi4py import MPI  # noqa: F401  (must precede every other MPI import)

from meshes.body import VTK_ORDER, Body
from meshes.errors import MeshError
from meshes.generators import CELLS, box
from meshes.geometries import GEOMETRIES, geometry
from meshes.groups import Group
from meshes.parts import Part, connected_parts, told_parts
from meshes.readers import read
from meshes.refine import refine
from meshes.where import Where

__all__ = [
    "CELLS",
    "GEOMETRIES",
    "VTK_ORDER",
    "Body",
    "Group",
    "MeshError",
    "Part",
    "Where",
    "box",
    "connected_parts",
    "geometry",
    "read",
    "refine",
    "told_parts",
]
