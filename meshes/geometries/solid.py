"""Geometries in 3D."""

from __future__ import annotations

import math
from typing import Any

from meshes.errors import MeshError
from meshes.geometries.session import mesh, name_group

# What the bear is made of [m]: spheres by centre and radius, cylinders by the centre of one end,
# the vector to the other, and radius. It stands on y = 0 and looks along z.
BEAR_SPHERES = (
    ((0.0, 0.55, 0.0), 0.32),  # trunk
    ((0.0, 1.0, 0.02), 0.23),  # head
    ((-0.16, 1.19, 0.0), 0.09),  # ears
    ((0.16, 1.19, 0.0), 0.09),
    ((-0.5, 0.68, 0.16), 0.1),  # paws
    ((0.5, 0.68, 0.16), 0.1),
)
BEAR_CYLINDERS = (
    ((0.0, 0.94, 0.1), (0.0, 0.0, 0.24), 0.09),  # snout
    ((-0.15, 0.72, 0.0), (-0.35, -0.04, 0.16), 0.085),  # arms
    ((0.15, 0.72, 0.0), (0.35, -0.04, 0.16), 0.085),
    ((-0.17, 0.0, 0.03), (0.0, 0.5, 0.0), 0.12),  # legs
    ((0.17, 0.0, 0.03), (0.0, 0.5, 0.0), 0.12),
)


def fibre_beam(
    gmsh: Any,
    h: float,
    length: float = 4.0,
    width: float = 1.0,
    fibres: int = 2,
    radius: float = 0.15,
) -> None:
    """A beam along x of square section with fibres × fibres round fibres along it.

    Groups: "matrix" (1) and "fibres" (2); of facets "left" and "right", the ends.
    """
    occ = gmsh.model.occ
    box = occ.addBox(0.0, 0.0, 0.0, length, width, width)
    step = width / fibres
    rods = [
        (3, occ.addCylinder(0.0, (i + 0.5) * step, (j + 0.5) * step, length, 0.0, 0.0, radius))
        for i in range(fibres)
        for j in range(fibres)
    ]
    if 2.0 * radius >= step:
        raise MeshError(f"radius = {radius:g}: {fibres} fibres do not fit into {width:g} m")
    _, origins = occ.fragment([(3, box)], rods)
    occ.synchronize()
    inside = sorted({tag for pieces in origins[1:] for _, tag in pieces})
    outside = sorted({tag for _, tag in origins[0]} - set(inside))
    gmsh.model.addPhysicalGroup(3, outside, 1, "matrix")
    gmsh.model.addPhysicalGroup(3, inside, 2, "fibres")
    name_group(gmsh, 2, "left", lambda x, y, z: x < 1e-6 * length)
    name_group(gmsh, 2, "right", lambda x, y, z: x > (1.0 - 1e-6) * length)


def strut(
    gmsh: Any, h: float, length: float = 1.0, radius: float = 0.025, bow: float = 0.001
) -> None:
    """A slender round strut along x, bowed in y by half a sine wave of amplitude bow · length.

    Groups: "strut"; of facets "left" and "right", the ends.
    """
    gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", 20.0)  # the bending stiffness goes with r⁴
    occ = gmsh.model.occ
    occ.addCylinder(0.0, 0.0, 0.0, length, 0.0, 0.0, radius)
    occ.synchronize()
    name_group(gmsh, 3, "strut", lambda x, y, z: True)
    name_group(gmsh, 2, "left", lambda x, y, z: x < 1e-6 * length)
    name_group(gmsh, 2, "right", lambda x, y, z: x > (1.0 - 1e-6) * length)
    mesh(gmsh, 3, h)
    numbers, points, _ = gmsh.model.mesh.getNodes()
    for number, x in zip(numbers, points.reshape(-1, 3), strict=True):
        lift = bow * length * math.sin(math.pi * x[0] / length)
        gmsh.model.mesh.setNode(number, (x[0], x[1] + lift, x[2]), [])


def gear_profile(teeth: int, root: float, tip: float) -> list[tuple[float, float]]:
    """Corners of a gear with straight flanks, counter-clockwise, four a tooth.

    A tooth takes half of its share of the turn at the root, a fifth of it at the tip. Tooth 0
    points along x.
    """
    share = 2.0 * math.pi / teeth
    return [
        (r * math.cos((k + at) * share), r * math.sin((k + at) * share))
        for k in range(teeth)
        for r, at in ((root, -0.25), (tip, -0.1), (tip, 0.1), (root, 0.25))
    ]


def gear(
    gmsh: Any,
    h: float,
    teeth: int = 12,
    root: float = 0.8,
    tip: float = 1.0,
    bore: float = 0.3,
    thickness: float = 0.25,
) -> None:
    """A spur gear about the z axis with straight flanks and a bore.

    Groups: "gear"; of facets "bore", "teeth" (flanks, tips and roots) and "flank", one flank of
    the tooth that points along x, on which another gear would push it to turn clockwise.
    """
    if not bore < root < tip:
        raise MeshError(f"bore, root, tip = {bore:g}, {root:g}, {tip:g}: each must exceed the last")
    occ = gmsh.model.occ
    corners = [occ.addPoint(x, y, 0.0) for x, y in gear_profile(teeth, root, tip)]
    sides = [occ.addLine(a, b) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
    hole = occ.addCircle(0.0, 0.0, 0.0, bore)
    outline, inline = occ.addCurveLoop(sides), occ.addCurveLoop([hole])
    occ.extrude([(2, occ.addPlaneSurface([outline, inline]))], 0.0, 0.0, thickness)
    occ.synchronize()
    nearest = (bore + root * math.cos(math.pi / teeth)) / 2.0  # between the bore and the roots

    def upright(z: float) -> bool:
        return abs(z - thickness / 2.0) < 1e-6 * thickness

    share = 2.0 * math.pi / teeth
    flank = [(root * f(0.25 * share) + tip * f(0.1 * share)) / 2.0 for f in (math.cos, math.sin)]
    name_group(gmsh, 3, "gear", lambda x, y, z: True)
    name_group(gmsh, 2, "bore", lambda x, y, z: upright(z) and math.hypot(x, y) < nearest)
    name_group(gmsh, 2, "teeth", lambda x, y, z: upright(z) and math.hypot(x, y) > nearest)
    name_group(
        gmsh,
        2,
        "flank",
        lambda x, y, z: upright(z) and math.hypot(x - flank[0], y - flank[1]) < 1e-6 * tip,
    )


def bear(gmsh: Any, h: float) -> None:
    """A bear 1.3 m tall of spheres and cylinders, which stands on y = 0 and looks along z.

    Groups: "bear"; of facets "feet", the soles.
    """
    occ = gmsh.model.occ
    solids = [(3, occ.addSphere(*centre, radius)) for centre, radius in BEAR_SPHERES]
    solids += [(3, occ.addCylinder(*end, *axis, radius)) for end, axis, radius in BEAR_CYLINDERS]
    occ.fuse(solids[:1], solids[1:])
    occ.synchronize()
    name_group(gmsh, 3, "bear", lambda x, y, z: True)
    name_group(gmsh, 2, "feet", lambda x, y, z: y < 1e-6)


def ball(gmsh: Any, h: float, radius: float = 1.0, inner: float = 0.8) -> None:
    """An eighth of a hollow ball, where x, y and z are positive.

    Groups: "ball"; of facets "inner" and "outer", the round ones.
    """
    if not inner < radius:
        raise MeshError(f"inner = {inner:g}: must be below radius = {radius:g}")
    occ = gmsh.model.occ
    whole, hole = (
        occ.addSphere(0.0, 0.0, 0.0, r, -1, 0.0, math.pi / 2, math.pi / 2) for r in (radius, inner)
    )
    occ.cut([(3, whole)], [(3, hole)])
    occ.synchronize()
    between = (radius + inner) / 2.0 * math.sqrt(0.75)  # so far off is the centre of a round one

    def is_round(x: float, y: float, z: float) -> bool:
        return min(x, y, z) > 1e-6 * radius

    name_group(gmsh, 3, "ball", lambda x, y, z: True)
    name_group(gmsh, 2, "inner", lambda *x: is_round(*x) and math.hypot(*x) < between)
    name_group(gmsh, 2, "outer", lambda *x: is_round(*x) and math.hypot(*x) > between)


def rods(gmsh: Any, h: float, length: float = 2.0, width: float = 0.2) -> None:
    """Three square rods along x, y and z that cross in their middles, at the origin.

    Groups: "rods"; of facets "ends".
    """
    occ = gmsh.model.occ
    boxes = []
    for axis in range(3):
        size = [length if k == axis else width for k in range(3)]
        boxes.append((3, occ.addBox(*(-x / 2.0 for x in size), *size)))
    occ.fuse(boxes[:1], boxes[1:])
    occ.synchronize()
    name_group(gmsh, 3, "rods", lambda x, y, z: True)
    reach = (0.5 - 1e-6) * length
    name_group(gmsh, 2, "ends", lambda x, y, z: max(abs(x), abs(y), abs(z)) > reach)
