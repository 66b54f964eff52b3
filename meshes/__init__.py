"""Bodies: meshes with tags, and the way back to the order of their files.

`box` generates, `read` reads; both give a `Body`. Which vertices are meant by a clause such
as ``{ x = "max" }`` is the business of `Where`.
"""

from __future__ import annotations

from mpi4py import MPI  # noqa: F401  (must precede every other MPI import)

from meshes.body import VTK_ORDER, Body, MeshError
from meshes.generators import CELLS, box
from meshes.readers import read
from meshes.where import Where

__all__ = ["CELLS", "VTK_ORDER", "Body", "MeshError", "Where", "box", "read"]
