"""Uniform refinement: each cell into 2ᵈ, of any kind, with tags and groups handed on."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import numpy.typing as npt
from dolfinx.mesh import CellType

from meshes.body import VTK_ORDER, Body
from meshes.errors import MeshError
from meshes.groups import Group, Integers
from meshes.raw import RawMesh, collect, make_body
from meshes.topology import boundary_facets

# Children of a triangle and the four of a tetrahedron at its vertices, by pairs of vertices whose
# middle is meant; a vertex twice is itself.
_TRIANGLE = (
    ((0, 0), (0, 1), (0, 2)),
    ((0, 1), (1, 1), (1, 2)),
    ((0, 2), (1, 2), (2, 2)),
    ((0, 1), (1, 2), (0, 2)),
)
_TIPS = tuple(tuple((min(i, j), max(i, j)) for j in range(4)) for i in range(4))
# The other four share a diagonal of the octahedron that remains, one of three, and go around it.
_DIAGONALS = (
    ((0, 2), (1, 3), ((0, 1), (0, 3), (2, 3), (1, 2))),
    ((0, 3), (1, 2), ((0, 1), (0, 2), (2, 3), (1, 3))),
    ((0, 1), (2, 3), ((0, 2), (0, 3), (1, 3), (1, 2))),
)
# Diagonals are of one length within this fraction.
_EQUAL = 1e-9
# Beyond this number of cells, refinement is an oversight.
_MOST_CELLS = 10**9


def refine(body: Body, n: int = 1) -> Body:
    """Cut each cell into 2ᵈ, n times over. Collective.

    Simplices are cut at the middles of their edges, a tetrahedron's inner octahedron along its
    shortest diagonal; quadrilaterals and hexahedra into quadrants and octants. A box of simplices
    becomes the box of twice the cells along each edge. Tags and groups pass to the children of
    cells, facets and edges; a group of vertices gains the middles where `Body.dofs` finds degrees
    of freedom between them. `Where(vertices=...)` gains none.

    File order: the vertices keep their numbers; then come the middles of edges, of quadrilateral
    faces and of hexahedra, each in the order of their sorted vertex numbers. The children of cell c
    are 2ᵈ c to 2ᵈ (c + 1) − 1.

    Args:
        body: The body.
        n: How many times; 0 gives the body itself.

    Raises:
        MeshError: n is negative, or the cells would be too many.
    """
    if n < 0:
        raise MeshError(f"refine: must be 0 or more times, not {n}")
    if body.num_cells * 2 ** (body.mesh.topology.dim * n) > _MOST_CELLS:
        raise MeshError(f"refine: {n} times would make more than {_MOST_CELLS:.0e} cells")
    if n == 0:
        return body
    raw = collect(body)

    def finer() -> RawMesh:
        fine = raw
        assert fine is not None  # this is rank 0
        for _ in range(n):
            fine = _refined(fine)
        return fine

    return make_body(body.mesh.comm, finer)


class _Middles:
    """Numbers of new vertices in the middles of edges, faces and cells of a mesh."""

    def __init__(self, points: npt.NDArray[np.float64], sets: list[Integers]) -> None:
        """Number the middles of sets of vertices, the smaller sets first.

        Args:
            points: The vertices that there are.
            sets: Each of shape (n, size), one for a size, with repetitions.
        """
        self._keys: dict[int, npt.NDArray[np.generic]] = {}
        self._rows: dict[int, Integers] = {}
        self._first: dict[int, int] = {}
        every, count = [points], len(points)
        for rows in sorted(sets, key=lambda rows: rows.shape[1]):
            keys, one = np.unique(_keys(rows), return_index=True)
            size = rows.shape[1]
            self._keys[size], self._rows[size], self._first[size] = keys, rows[one], count
            every.append(points[rows[one]].mean(axis=1))
            count += len(keys)
        self.points = np.concatenate(every)

    def within(self, vertices: Integers) -> Integers:
        """The middles of all sets whose vertices are all among some."""
        found = [
            np.flatnonzero(np.isin(rows, vertices).all(axis=1)) + self._first[size]
            for size, rows in self._rows.items()
        ]
        return np.concatenate(found)

    def __call__(self, rows: Integers) -> Integers:
        """The middle of the vertices of each row, shape (n,); -1 where there is none."""
        size = rows.shape[1]
        if size == 1:
            return rows[:, 0]
        keys = self._keys.get(size)
        if keys is None or not len(keys):
            return np.full(len(rows), -1)
        wanted = _keys(rows)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[place] == wanted, place + self._first[size], -1)


def _keys(rows: Integers) -> npt.NDArray[np.generic]:
    """Rows of vertices, in whatever order, as one value each that sorts as the sorted rows do."""
    rows = np.sort(rows, axis=1)
    if rows.shape[1] == 2:
        return np.asarray(rows[:, 0] << 32 | rows[:, 1])
    return np.ascontiguousarray(rows, dtype=">i8").view(f"V{8 * rows.shape[1]}").ravel()


def _refined(raw: RawMesh) -> RawMesh:
    d = raw.points.shape[1]
    cells, middles = _simplices(raw) if raw.simplicial else _grid_cells(raw)
    listed = any(0 in group.entities for group in raw.groups.values())
    skin = boundary_facets(raw) if listed else None
    groups = {key: Group(_handed_on(g, middles, d, skin)) for key, g in raw.groups.items()}
    return RawMesh(raw.kind, middles.points, cells, np.repeat(raw.tags, 2**d), groups)


def _simplices(raw: RawMesh) -> tuple[Integers, _Middles]:
    d = raw.points.shape[1]
    pairs = list(combinations(range(d + 1), 2))
    middles = _Middles(raw.points, [np.concatenate([raw.cells[:, pair] for pair in pairs])])
    at = {(i, i): raw.cells[:, i] for i in range(d + 1)}
    at |= {pair: middles(raw.cells[:, pair]) for pair in pairs}
    if d == 2:
        children = [np.stack([at[pair] for pair in child], axis=1) for child in _TRIANGLE]
        return np.stack(children, axis=1).reshape(-1, 3), middles
    children = [np.stack([at[pair] for pair in child], axis=1) for child in _TIPS]
    inner = np.empty((len(raw.cells), 4, 4), dtype=np.int64)
    shortest = _shortest_diagonals(middles.points, at)
    for k, (start, stop, ring) in enumerate(_DIAGONALS):
        chosen = shortest == k
        for i in range(4):
            corners = (start, stop, ring[i], ring[(i + 1) % 4])
            inner[chosen, i] = np.stack([at[pair][chosen] for pair in corners], axis=1)
    whole = np.concatenate([np.stack(children, axis=1), inner], axis=1)
    return whole.reshape(-1, 4), middles


def _shortest_diagonals(
    points: npt.NDArray[np.float64], at: Mapping[tuple[int, int], Integers]
) -> npt.NDArray[np.intp]:
    """Which of the three diagonals to cut each octahedron along.

    Of several that are shortest the one along (1, 1, 1) most: in a box of six tetrahedra around
    such a diagonal, that gives the box of half the mesh size.
    """
    vectors = np.stack([points[at[b]] - points[at[a]] for a, b, _ in _DIAGONALS], axis=1)
    lengths = np.linalg.norm(vectors, axis=2)
    equal = lengths <= (1.0 + _EQUAL) * lengths.min(axis=1, keepdims=True)
    return np.where(equal, np.abs(vectors.sum(axis=2)), -1.0).argmax(axis=1)


def _grid_children(d: int) -> list[list[tuple[int, ...]]]:
    """Children of a grid cell; a vertex of one is the middle of a set of vertices.

    Vertices count in binary, an axis a digit. Vertex v of the child at vertex c lies between those
    that agree with c along the axes along which v does.
    """
    every = range(2**d)
    return [[tuple(w for w in every if not (w ^ c) & ~(v ^ c)) for v in every] for c in every]


def _grid_cells(raw: RawMesh) -> tuple[Integers, _Middles]:
    d = raw.points.shape[1]
    children = _grid_children(d)
    parents = sorted({parent for child in children for parent in child})
    sets = [
        np.concatenate([raw.cells[:, p] for p in parents if len(p) == size])
        for size in (2, 4, 8)[:d]
    ]
    middles = _Middles(raw.points, sets)
    at = {parent: middles(raw.cells[:, parent]) for parent in parents}
    cells = [np.stack([at[parent] for parent in child], axis=1) for child in children]
    return np.stack(cells, axis=1).reshape(-1, 2**d), middles


def _handed_on(
    group: Group, middles: _Middles, d: int, skin: Integers | None
) -> dict[int, Integers]:
    """The entities of a group after refinement; `skin` has the facets of the boundary."""
    entities = {}
    for dim, rows in group.entities.items():
        if dim == d:
            entities[dim] = (rows[:, None] * 2**d + np.arange(2**d)).ravel()
        elif dim == 0:
            entities[dim] = np.union1d(rows, _between(rows, middles, skin))
        else:
            entities[dim] = _parts(rows, middles)
    return entities


def _between(vertices: Integers, middles: _Middles, skin: Integers | None) -> Integers:
    """The middles between the vertices of a group, as `Body.dofs` understands these."""
    if skin is not None and np.isin(vertices, skin).all():
        facets = skin[np.isin(skin, vertices).all(axis=1)]
        if len(facets):
            size = facets.shape[1]
            ring = facets if size < 4 else facets[:, VTK_ORDER[CellType.quadrilateral]]
            edges = [ring[:, [i, (i + 1) % size]] for i in range(size if size > 2 else 1)]
            found = [middles(edge) for edge in edges] + [middles(facets)] * (size == 4)
            return np.unique(np.concatenate(found))
    return middles.within(vertices)


def _parts(rows: Integers, middles: _Middles) -> Integers:
    """Parts of edges and facets, of which those go that are of no cell."""
    size = rows.shape[1]
    edges = [rows[:, [i, (i + 1) % size]] for i in range(size if size > 2 else 1)]
    half = [middles(edge) for edge in edges]
    parts: list[tuple[Integers, ...]]
    if size == 2:
        parts = [(rows[:, 0], half[0]), (half[0], rows[:, 1])]
    elif size == 3:
        tips = [(rows[:, i], half[i], half[i - 1]) for i in range(3)]
        parts = [*tips, (half[0], half[1], half[2])]
    else:
        centre = middles(rows)
        parts = [(rows[:, i], half[i], centre, half[i - 1]) for i in range(4)]
    whole = np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, size)
    return whole[(whole >= 0).all(axis=1)]
