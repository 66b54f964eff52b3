"""Where cell-local quantities live: on the cell for P1 simplices, else at quadrature points.

On triangles and tetrahedra with P1 displacements F is constant on each cell, and so are S, Λ and R.
With any other element F varies, and they live at the points of the quadrature rule that integrates
the strain energy: a point is to a rule what a cell is to P1. The constraint S = S(F) then holds at
each point, and a mixed formulation has the positions of the displacement method with that rule.
"""

from __future__ import annotations

from collections.abc import Iterable

import basix.ufl
import ufl
from dolfinx import fem, mesh
from ufl.algorithms import extract_coefficients

from forms.spaces import function_space

CELLS = {
    2: (mesh.CellType.triangle, mesh.CellType.quadrilateral),
    3: (mesh.CellType.tetrahedron, mesh.CellType.hexahedron),
}
"""Supported cells by dimension, simplices first."""


def quadrature_degree(V: fem.FunctionSpace) -> int:
    """Degree of the rule for the strain energy of a displacement in V; 0 where F is constant.

    On simplices Pk has 2 (k - 1), which integrates a quadratic energy exactly; quadrilaterals and
    hexahedra with Qk have k + 1 Gauss points in each direction.

    Args:
        V: A Lagrange space, or one of quadrature points, which has their degree.
    """
    element = V.ufl_element()
    if element.has_custom_quadrature:
        return int(element.embedded_superdegree)
    if V.element.basix_element.discontinuous:
        return 0
    return rule_degree(V.mesh, int(V.element.basix_element.degree))


def rule_degree(msh: mesh.Mesh, k: int) -> int:
    """Degree of the rule for the strain energy of displacements of degree k."""
    return 2 * (k - 1) if is_simplicial(msh) else 2 * k


def is_simplicial(msh: mesh.Mesh) -> bool:
    """Whether the cells are triangles or tetrahedra."""
    return bool(msh.topology.cell_type == CELLS[msh.topology.dim][0])


def measure(u: fem.Function) -> ufl.Measure:
    """Return the measure dx for an energy density without inertia.

    Its rule is that of the points at which the cell-local fields live. Inertia is integrated with
    plain `ufl.dx`; with P1 displacements on simplices that is this measure, too.

    Args:
        u: Displacement.
    """
    degree = quadrature_degree(u.function_space)
    return ufl.dx(metadata={"quadrature_degree": degree}) if degree else ufl.dx


def require_measure(energy: ufl.Form) -> None:
    """Insist that what lives at quadrature points is integrated with their rule.

    The form compiler would go by the points whatever rule an integral states, for all of its terms,
    and so integrate inertia with a rule that is too coarse for it.

    Raises:
        ValueError: An integral has another rule than the points of one of its coefficients, or is
            over facets.
    """
    for integral in energy.integrals():
        for f in extract_coefficients(integral.integrand()):
            element = f.ufl_element()
            if element.has_custom_quadrature and (
                integral.integral_type() != "cell"
                or integral.metadata() != {"quadrature_degree": element.embedded_superdegree}
            ):
                raise ValueError(
                    f"the energy integrates {f.name}, which lives at quadrature points, with "
                    "another rule than theirs; multiply its density by forms.measure(u), and "
                    "inertia and loads by ufl.dx"
                )


def local_space(
    msh: mesh.Mesh, degree: int, shape: tuple[int, ...] = (), *, symmetric: bool = False
) -> fem.FunctionSpace:
    """Return the space of cell-local fields, with one value a cell or one a quadrature point.

    Args:
        msh: The mesh.
        degree: From `quadrature_degree`.
        shape: Of a value.
        symmetric: Whether it is a symmetric tensor, of which the lower triangle is kept.
    """
    if degree == 0:
        return function_space(msh, ("DG", 0, shape, True) if symmetric else ("DG", 0, shape))
    element = basix.ufl.quadrature_element(
        msh.basix_cell(), value_shape=shape, degree=degree, symmetry=symmetric or None
    )
    return function_space(msh, element)


def common_degree(coefficients: Iterable[fem.Function]) -> int:
    """Degree of the rule at whose points an expression of the coefficients is to be known."""
    return max((quadrature_degree(c.function_space) for c in coefficients), default=0)
