"""Taylor tests of a Newton system."""

from __future__ import annotations

from collections.abc import Collection

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix, assemble_vector, create_vector

from solvers import MixedProblem
from tests.states import by_field, field_vector, global_norm, random_directions


def residual(problem):
    """The unscaled residual at the current fields."""
    problem.refresh()
    b = create_vector([f.function_space for f in problem.fields], kind="mpi")
    assemble_vector(b, problem.problem.F)
    b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
    return b


def jacobian(problem):
    """The unscaled Jacobian at the current fields."""
    problem.refresh()
    A = assemble_matrix(problem.problem.J, kind="mpi")
    A.assemble()
    return A


def check_taylor_orders(
    problem: MixedProblem,
    energy: fem.Form,
    stress: float,
    inexact: Collection[tuple[str, str]] = (),
) -> None:
    """From the present fields: residual of order 2 in every block, energy of order 3.

    The blocks named in `inexact`, by the fields of their row and column, must be of order 1, for
    want of a derivative; the energy is then left alone.
    """
    comm = MPI.COMM_WORLD
    start = [f.x.array.copy() for f in problem.fields]
    directions = random_directions(problem.fields, stress=stress, seed=10)

    def at(step):
        for f, values, change in zip(problem.fields, start, step, strict=True):
            f.x.array[:] = values + change

    def energy_now():
        problem.refresh()
        return comm.allreduce(fem.assemble_scalar(energy), op=MPI.SUM)

    r0, A, e0 = residual(problem), jacobian(problem), energy_now()
    w = field_vector(problem, directions)
    slope, curvature = r0.dot(w), w.dot(A * w)
    steps = 2.0 ** -np.arange(5, 10)
    remainders = []
    for eps in steps:
        at([eps * direction for direction in directions])
        remainders.append(abs(energy_now() - e0 - eps * slope - eps**2 / 2 * curvature))
    orders = np.diff(np.log(remainders)) / np.diff(np.log(steps))
    assert inexact or orders[-2:].min() > 2.9

    for j in range(len(problem.fields)):
        only_j = [v * (k == j) for k, v in enumerate(directions)]
        linear = by_field(problem, A * field_vector(problem, only_j))
        differences = []
        for eps in steps:
            at([eps * change for change in only_j])
            change = by_field(problem, residual(problem) - r0)
            differences.append([c - eps * s for c, s in zip(change, linear, strict=True)])
        for i in range(len(problem.fields)):
            norms = np.array([global_norm(comm, parts[i]) for parts in differences])
            size = max(global_norm(comm, by_field(problem, r0)[i]), global_norm(comm, linear[i]))
            if norms[0] < 1e-12 * size:  # a block that is linear, or zero
                continue
            orders = np.diff(np.log(norms)) / np.diff(np.log(steps))
            block = problem.fields[i].name, problem.fields[j].name
            if block in inexact:
                assert np.abs(orders[-2:] - 1.0).max() < 0.1, block
            else:
                assert orders[-2:].min() > 1.9, block
    at([0.0 * change for change in directions])
