"""Bodies from mesh files: read and checked on rank 0, distributed from there."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from mpi4py import MPI

import numpy as np

from meshes.body import Body
from meshes.checks import check
from meshes.errors import MeshError
from meshes.formats.abaqus_files import load_abaqus
from meshes.formats.gmsh_files import is_gmsh, load_gmsh
from meshes.formats.listing import Listing, assemble
from meshes.formats.medit_files import load_medit
from meshes.formats.meshio_files import load_meshio
from meshes.formats.tetgen_files import load_tetgen
from meshes.formats.vtk_files import load_vtk
from meshes.formats.xdmf_files import load_xdmf
from meshes.raw import RawMesh, make_body

_LISTED: dict[str, Callable[[Path], Listing]] = {
    ".mesh": load_medit,
    ".node": load_tetgen,
    ".ele": load_tetgen,
    ".inp": load_abaqus,
    ".vtk": load_vtk,
}


def read(comm: MPI.Comm, path: str | Path, *, scale: float = 1.0) -> Body:
    """Read a body from a file of triangles or quadrilaterals, of tetrahedra or hexahedra.

    The file order of the result is that of the file: vertices as listed, cells as listed
    (block after block where the format has blocks; a cell that gmsh 2.2 lists once for each group
    that it is in counts once). Cell tags are gmsh physical groups, Medit references, TetGen's
    attributes or the file's first whole-numbered cell data; 0 where a cell has none. `Body.groups`
    holds the tagged vertices, edges, facets and cells by number and, by name, the physical groups,
    sets and surfaces of the file.

    The orientation in which a cell lists its vertices is of no consequence. A flat mesh may lie in
    any coordinate plane; the two coordinates that are left keep their order.

    Args:
        comm: Communicator over which the mesh is distributed.
        path: The file; its suffix tells the format.
        scale: Metres in a unit of the file, 0.001 for millimetres.

    Raises:
        MeshError: On all ranks: the file is missing or unreadable, holds other cells or a mix of
            cells, has vertices without a cell, or cells that are flat, not convex, listed twice or
            folded over a neighbour; or a tag does not fit in 32 bits.
    """
    return make_body(comm, lambda: load(Path(path), scale, checked=True))


def load(path: Path, scale: float = 1.0, *, checked: bool) -> RawMesh:
    """Read a mesh file on this rank alone.

    Args:
        path: The file.
        scale: Metres in a unit of the file.
        checked: Whether to refuse a mesh that cannot be used.

    Raises:
        MeshError: As `read`. The message begins with the path.
    """
    try:
        if not (math.isfinite(scale) and scale > 0):
            raise MeshError(f"scale must be above 0, not {scale}")
        if not path.is_file():
            raise MeshError("no such file")
        with np.errstate(all="ignore"):  # what becomes no number is found in the end
            raw = _load(path)
        if checked:
            check(raw)
    except MeshError as e:
        raise MeshError(f"{path}: {e}") from e
    except OSError as e:
        raise MeshError(f"{path}: cannot be read ({e.strerror})") from e
    except (ValueError, LookupError, ArithmeticError, MemoryError) as e:
        # what a file brings about that is not as its format has it
        said = " ".join(str(e).split()) or type(e).__name__
        raise MeshError(f"{path}: cannot be read as a mesh ({said})") from e
    raw.points *= scale
    return raw


def _load(path: Path) -> RawMesh:
    suffix = path.suffix.lower()
    if suffix == ".xdmf":
        return load_xdmf(path)
    if suffix in _LISTED:
        return assemble(_LISTED[suffix](path))
    return assemble(load_gmsh(path) if suffix == ".msh" and is_gmsh(path) else load_meshio(path))
