"""The Newton system is the exact second derivative of the energy: Taylor tests, rank, scaling."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix, assemble_vector, create_vector

from forms import FORMULATIONS, MATERIALS, BackwardEuler, right_stretch, seed_singular
from solvers import MixedProblem
from tests.states import (
    FIRST_FORMULATIONS,
    FIRST_MATERIALS,
    by_field,
    dense,
    field_vector,
    global_norm,
    random_directions,
    random_values,
    small_mesh,
)

E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4


def build(d, formulation, material, inertia=True, density=None, bcs=()):
    """A problem on a few cells, with its energy."""
    msh = small_mesh(d)
    form = FORMULATIONS[formulation]
    fields = form.fields(msh)
    psi = MATERIALS[material](E, NU)
    energy = (density or form.density)(*fields, psi) * ufl.dx
    if inertia:
        energy += BackwardEuler(fields[0], H, (0.0, -9.81, 1.0)[:d]).kinetic(RHO) * ufl.dx
    return MixedProblem(energy, fields, bcs=bcs), energy


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


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("material", FIRST_MATERIALS)
@pytest.mark.parametrize("formulation", FIRST_FORMULATIONS)
def test_taylor(d, material, formulation):
    """Residual of order 2 in every block, energy of order 3, from a state far from rest."""
    problem, energy = build(d, formulation, material)
    comm = MPI.COMM_WORLD
    for f, change in zip(problem.fields, random_directions(problem.fields, stress=E), strict=True):
        f.x.array[:] += change
    start = [f.x.array.copy() for f in problem.fields]
    directions = random_directions(problem.fields, stress=E, seed=10)
    compiled_energy = fem.form(energy)

    def at(step):
        for f, values, change in zip(problem.fields, start, step, strict=True):
            f.x.array[:] = values + change

    def energy_now():
        problem.refresh()
        return comm.allreduce(fem.assemble_scalar(compiled_energy), op=MPI.SUM)

    r0, A, e0 = residual(problem), jacobian(problem), energy_now()
    w = field_vector(problem, directions)
    slope, curvature = r0.dot(w), w.dot(A * w)
    steps = 2.0 ** -np.arange(2, 7)
    remainders = []
    for eps in steps:
        at([eps * direction for direction in directions])
        remainders.append(abs(energy_now() - e0 - eps * slope - eps**2 / 2 * curvature))
    orders = np.diff(np.log(remainders)) / np.diff(np.log(steps))
    assert orders[-2:].min() > 2.9

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
            assert orders[-2:].min() > 1.9, (problem.fields[i].name, problem.fields[j].name)


@pytest.mark.parametrize("d", [2, 3])
def test_rank_of_the_seeds_matrix(d):
    """Eq. (35) as printed has d(d-1)/2 null vectors a cell at a feasible state; cured, none."""
    material = "stable-neo-hookean"
    singular, _ = build(d, "seed", material, density=seed_singular)
    cured, _ = build(d, "seed", material)
    for problem in (singular, cured):
        u, S, Lam = problem.fields
        u.x.array[:] = 0.06 * random_values(u, 3)
        problem.refresh()
        S.interpolate(
            fem.Expression(right_stretch(u), S.function_space.element.interpolation_points)
        )
        # A feasible multiplier: a first Piola-Kirchhoff stress R Y with Y symmetric.
        psi = MATERIALS[material](E, NU)
        Lam.interpolate(
            fem.Expression(
                FORMULATIONS["displacement"].multiplier(u, psi),
                Lam.function_space.element.interpolation_points,
            )
        )
    cells = small_mesh(d).topology.index_map(d).size_global
    for problem, nullity in ((singular, d * (d - 1) // 2 * cells), (cured, 0)):
        A = dense(jacobian(problem))
        sigma = np.linalg.svd(A, compute_uv=False)
        assert np.count_nonzero(sigma < 1e-11 * sigma[0]) == nullity
        assert np.count_nonzero(sigma < 1e-5 * sigma[0]) == nullity


def test_multiplier_is_scaled_by_a_stress():
    """The equilibrated unit of Y over that of S follows Young's modulus over nine decades."""
    ratios = []
    for modulus in (1e3, 1e12):
        msh = small_mesh(3)
        u, S, Y = fields = FORMULATIONS["symmetric"].fields(msh)
        psi = MATERIALS["corotational"](modulus, NU)
        problem = MixedProblem(
            FORMULATIONS["symmetric"].density(u, S, Y, psi) * ufl.dx
            + BackwardEuler(u, H).kinetic(RHO) * ufl.dx,
            fields,
        )
        problem.solve()
        ratios.append(problem.scales[2] / problem.scales[1] / psi.mu)
    assert ratios[0] == pytest.approx(ratios[1], rel=1e-6)
    assert 0.1 < ratios[0] < 10.0
