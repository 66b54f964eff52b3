"""Named geometries, meshed by gmsh when they are asked for."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

from meshes.body import Body
from meshes.checks import check
from meshes.errors import MeshError
from meshes.formats.listing import assemble
from meshes.geometries import plane, session, solid
from meshes.raw import RawMesh, make_body


@dataclass(frozen=True)
class Geometry:
    """A shape by name.

    Attributes:
        description: One line: what it is, and its groups.
        d: Its dimension.
        h: Size of an element unless another is asked for [m].
        draw: Draws it and names its groups, given gmsh, h and dimensions of its own.
    """

    description: str
    d: int
    h: float
    draw: Callable[..., None]


GEOMETRIES = {
    "ball": Geometry(
        "an eighth of a hollow ball of radius 1 m, 0.2 m thick; groups: ball, inner, outer",
        *(3, 0.12, solid.ball),
    ),
    "bear": Geometry(
        "a bear 1.3 m tall of spheres and cylinders, on its feet; groups: bear, feet",
        *(3, 0.1, solid.bear),
    ),
    "cooks-membrane": Geometry(
        "Cook's tapered panel, 48 wide, in 2D; groups: membrane, left, right, bottom, top",
        *(2, 2.75, plane.cooks_membrane),
    ),
    "fibre-beam": Geometry(
        "a beam of 4 m × 1 m × 1 m with 4 fibres along it; groups: matrix (1), fibres (2), left, "
        "right",
        *(3, 0.25, solid.fibre_beam),
    ),
    "gear": Geometry(
        "a gear of 12 teeth and radius 1 m about the z axis; groups: gear, bore, teeth, flank",
        *(3, 0.15, solid.gear),
    ),
    "perforated-plate": Geometry(
        "a plate of 4 m × 2 m with 8 holes, in 2D; groups: plate, holes, left, right, bottom, top",
        *(2, 0.15, plane.perforated_plate),
    ),
    "rods": Geometry(
        "three rods of 2 m × 0.2 m × 0.2 m that cross in their middles; groups: rods, ends",
        *(3, 0.1, solid.rods),
    ),
    "strut": Geometry(
        "a round strut 1 m long and 0.05 m thick, bowed by 1 mm; groups: strut, left, right",
        *(3, 0.02, solid.strut),
    ),
}
"""The geometries there are. Add one of your own: a function that draws it with gmsh."""


def geometry(
    comm: MPI.Comm, name: str, h: float | None = None, *, scale: float = 1.0, **dimensions: float
) -> Body:
    """Mesh a named geometry with triangles or tetrahedra. Collective.

    gmsh makes the mesh on rank 0, the same each time; file order is the order that it has.

    Args:
        comm: Communicator over which the mesh is distributed.
        name: A name in `GEOMETRIES`.
        h: Size of an element; by default that of the geometry. Where curves are narrow elements
            are smaller.
        scale: What lengths are multiplied by, h and the dimensions included.
        dimensions: Those of the geometry's function that shall differ.

    Raises:
        MeshError: On all ranks: no such geometry or dimension, one that is not positive, a size
            that would make too many cells, or gmsh is not there.
    """
    if name not in GEOMETRIES:
        raise MeshError(f"geometry {name}: unknown; available: {', '.join(GEOMETRIES)}")
    shape = GEOMETRIES[name]
    size = shape.h if h is None else h
    known = list(inspect.signature(shape.draw).parameters)[2:]
    for key, value in {"h": size, "scale": scale, **dimensions}.items():
        if key not in ("h", "scale", *known):
            raise MeshError(f"geometry {name}: has no {key}; it has {', '.join(['h', *known])}")
        if not (math.isfinite(value) and (value > 0 or (key == "bow" and value >= 0))):
            raise MeshError(f"geometry {name}: {key} must be above 0, not {value}")

    def make() -> RawMesh:
        try:
            with session.model(name, size) as gmsh:
                shape.draw(gmsh, size, **dimensions)
                session.mesh(gmsh, shape.d, size)
                raw = assemble(session.listing(gmsh, shape.d))
            check(raw)
        except MeshError as e:
            raise MeshError(f"geometry {name}: {e}") from e
        raw.points *= scale
        return raw

    return make_body(comm, make)
