"""Geometries in 2D."""

from __future__ import annotations

from math import ceil
from typing import Any

from meshes.geometries.session import name_group

# Corners of Cook's panel, counter-clockwise, in the units of its publications.
COOK = ((0.0, 0.0), (48.0, 44.0), (48.0, 60.0), (0.0, 44.0))


def perforated_plate(
    gmsh: Any, h: float, columns: int = 4, rows: int = 2, radius: float = 0.25
) -> None:
    """Unit squares in columns and rows, each with a hole in its middle.

    Groups: "plate"; of facets "left", "right", "bottom", "top", "holes".
    """
    occ = gmsh.model.occ
    plate = occ.addRectangle(0.0, 0.0, 0.0, float(columns), float(rows))
    holes = [
        (2, occ.addDisk(i + 0.5, j + 0.5, 0.0, radius, radius))
        for i in range(columns)
        for j in range(rows)
    ]
    occ.cut([(2, plate)], holes)
    occ.synchronize()
    name_group(gmsh, 2, "plate", lambda x, y, z: True)
    sides = {
        "left": lambda x, y, z: x < 1e-6,
        "right": lambda x, y, z: x > columns - 1e-6,
        "bottom": lambda x, y, z: y < 1e-6,
        "top": lambda x, y, z: y > rows - 1e-6,
    }
    for name, inside in sides.items():
        name_group(gmsh, 1, name, inside)
    name_group(gmsh, 1, "holes", lambda *X: not any(inside(*X) for inside in sides.values()))


def cooks_membrane(gmsh: Any, h: float) -> None:
    """Cook's panel, its left side 44 long and the right one 16, cut into n × n × 2 triangles.

    n is 44 / h, rounded up; with an even n the middle of the right side is a vertex. Coordinates
    are those of R. D. Cook, J. Struct. Div. ASCE 100 (1974) 1851-1863; with `scale = 0.001` they
    are millimetres. Groups: "membrane"; of facets "left", "right", "bottom", "top".
    """
    occ = gmsh.model.occ
    corners = [occ.addPoint(x, y, 0.0) for x, y in COOK]
    sides = [occ.addLine(corners[i], corners[(i + 1) % 4]) for i in range(4)]
    surface = occ.addPlaneSurface([occ.addCurveLoop(sides)])
    occ.synchronize()
    for side in sides:
        gmsh.model.mesh.setTransfiniteCurve(side, 1 + ceil(COOK[3][1] / h - 1e-9))
    gmsh.model.mesh.setTransfiniteSurface(surface)
    gmsh.model.addPhysicalGroup(2, [surface], name="membrane")
    for side, name in zip(sides, ("bottom", "right", "top", "left"), strict=True):
        gmsh.model.addPhysicalGroup(1, [side], name=name)
