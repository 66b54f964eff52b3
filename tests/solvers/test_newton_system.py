"""The Newton system is the exact second derivative of the energy: Taylor tests, rank, scaling."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import (
    FORMULATIONS,
    MATERIALS,
    BackwardEuler,
    deformation_gradient,
    right_stretch,
    seed_singular,
)
from solvers import MixedProblem
from tests.states import (
    FIRST,
    dense,
    random_directions,
    random_values,
    small_mesh,
)
from tests.taylor import check_taylor_orders, jacobian

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
    return MixedProblem(energy, fields, bcs=bcs, solver="direct"), energy


@pytest.mark.serial
@pytest.mark.parametrize(("d", "formulation", "material"), FIRST)
def test_taylor(d, formulation, material):
    """Residual of order 2 in every block, energy of order 3, from a state far from rest."""
    problem, energy = build(d, formulation, material)
    for f, change in zip(problem.fields, random_directions(problem.fields, stress=E), strict=True):
        f.x.array[:] += change
    check_taylor_orders(problem, fem.form(energy), stress=E)


@pytest.mark.serial
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
            fem.Expression(
                right_stretch(deformation_gradient(u)),
                S.function_space.element.interpolation_points,
            )
        )
        # A feasible multiplier: a first Piola-Kirchhoff stress R Y with Y symmetric.
        psi = MATERIALS[material](E, NU)
        Lam.interpolate(
            fem.Expression(
                FORMULATIONS["displacement"].stress(u, psi),
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
