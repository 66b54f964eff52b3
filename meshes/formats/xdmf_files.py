"""XDMF mesh files with HDF5 data, through DOLFINx, which needs no further package for HDF5."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

from mpi4py import MPI

import numpy as np
from dolfinx import mesh
from dolfinx.io import XDMFFile

from meshes.body import VTK_ORDER
from meshes.checks import check
from meshes.errors import MeshError
from meshes.formats.listing import KINDS, TAGGED, Collected, cell_kind, narrow, planar
from meshes.raw import RawMesh, domain

_SPELLINGS = {
    **{"tetrahedron": "tetra", "quadrilateral": "quad"},
    **{"polyline": "line", "polyvertex": "vertex"},
}
_DOMAIN = "/Xdmf/Domain"


def load_xdmf(path: Path) -> RawMesh:
    """Read the first mesh of the highest dimension in the file, and its integer cell data.

    Raises:
        MeshError: The file cannot be read as XDMF, or holds no straight cells.
    """
    try:
        tree = ET.parse(path)
    except ET.ParseError as e:
        raise MeshError(f"cannot be read as XDMF ({e})") from e
    grids = [
        (_kind(topology), grid)
        for grid in tree.findall("./Domain/Grid")
        if (topology := grid.find("Topology")) is not None
    ]
    if not grids:
        raise MeshError("cannot be read as XDMF (no <Grid> with a <Topology> in its <Domain>)")
    if all(item.get("Format") == "XML" for item in tree.iter("DataItem")):
        raise MeshError(
            "keeps its numbers in the XML; write them to HDF5 (DOLFINx, meshio: default)"
        )
    kind, body = max(grids, key=lambda pair: TAGGED.get(pair[0], 4))
    d = TAGGED[cell_kind({kind})]
    name = body.get("Name", "")
    try:
        with _silent_hdf5(), XDMFFile(MPI.COMM_SELF, str(path), "r") as file:
            cells = np.asarray(file.read_topology_data(name, _DOMAIN), dtype=np.int64)
            points = np.asarray(file.read_geometry_data(name, _DOMAIN), dtype=np.float64)
            tags = np.zeros(len(cells), dtype=np.int32)
            raw = RawMesh(KINDS[kind], planar(points, d), cells, tags)
            check(raw)
            msh = mesh.create_mesh(MPI.COMM_SELF, raw.cells, domain(raw.kind), raw.points)
            collected = Collected(d)
            for kind, grid in grids:
                dim = TAGGED[kind]
                msh.topology.create_entities(dim)
                msh.topology.create_connectivity(dim, d)
                for attribute in filter(_is_tag, grid.findall("Attribute")):
                    found = file.read_meshtags(msh, grid.get("Name", ""), attribute.get("Name"))
                    _adopt(raw, collected, msh, found)
            raw.groups = collected.groups()
    except RuntimeError as e:
        # DOLFINx wheels have an HDF5 without deflate, which meshio applies by default.
        said = " ".join(str(e).split()).rstrip(".")
        hint = "if its HDF5 data are compressed, write them without compression"
        raise MeshError(f"cannot be read as XDMF ({said}; {hint})") from e
    return raw


@contextlib.contextmanager
def _silent_hdf5() -> Iterator[None]:
    """HDF5 prints a stack of diagnostics to the file descriptor before the error is raised."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with open(os.devnull, "wb") as sink:
            os.dup2(sink.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def _kind(topology: ET.Element) -> str:
    spelt = (topology.get("TopologyType") or topology.get("Type") or "unknown").lower()
    return _SPELLINGS.get(spelt, spelt)


def _is_tag(attribute: ET.Element) -> bool:
    item = attribute.find("DataItem")
    if item is None or attribute.get("Center") != "Cell":
        return False
    # DOLFINx states no number type for tags, and keeps functions in nested grids.
    return item.get("NumberType", item.get("DataType", "Int")) in ("Int", "UInt")


def _adopt(
    raw: RawMesh, collected: Collected, msh: mesh.Mesh[np.float64], tags: mesh.MeshTags
) -> None:
    """Enter tags of the serial mesh, in file order; of a cell the first to come is its tag."""
    d = msh.topology.dim
    numbers = narrow(tags.values, "an entity")
    cells = msh.topology.original_cell_index
    if tags.dim == d:
        bare = tags.indices[raw.tags[cells[tags.indices]] == 0]
        values = numbers[np.isin(tags.indices, bare)]
        raw.tags[cells[bare]] = values
    for number in np.unique(numbers[numbers != 0]).tolist():
        entities = tags.find(number)
        if tags.dim == d:
            collected.add(number, d, cells[entities])
            continue
        rows = msh.geometry.input_global_indices[mesh.entities_to_geometry(msh, tags.dim, entities)]
        if rows.shape[1] == 4:  # a quadrilateral
            rows = rows[:, VTK_ORDER[mesh.CellType.quadrilateral]]
        collected.add(number, tags.dim, rows.ravel() if tags.dim == 0 else rows)
