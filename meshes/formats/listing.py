"""What a mesh file lists, and the mesh that follows from it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import CellType, cell_dim

from meshes.body import VTK_ORDER
from meshes.errors import MeshError
from meshes.groups import Group, Integers, ascending
from meshes.raw import RawMesh, strange

# Kinds of cells that a body may have, by meshio's names.
KINDS = {
    "triangle": CellType.triangle,
    "quad": CellType.quadrilateral,
    "tetra": CellType.tetrahedron,
    "hexahedron": CellType.hexahedron,
}
# Entities that may carry a tag, with their dimension.
TAGGED = {"vertex": 0, "line": 1} | {name: cell_dim(kind) for name, kind in KINDS.items()}
_FACET = {"triangle": "line", "quad": "line", "tetra": "triangle", "hexahedron": "quad"}
_WANTED = "straight triangles or quadrilaterals (2D), tetrahedra or hexahedra (3D) are wanted"
# Names, in small letters alone, that files have for the region of a cell, the clearest first.
_REGIONS = (
    *("gmshphysical", "meditref", "celltags", "nametoread", "region", "regionid", "regions"),
    *("material", "materialid", "materialids", "materials", "mat", "matid", "attribute", "tag"),
    *("tags", "cellentityids", "tetgenref", "su2tag", "flacref"),
)
# A mesh is flat when it is no thicker than this fraction of its largest extent: single precision
# files round coordinates at 1e-7.
_FLATNESS = 1e-6


@dataclass
class Block:
    """Elements of one kind that a file lists one after another.

    Attributes:
        kind: meshio's name of it.
        elements: Vertices from 0, in the order of VTK, shape (n, vertices of one).
        tags: Numbers of the groups that each element is in, shape (n,) or (n, groups); 0 is none.
    """

    kind: str
    elements: Integers
    tags: npt.NDArray[np.integer] | None = None


@dataclass
class Listing:
    """What a mesh file lists, in its order.

    Elements count from 0 through all blocks.

    Attributes:
        points: Coordinates, shape (vertices, 2 or 3).
        blocks: The elements.
        names: Names of groups, by dimension and number.
        vertex_tags: A number for each vertex, 0 being none; or nothing at all.
        vertex_sets: Vertices by the name of the set.
        element_sets: Elements by the name of the set.
        facet_sets: Facets by the name of the set, each by its vertices.
    """

    points: npt.NDArray[np.float64]
    blocks: list[Block]
    names: dict[tuple[int, int], str] = field(default_factory=dict)
    vertex_tags: npt.NDArray[np.integer] | None = None
    vertex_sets: dict[str, Integers] = field(default_factory=dict)
    element_sets: dict[str, Integers] = field(default_factory=dict)
    facet_sets: dict[str, Integers] = field(default_factory=dict)


def assemble(listing: Listing) -> RawMesh:
    """Take the elements of the highest dimension for cells, the others for what they tag.

    Raises:
        MeshError: The cells are none, curved or of several kinds, the mesh is a surface in space,
            or a tag does not fit in 32 bits.
    """
    listed = [block for block in listing.blocks if len(block.elements)]
    kind = cell_kind({block.kind for block in listed})
    d = TAGGED[kind]
    blocks = [block for block in listed if block.kind == kind]
    cells = np.concatenate([block.elements for block in blocks]).astype(np.int64)
    tags = np.concatenate([_first(_columns(block)) for block in blocks])
    raw = RawMesh(
        KINDS[kind],
        planar(np.asarray(listing.points, dtype=np.float64), d),
        cells[:, VTK_ORDER[KINDS[kind]]],
        tags.astype(np.int32),
    )
    collected = Collected(d)
    first, first_cell = 0, 0
    for block in listed:
        dim, count = TAGGED[block.kind], len(block.elements)
        members = block.elements
        if block.kind == kind:
            members = np.arange(first_cell, first_cell + count)
            first_cell += count
        elif dim == 0:
            members = members[:, 0]
        chosen: list[tuple[str | int, Integers]] = []
        for column in _columns(block).T:
            for number in np.unique(column[column != 0]).tolist():
                where = np.flatnonzero(column == number)
                chosen.append((number, where))
                if (dim, number) in listing.names:
                    chosen.append((listing.names[dim, number], where))
        for name, elements in listing.element_sets.items():
            chosen.append(
                (name, elements[(elements >= first) & (elements < first + count)] - first)
            )
        if dim == d - 1 and block.kind != _FACET[kind] and any(len(where) for _, where in chosen):
            raise MeshError(
                f"tags elements of type {block.kind}, which are no facets of its cells of type "
                f"{kind}"
            )
        for key, where in chosen:
            collected.add(key, dim, members[where])
        first += count
    if listing.vertex_tags is not None:
        numbers = narrow(listing.vertex_tags, "a vertex")
        found = np.unique(numbers).tolist()
        # One tag on all vertices is what some programs write for none.
        for number in found if len(found) > 1 else ():
            if number != 0:
                collected.add(number, 0, np.flatnonzero(numbers == number))
    for name, vertices in listing.vertex_sets.items():
        collected.add(name, 0, vertices)
    for name, facets in listing.facet_sets.items():
        collected.add(name, d - 1, facets)
    raw.groups = collected.groups()
    return raw


class Collected:
    """Tagged entities, come upon one after another."""

    def __init__(self, d: int) -> None:
        self._d = d
        self._parts: dict[str | int, dict[int, list[Integers]]] = {}

    def add(self, key: str | int, dim: int, members: Integers) -> None:
        """Enter entities of a dimension under a name or number, as `Group` lists them."""
        if len(members):
            self._parts.setdefault(key, {}).setdefault(dim, []).append(members)

    def groups(self) -> dict[str | int, Group]:
        """All that was entered."""
        return {
            key: Group(
                {
                    dim: ascending(np.concatenate(parts))
                    if dim in (0, self._d)
                    else np.concatenate(parts).astype(np.int64)
                    for dim, parts in by_dim.items()
                }
            )
            for key, by_dim in self._parts.items()
        }


def _columns(block: Block) -> Integers:
    """Tags of a block, shape (elements, groups)."""
    if block.tags is None:
        return np.zeros((len(block.elements), 1), dtype=np.int64)
    noun = {0: "a vertex", 1: "an edge"}.get(TAGGED[block.kind], f"a {block.kind}")
    return narrow(block.tags, noun).reshape(len(block.elements), -1)


def _first(columns: Integers) -> Integers:
    """The first number of each row that is not 0, else 0."""
    rows: Integers = columns[np.arange(len(columns)), (columns != 0).argmax(axis=1)]
    return rows


def narrow(tags: npt.NDArray[np.integer], noun: str) -> Integers:
    """Insist that tags are within 32 bits, which is what DOLFINx has for them."""
    low, high = np.iinfo(np.int32).min, np.iinfo(np.int32).max
    beyond = tags[(tags < low) | (tags > high)]
    if len(beyond):
        raise MeshError(
            f"tags {noun} with {beyond.flat[0]}; a tag must lie between {low} and {high}"
        )
    return tags.astype(np.int64)


def integral(values: npt.NDArray[np.generic]) -> npt.NDArray[np.integer] | None:
    """Whole numbers, one for each row, whatever the type and shape a file has for them.

    Returns:
        Shape (n,), or None if they are not whole numbers or several to a row.
    """
    values = np.asarray(values)
    if values.ndim == 0 or values.size != len(values):
        return None
    values = values.reshape(len(values))
    if np.issubdtype(values.dtype, np.integer):
        return np.asarray(values, dtype=values.dtype)
    if not np.issubdtype(values.dtype, np.floating):
        return None
    if not (np.isfinite(values).all() and (values == np.rint(values)).all()):
        return None
    # Real numbers beyond the range of tags are no tags, but a modulus, say.
    if len(values) and np.abs(values).max() > np.iinfo(np.int32).max:
        return None
    return values.astype(np.int64)


def region_tags(
    data: Mapping[str, Sequence[npt.NDArray[np.generic]]],
) -> list[npt.NDArray[np.integer]] | None:
    """The data on elements, block by block, that number the regions they are in.

    Those of a telling name come first, then whole numbers, then real numbers that are whole.
    """
    whole = {
        key: [tags for values in blocks if (tags := integral(values)) is not None]
        for key, blocks in data.items()
    }
    fit = [key for key, blocks in data.items() if len(whole[key]) == len(blocks)]
    real = [key for key in fit if any(np.asarray(v).dtype.kind == "f" for v in data[key])]

    def rank(key: str) -> tuple[int, bool]:
        plain = re.sub(r"[^a-z]", "", key.lower())
        return (_REGIONS.index(plain) if plain in _REGIONS else len(_REGIONS)), key in real

    # gmsh:geometrical numbers the CAD entities, which is not what a user tagged.
    fit = [key for key in fit if key != "gmsh:geometrical"]
    return whole[min(fit, key=rank)] if fit else None


def cell_kind(kinds: set[str]) -> str:
    """The one kind of cell among the entities of a file."""
    d = max((TAGGED[kind] for kind in kinds & set(KINDS)), default=0)
    cells = {kind for kind in kinds & set(KINDS) if TAGGED[kind] == d}
    foreign = sorted(kinds - set(TAGGED))
    if foreign or len(cells) > 1:
        mixed = "a mix of cells" if cells else "cells"
        raise MeshError(f"has {mixed} of type {', '.join(foreign or sorted(cells))}; {_WANTED}")
    if not cells:
        raise MeshError(f"has no cells; {_WANTED}")
    return cells.pop()


def planar(points: npt.NDArray[np.float64], d: int) -> npt.NDArray[np.float64]:
    """Drop the coordinate in which a flat mesh has no extent.

    A mesh in the plane of z and x keeps the order in which they stand, x before z, and so on.
    """
    if points.shape[1] == d:
        return points
    if points.shape[1] < d:
        raise MeshError(f"has {points.shape[1]} coordinates a vertex, {d} are wanted")
    if len(strange(points)):
        raise MeshError(f"vertex {strange(points)[0]} (from 0) has coordinates that are not finite")
    extents = np.ptp(points, axis=0)
    thin = np.flatnonzero(extents <= _FLATNESS * extents.max())
    if not len(thin):
        raise MeshError(
            "is a surface in space; fill it with tetrahedra or hexahedra, or give a flat mesh at "
            "constant z, y or x"
        )
    return np.ascontiguousarray(np.delete(points, thin[-1], axis=1))
