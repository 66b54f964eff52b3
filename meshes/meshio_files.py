"""Mesh files that meshio reads: Medit .mesh, gmsh .msh, VTK, Abaqus and more."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np
import numpy.typing as npt

from meshes.body import VTK_ORDER, MeshError
from meshes.raw import KINDS, TAGGED, Integers, RawMesh, cell_kind, planar

# The files' own names for the region a cell belongs to, the most specific first.
_REGION_KEYS = ("gmsh:physical", "medit:ref", "cell_tags", "name_to_read")


def load_meshio(path: Path) -> RawMesh:
    """Read any file that meshio knows by its suffix.

    Raises:
        MeshError: meshio cannot read the file, or it holds other than straight cells of one kind.
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

    kinds = {block.type for block in found.cells if len(block.data)}
    kind = cell_kind(kinds)
    d = TAGGED[kind]
    blocks = [i for i, block in enumerate(found.cells) if block.type == kind]
    cells = np.concatenate([found.cells[i].data for i in blocks]).astype(np.int64)
    # meshio has all formats' vertices in VTK's order.
    cells = cells[:, VTK_ORDER[KINDS[kind]]]
    data = _region_data(found)
    tags = np.zeros(len(cells), dtype=np.int32)
    if data is not None:
        tags = np.concatenate([data[i] for i in blocks]).astype(np.int32)
    points = planar(np.asarray(found.points, dtype=np.float64), d)
    raw = RawMesh(KINDS[kind], points, cells, tags)

    groups: dict[str | int, Integers] = {}
    names = {(int(dim), int(tag)): str(n) for n, (tag, dim) in found.field_data.items()}
    for dim in range(d, -1, -1):
        numbered: dict[int, list[Integers]] = {}
        for block, tag in _tagged_blocks(found, data, dim):
            for number in np.unique(tag[tag != 0]):
                numbered.setdefault(int(number), []).append(block[tag == number])
        for number, parts in numbered.items():
            vertices = np.unique(np.concatenate([part.ravel() for part in parts]))
            if (dim, number) in names:
                groups[names[dim, number]] = vertices
            if dim < d:
                groups.setdefault(number, vertices)
    for number in np.unique(found.point_data.get("medit:ref", [])):
        if number != 0:
            chosen = np.flatnonzero(found.point_data["medit:ref"] == number)
            groups.setdefault(int(number), chosen)
    for name, chosen in found.point_sets.items():
        groups[name] = np.unique(chosen).astype(np.int64)
    for name, per_block in found.cell_sets.items():
        if not name.startswith("gmsh:"):
            parts = [
                block.data[np.asarray(chosen, dtype=np.int64)].ravel()
                for block, chosen in zip(found.cells, per_block, strict=True)
                if chosen is not None and len(chosen)
            ]
            if parts:
                groups[name] = np.unique(np.concatenate(parts)).astype(np.int64)
    raw.groups = groups
    return raw


def _region_data(found: meshio.Mesh) -> list[npt.NDArray[np.integer]] | None:
    # gmsh:geometrical numbers the CAD entities, which is not what a user tagged.
    integer = [
        key
        for key, blocks in found.cell_data.items()
        if key != "gmsh:geometrical"
        and all(np.ndim(b) == 1 and np.issubdtype(np.asarray(b).dtype, np.integer) for b in blocks)
    ]
    for key in (*_REGION_KEYS, *integer):
        if key in integer:
            return [np.asarray(block) for block in found.cell_data[key]]
    return None


def _tagged_blocks(
    found: meshio.Mesh, data: list[npt.NDArray[np.integer]] | None, dim: int
) -> Iterator[tuple[Integers, npt.NDArray[np.integer]]]:
    if data is not None:
        for block, tag in zip(found.cells, data, strict=True):
            if TAGGED.get(block.type) == dim:
                yield block.data, tag
