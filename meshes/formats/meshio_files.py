"""Mesh files that meshio reads: VTU, Nastran, SU2, MED and more."""

from __future__ import annotations

import contextlib
import io
import re
import warnings
from pathlib import Path

import meshio
import numpy as np

from meshes.errors import MeshError
from meshes.formats.listing import Block, Listing, integral, region_tags
from meshes.groups import Integers


def load_meshio(path: Path) -> Listing:
    """Read any file that meshio knows by its suffix.

    Raises:
        MeshError: meshio cannot read the file, or leaves out some of its cells.
    """
    said = io.StringIO()
    # meshio prints its findings and exits the interpreter when no reader fits.
    try:
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            found = meshio.read(path)
    except (Exception, SystemExit) as e:
        reason = str(e) if isinstance(e, Exception) and str(e) else said.getvalue()
        detail = " ".join(reason.split()) or "not what its suffix says"
        raise MeshError(f"cannot be read as a mesh ({detail})") from e
    left_out = re.search(r"cannot handle\s+\(type\s+(\d+)\)", said.getvalue())
    if left_out is not None:
        raise MeshError(
            f"has cells of VTK's type {left_out[1]}, which are not read from here; voxels (11) are "
            "read from legacy .vtk files"
        )
    data = region_tags(found.cell_data)
    blocks = [
        Block(block.type, np.asarray(block.data, dtype=np.int64), None if data is None else data[i])
        for i, block in enumerate(found.cells)
    ]
    names = {(int(dim), int(tag)): str(n) for n, (tag, dim) in found.field_data.items()}
    sets = {
        name: _running(blocks, chosen)
        for name, chosen in found.cell_sets.items()
        if not name.startswith("gmsh:")
    }
    references = found.point_data.get("medit:ref")
    return Listing(
        np.asarray(found.points, dtype=np.float64),
        blocks,
        names,
        vertex_tags=None if references is None else integral(references),
        vertex_sets={n: np.unique(v).astype(np.int64) for n, v in found.point_sets.items()},
        element_sets=sets,
    )


def _running(blocks: list[Block], chosen: list[Integers | None]) -> Integers:
    """Elements of all blocks by their running numbers, from those of each block."""
    parts, first = [np.empty(0, dtype=np.int64)], 0
    for block, those in zip(blocks, chosen, strict=True):
        if those is not None:
            parts.append(np.asarray(those, dtype=np.int64).ravel() + first)
        first += len(block.elements)
    return np.concatenate(parts)
