"""Bodies from mesh files: read and checked on rank 0, distributed from there."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

from meshes.body import Body, MeshError
from meshes.meshio_files import load_meshio
from meshes.raw import RawMesh, check, distribute
from meshes.xdmf_files import load_xdmf


def read(comm: MPI.Comm, path: str | Path) -> Body:
    """Read a body from a file of triangles or quadrilaterals, of tetrahedra or hexahedra.

    The file order of the result is that of the file: vertices as listed, cells as listed
    (block after block where the format has blocks). Cell tags are gmsh physical groups, Medit
    references or the file's first integer cell data. `Body.groups` holds, by number, the tagged
    facets (else edges, else vertices) and, by name, the physical groups and sets of the file.

    The orientation in which a cell lists its vertices is of no consequence.

    Args:
        comm: Communicator over which the mesh is distributed.
        path: The file; its suffix tells the format.

    Raises:
        MeshError: On all ranks: the file is missing or unreadable, holds other cells or a mix of
            cells, has vertices without a cell, or cells that are flat, not convex or folded over
            a neighbour.
    """
    raw: RawMesh | None = None
    error: str | None = None
    if comm.rank == 0:
        try:
            raw = _load(Path(path))
        except MeshError as e:
            error = f"{path}: {e}"
        except OSError as e:
            error = f"{path}: cannot be read ({e.strerror})"
    error = comm.bcast(error)
    if error is not None:
        raise MeshError(error)

    name, vertices = comm.bcast(None if raw is None else (raw.kind.name, raw.cells.shape[1]))
    kind = getattr(mesh.CellType, name)
    d = mesh.cell_dim(kind)
    # Every rank gets the tags of the whole file: 4 bytes a cell, far below the mesh itself.
    tags, groups = comm.bcast(None if raw is None else (raw.tags, raw.groups))
    msh = distribute(
        comm,
        kind,
        np.empty((0, vertices), dtype=np.int64) if raw is None else raw.cells,
        np.empty((0, d)) if raw is None else raw.points,
    )
    original = msh.topology.original_cell_index
    local = np.arange(len(original), dtype=np.int32)
    return Body(msh, mesh.meshtags(msh, d, local, tags[original]), groups)


def _load(path: Path) -> RawMesh:
    if not path.is_file():
        raise MeshError("no such file")
    raw = load_xdmf(path) if path.suffix.lower() == ".xdmf" else load_meshio(path)
    check(raw)
    return raw
