"""Displacements of any degree on any cell, with the cell-local fields at quadrature points."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    FORMULATIONS,
    SmithNeoHookean,
    StableNeoHookean,
    deformation_gradient,
    measure,
    mixed_fields,
    polar_rotation,
    quadrature_degree,
    symmetric,
)
from solvers import MixedProblem
from tests.bodies import FORGOTTEN, NU, Body, E, largest
from tests.states import global_norm, random_values, small_mesh
from tests.taylor import check_taylor_orders

COMM = MPI.COMM_WORLD
PSI = StableNeoHookean(E, NU)

# Dimension, degree, simplices or not.
TRIANGLES_2, TRIANGLES_3 = (2, 2, True), (2, 3, True)
QUADS_1, QUADS_2 = (2, 1, False), (2, 2, False)
TETRAHEDRA_2, HEXAHEDRA_1 = (3, 2, True), (3, 1, False)
ELEMENTS = {
    "triangles-2": TRIANGLES_2,
    "triangles-3": TRIANGLES_3,
    "quadrilaterals-1": QUADS_1,
    "quadrilaterals-2": QUADS_2,
    "tetrahedra-2": TETRAHEDRA_2,
    "hexahedra-1": HEXAHEDRA_1,
}


def make(formulation, element, psi=PSI, solvers=("condensed",)):
    d, degree, simplices = ELEMENTS[element]
    return Body(formulation, d, psi, solvers, degree=degree, simplices=simplices)


SERIAL = pytest.mark.serial  # on more ranks it would show nothing that the others do not


@pytest.fixture(scope="module")
def positions():
    """Displacements of the displacement method, integrated with the same rule."""

    class Positions(dict):
        def __missing__(self, element):
            body = make("displacement", element)
            body.solve()
            self[element] = body.fields[0].x.array.copy()
            return self[element]

    return Positions()


EQUIVALENT = [name for name, form in FORMULATIONS.items() if form.equivalent]
# `symmetric` on all elements, the others on one of the two by turns.
SAME = [("symmetric", e) for e in ELEMENTS]
SAME += [
    (f, ("triangles-2", "quadrilaterals-1")[k % 2])
    for k, f in enumerate(EQUIVALENT)
    if f not in ("symmetric", "displacement")
]


@pytest.mark.parametrize(
    ("formulation", "element"),
    [case if case[0] == "symmetric" else pytest.param(*case, marks=SERIAL) for case in SAME],
)
def test_positions_are_those_of_the_displacement_method(positions, formulation, element):
    """To 1e-9, whatever the degree and the cell; and the Newton matrix is exact.

    Which 3D and cubic elements do not tell anew, whose forms are long.
    """
    body = make(formulation, element)
    result = body.solve()
    assert largest(positions[element]) > 0.25
    assert largest(body.fields[0].x.array - positions[element]) < 1e-9
    if body.form.exact:
        assert result.iterations <= 6
    if element in ("tetrahedra-2", "hexahedra-1", "triangles-3"):
        return
    body.start()
    body.move()
    check_taylor_orders(body.assembled, body.energy, E, FORGOTTEN.get(formulation, ()))


@SERIAL
@pytest.mark.parametrize("element", ["triangles-2", "quadrilaterals-1"])
def test_mean_dilatation(element):
    """Taylor orders; the whole system's iterations; at a solution the energy is that of Ψ."""
    body = make("mean-dilatation", element, solvers=("condensed", "direct"))
    reference = body.solve("direct")
    u = body.fields[0].x.array.copy()
    assert largest(u) > 0.25
    result = body.solve()
    assert largest(body.fields[0].x.array - u) < 1e-9
    assert result.iterations == reference.iterations <= 6
    dx = measure(body.fields[0])
    density, elastic = (
        COMM.allreduce(fem.assemble_scalar(fem.form(e * dx)))
        for e in (body.form.density(*body.fields, PSI), PSI(body.form.stretch(*body.fields)))
    )
    assert density == pytest.approx(elastic, rel=1e-9)
    body.start()
    body.move()
    check_taylor_orders(body.assembled, body.energy, E)


@pytest.mark.parametrize("element", ["triangles-2", "quadrilaterals-1"])
def test_condensation_takes_the_steps_of_the_whole_system(element):
    """With several points a cell the residuals of the iterations agree, too."""
    body = make("symmetric", element, solvers=("condensed", "direct", "fieldsplit"))
    reference = body.solve("direct")
    u = body.fields[0].x.array.copy()
    for solver in ("condensed", "fieldsplit"):
        result = body.solve(solver)
        assert largest(body.fields[0].x.array - u) < 1e-9
        for ours, norms in zip(result.norms, reference.norms, strict=False):
            for name, norm in norms.items():
                assert ours[name] == pytest.approx(norm, rel=1e-6, abs=1e-6 * E)


@pytest.mark.parametrize("element", ["triangles-2", "quadrilaterals-1", "tetrahedra-2"])
def test_patch(element):
    """A homogeneous deformation with a large rotation solves the problem of its boundary values."""
    d, degree, simplices = ELEMENTS[element]
    msh = small_mesh(d, simplices=simplices)
    u, S, Y = mixed_fields(msh, degree=degree)
    V = u.function_space
    c, s = np.cos(1.1), np.sin(1.1)
    Q = np.eye(d)
    Q[:2, :2] = [[c, -s], [s, c]]
    stretch = (
        np.eye(d) + 0.1 * np.array([[1.0, 0.5, 0.2], [0.5, -1.0, 0.3], [0.2, 0.3, 0.7]])[:d, :d]
    )
    u.interpolate(lambda X: (Q @ stretch - np.eye(d)) @ X[:d])
    exact = u.x.array.copy()
    msh.topology.create_connectivity(d - 1, d)
    facets = mesh.exterior_facet_indices(msh.topology)
    values = fem.Function(V)
    values.x.array[:] = exact
    bc = fem.dirichletbc(values, fem.locate_dofs_topological(V, d - 1, facets))
    u.x.array[:] += 0.02 * random_values(u, 3)
    problem = MixedProblem(symmetric(u, S, Y, PSI) * measure(u), (u, S, Y), [bc])
    problem.solve()
    assert largest(u.x.array - exact) < 1e-12
    problem.refresh()
    change = S - ufl.as_matrix(stretch)
    error = fem.assemble_scalar(fem.form(ufl.inner(change, change) * measure(u)))
    assert COMM.allreduce(error) < 1e-22
    turn = ufl.as_matrix(Q) - polar_rotation(deformation_gradient(u))
    error = fem.assemble_scalar(fem.form(ufl.inner(turn, turn) * measure(u)))
    assert COMM.allreduce(error) < 1e-22


@pytest.mark.parametrize(
    ("element", "points"),
    [("triangles-2", 3), ("triangles-3", 6), ("quadrilaterals-1", 4), ("tetrahedra-2", 4)],
)
def test_rule_integrates_quadratic_energies(element, points):
    """∫ |∇u|² of a displacement of the element's degree, by as many points as are needed."""
    d, degree, simplices = ELEMENTS[element]
    u, S, _ = mixed_fields(small_mesh(d, simplices=simplices), degree=degree)
    assert S.function_space.dofmap.list.shape[1] == points
    u.x.array[:] = random_values(u, 1)
    F = deformation_gradient(u)
    ours, exact = (
        COMM.allreduce(fem.assemble_scalar(fem.form(ufl.inner(F, F) * dx)))
        for dx in (measure(u), ufl.dx(metadata={"quadrature_degree": 14}))
    )
    # On distorted quadrilaterals the integrand is a fraction, which no rule integrates.
    assert ours == pytest.approx(exact, rel=1e-13 if simplices else 1e-2)
    assert quadrature_degree(S.function_space) == quadrature_degree(u.function_space)


# Volumetric locking


def bent(formulation, degree, simplices, n, nu=0.4999):
    """Tip displacement of a clamped beam of aspect 4 with 4 n × n cells, bent by a dead load."""
    kind = mesh.CellType.triangle if simplices else mesh.CellType.quadrilateral
    msh = mesh.create_rectangle(COMM, [(0.0, 0.0), (4.0, 1.0)], (4 * n, n), kind)
    form = FORMULATIONS[formulation]
    fields = form.fields(msh, degree)
    u = fields[0]
    V = u.function_space
    energy = form.density(*fields, SmithNeoHookean(1.0, nu)) * measure(u)
    energy -= ufl.inner(fem.Constant(msh, (0.0, -6e-4)), u) * ufl.dx
    clamped = fem.locate_dofs_geometrical(V, lambda X: X[0] < 1e-9)
    bc = fem.dirichletbc(np.zeros(2), clamped, V)
    MixedProblem(energy, fields, [bc]).solve()
    tip = fem.locate_dofs_geometrical(V, lambda X: (X[0] > 4 - 1e-9) & (X[1] < 1e-9))
    return COMM.allreduce(float(u.x.array[2 * tip + 1].min(initial=0.0)), op=MPI.MIN)


@SERIAL
@pytest.mark.parametrize(
    ("degree", "simplices", "n", "locked"), [(1, False, 4, 0.15), (2, False, 2, 0.9)]
)
def test_mean_dilatation_does_not_lock(degree, simplices, n, locked):
    """At ν = 0.4999, against cubic triangles: within 2 %, where displacements alone are stiff."""
    reference = bent("mean-dilatation", 3, True, 4)
    assert bent("symmetric", degree, simplices, n) / reference < locked
    assert bent("mean-dilatation", degree, simplices, n) == pytest.approx(reference, rel=0.02)


@SERIAL
def test_mean_dilatation_is_symmetric_on_linear_simplices():
    ours, plain = (bent(f, 1, True, 2) for f in ("mean-dilatation", "symmetric"))
    assert ours == pytest.approx(plain, rel=1e-9)


# What is refused


def test_fields_that_cells_share_are_refused():
    msh = small_mesh(2, simplices=False)
    u, S, Y = mixed_fields(msh)
    with pytest.raises(ValueError, match="degree is 0; a continuous displacement has degree 1"):
        mixed_fields(msh, degree=0)
    shared = fem.Function(fem.functionspace(msh, ("P", 1, (2, 2), True)), name="Y")
    energy = symmetric(u, S, shared, PSI) * measure(u)
    with pytest.raises(ValueError, match="the field Y is not local to cells"):
        MixedProblem(energy, (u, S, shared), engine=False)
    assert global_norm(COMM, Y.x.array) == 0.0


@pytest.mark.parametrize("dx", [ufl.dx, ufl.dx(metadata={"quadrature_degree": 3}), ufl.ds])
def test_other_rules_than_that_of_the_points_are_refused(dx):
    """FFCx would take the points' rule for all terms, too coarse for inertia."""
    fields = u, S, Y = mixed_fields(small_mesh(2), degree=2)
    with pytest.raises(ValueError, match="which lives at quadrature points, with another rule"):
        MixedProblem((symmetric(u, S, Y, PSI) + ufl.inner(u, u)) * dx, fields)
