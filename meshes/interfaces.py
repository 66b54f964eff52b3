"""Where cells of a mesh touch without sharing vertices: interfaces not merged, hanging nodes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from meshes.checks import Problem
from meshes.groups import Integers
from meshes.parts import joined
from meshes.quality import Reals, edge_lengths
from meshes.raw import RawMesh
from meshes.topology import all_facets, boundary_facets, neighbours

# Vertices closer than this fraction of the largest extent are in the same place, unless the cells
# there are hardly larger.
_COINCIDENT = 1e-6
_OF_CELL = 1e-2
# Facets flatter than this have no inside, and this fraction beyond an edge is still inside.
_FLAT = 1e-6
_EDGE = 1e-6


def doubtful(raw: RawMesh) -> Iterator[Problem]:
    """What is probably wrong with a mesh that passes `meshes.checks`, and does not show itself."""
    d = raw.points.shape[1]
    _, part = joined(raw.cells, len(raw.points))
    of_cells, first = np.unique(part[raw.cells[:, 0]], return_index=True)
    count = len(of_cells)  # a vertex without a cell is a set by itself
    if count > 1:
        said = f"the cells are in {count} parts that share no vertex"
        yield Problem("several parts", said, "cells", np.sort(first), fatal=False)
    facets = boundary_facets(raw)
    tolerance = _tolerances(raw)
    twins = _twins(raw, np.unique(facets), tolerance)
    for apart, name, said in (
        (True, "unmerged interface", "are in the same places as vertices of another part"),
        (False, "double vertices", "are in the same places as others of their part (a slit)"),
    ):
        chosen = np.unique(twins[(part[twins[:, 0]] != part[twins[:, 1]]) == apart])
        if len(chosen):
            said = f"{len(chosen)} vertices {said}: vertex {chosen[0]} (from 0) is the first"
            yield Problem(name, said, "vertices", chosen, fatal=False)
    on, of = _resting(raw, facets, tolerance)
    for apart, name, said in (
        (True, "unmerged interface", "on facets of another part"),
        (False, "hanging nodes", "inside facets of cells that do not have them (hanging nodes)"),
    ):
        chosen = np.unique(on[(part[on] != part[of]) == apart])
        if len(chosen):
            noun = "vertices lie" if len(chosen) > 1 else "vertex lies"
            said = f"{len(chosen)} {noun} {said}: the first is vertex {chosen[0]} (from 0)"
            yield Problem(name, said, "vertices", chosen, fatal=False)
    by_facets, _ = joined(neighbours(raw), len(raw.cells))
    if by_facets > count:
        said = (
            f"{by_facets} parts hang together by single vertices{' or edges' * (d == 3)}, which "
            "are hinges"
        )
        yield Problem("hinges", said, "cells", np.empty(0, dtype=np.int64), fatal=False)
    yield from _strays(raw)


def _strays(raw: RawMesh) -> Iterator[Problem]:
    """Groups with facets that no cell has, which a clause would pass over."""
    d = raw.points.shape[1]
    rows = np.sort(all_facets(raw)[0], axis=1)
    for key, group in raw.groups.items():
        tagged = group.entities.get(d - 1)
        if tagged is None:
            continue
        near = rows[np.isin(rows, tagged).all(axis=1)]
        both = np.concatenate([near, np.sort(tagged, axis=1)])
        _, place = np.unique(both, axis=0, return_inverse=True)
        place = place.ravel()
        lost = np.unique(tagged[~np.isin(place[len(near) :], place[: len(near)])])
        if len(lost):
            said = f"the tag {key} is on facets that no cell has"
            yield Problem("tagged facets of no cell", said, "vertices", lost, fatal=False)


def _tolerances(raw: RawMesh) -> Reals:
    """For each vertex, the distance within which others are in its place."""
    shortest = np.full(len(raw.points), np.inf)
    np.minimum.at(shortest, raw.cells, edge_lengths(raw).min(axis=1)[:, None])
    wide = _COINCIDENT * float(np.ptp(raw.points, axis=0).max())
    return np.asarray(np.minimum(wide, _OF_CELL * shortest))


def _twins(raw: RawMesh, vertices: Integers, tolerance: Reals) -> Integers:
    """Pairs of vertices in one place, shape (pairs, 2)."""
    pairs = scipy.spatial.cKDTree(raw.points[vertices]).query_pairs(
        float(tolerance.max()), output_type="ndarray"
    )
    pairs = vertices[pairs.reshape(-1, 2)]
    distance = np.linalg.norm(raw.points[pairs[:, 0]] - raw.points[pairs[:, 1]], axis=1)
    return np.asarray(pairs[distance <= tolerance[pairs].min(axis=1)])


def _resting(raw: RawMesh, facets: Integers, tolerance: Reals) -> tuple[Integers, Integers]:
    """Vertices of the boundary on facets that do not have them, and a vertex of each facet."""
    points, d = raw.points, raw.points.shape[1]
    vertices = np.unique(facets)
    if facets.shape[1] == 4:  # in DOLFINx's order both triangles have the diagonal 1, 2
        facets = np.concatenate([facets[:, :3], facets[:, [3, 1, 2]]])
    edges = points[facets[:, 1:]] - points[facets[:, :1]]
    size = np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0)
    gram = np.einsum("nik,njk->nij", edges, edges)
    sound = np.linalg.det(gram) > (_FLAT * size) ** (2 * (d - 1))
    facets, edges, gram, size = (a[sound] for a in (facets, edges, gram, size))
    near = scipy.spatial.cKDTree(points[vertices]).query_ball_point(
        points[facets].mean(axis=1), size
    )
    facet = np.repeat(np.arange(len(facets)), [len(n) for n in near])
    vertex = vertices[np.array([v for n in near for v in n], dtype=np.int64)]
    # Not its own vertices, nor those in their places, which are twins.
    slack = tolerance[vertex]
    away = np.linalg.norm(points[vertex][:, None] - points[facets[facet]], axis=2)
    others = (away > slack[:, None]).all(axis=1)
    facet, vertex, slack = facet[others], vertex[others], slack[others]
    to = points[vertex] - points[facets[facet, 0]]
    right = np.einsum("nik,nk->ni", edges[facet], to)
    share = np.linalg.solve(gram[facet], right[..., None])[..., 0]
    distance = np.linalg.norm(to - np.einsum("ni,nik->nk", share, edges[facet]), axis=1)
    inside = (share > -_EDGE).all(axis=1) & (share.sum(axis=1) < 1.0 + _EDGE)
    hits = inside & (distance <= slack)
    return vertex[hits], facets[facet[hits], 0]
