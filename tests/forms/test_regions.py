"""Different materials in different cells."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    FORMULATIONS,
    BackwardEuler,
    Corotational,
    Hencky,
    MooneyRivlin,
    NeoHookean,
    StableNeoHookean,
    by_tag,
    cell_values,
    mixed_fields,
    refresh,
)
from solvers import MixedProblem, march

COMM = MPI.COMM_WORLD
LEFT, RIGHT = 3, 8  # tags, far from 0 and 1 on purpose


def two_halves(cells=(8, 4)):
    """A bar of 2 m by 1 m whose cells with x < 1 are tagged 3, the others 8."""
    msh = mesh.create_rectangle(COMM, [(0.0, 0.0), (2.0, 1.0)], cells)
    index_map = msh.topology.index_map(2)
    every = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    left = mesh.compute_midpoints(msh, 2, every)[:, 0] < 1.0
    return msh, mesh.meshtags(msh, 2, every, np.where(left, LEFT, RIGHT).astype(np.int32)), left


def own(S):
    """A user's own function of S."""
    strain = S - ufl.Identity(2)
    return 5.0 * ufl.inner(strain, strain)


@pytest.mark.parametrize(
    "pair",
    [
        (Corotational(1e14, 0.3), Corotational(6e4, 0.45)),
        (MooneyRivlin(2.0, 0.3, m=0.1), MooneyRivlin(2.0, 0.3, m=0.9)),
        (StableNeoHookean(1e14, 0.3), Hencky(6e4, 0.45)),
        (own, NeoHookean(7.0, 0.2)),
    ],
    ids=["parameters", "further parameters", "laws", "own"],
)
def test_each_cell_has_its_own_energy_and_stress(pair):
    """Ψ and ∂Ψ are those of the cell's material, wherever the other one's S may be."""
    msh, tags, left = two_halves((2, 1))
    _, S, D = mixed_fields(msh)
    psi = by_tag(msh, tags, dict(zip((LEFT, RIGHT), pair, strict=True)))
    terms = [term for law in (psi, *pair) for term in (law(S), ufl.derivative(law(S), S, D))]
    D.interpolate(lambda X: np.tile([[0.1], [0.3], [0.3], [-0.2]], X.shape[1]))
    S.interpolate(lambda X: np.array([1.1 + 0.1 * X[1], 0.1 * X[0], 0.1 * X[0], 0.9 + 0 * X[0]]))
    evaluate = fem.Expression(ufl.as_vector(terms), np.array([[1 / 3, 1 / 3]]))
    refresh(terms)
    values = evaluate.eval(msh, np.arange(len(left), dtype=np.int32))[:, 0]
    expected = np.where(left[:, None], values[:, 2:4], values[:, 4:6])
    np.testing.assert_allclose(values[:, :2], expected, rtol=1e-12)


def test_no_law_sees_the_stretch_of_anothers_cells():
    """Neo-Hookean's ln J has no value for the det S < 0 of corotational cells."""
    msh, tags, left = two_halves((2, 1))
    _, S, _ = mixed_fields(msh)
    psi = by_tag(msh, tags, {LEFT: Corotational(1.0, 0.3), RIGHT: NeoHookean(1.0, 0.3)})
    S.x.array[:] = np.where(left[:, None], [-1.0, 0.0, 1.0], [1.2, 0.1, 1.0]).ravel()
    energy = fem.assemble_scalar(fem.form(psi(S) * ufl.dx))
    assert np.isfinite(energy)


@pytest.mark.parametrize(
    ("formulation", "solver"), [("symmetric", "direct"), ("seed", "condensed")]
)
def test_a_contrast_of_1e14_to_6e4(formulation, solver):
    """The stiff half moves as a rigid one does, and the soft half as if clamped to it."""
    displacements = []
    for rigid in (False, True):
        msh, tags, _ = two_halves()
        psi = by_tag(msh, tags, {LEFT: Corotational(1e14, 0.3), RIGHT: Hencky(6e4, 0.45)})
        rho = cell_values(msh, tags, {LEFT: 7800.0, RIGHT: 1000.0})
        form = FORMULATIONS[formulation]
        fields = form.fields(msh)
        u = fields[0]
        scheme = BackwardEuler(u, 0.1, (0.0, -9.81))
        energy = form.density(*fields, psi) * ufl.dx + scheme.kinetic(rho) * ufl.dx
        end = 1.0 if rigid else 0.0
        clamped = fem.locate_dofs_geometrical(
            u.function_space, lambda X, end=end: X[0] < end + 1e-6
        )
        bc = fem.dirichletbc(np.zeros(2), clamped, u.function_space)
        problem = MixedProblem(energy, fields, [bc], solver=solver)
        assert all(result.iterations <= 6 for result in march(problem, scheme, 3))
        displacements.append(u.x.array)
    difference = np.abs(displacements[0] - displacements[1]).max(initial=0.0)
    assert COMM.allreduce(difference, op=MPI.MAX) < 1e-7
    assert COMM.allreduce(np.abs(displacements[0]).max(initial=0.0), op=MPI.MAX) > 0.3


def test_a_cell_without_a_material_is_named():
    msh, tags, left = two_halves((2, 1))
    message = r"cells tagged \[8\] are given nothing; the tags given are \[3\]"
    with pytest.raises(ValueError, match=message):
        cell_values(msh, tags, {LEFT: 1.0})
    with pytest.raises(ValueError, match=message):
        by_tag(msh, tags, {LEFT: own})
    some = mesh.meshtags(msh, 2, np.flatnonzero(left).astype(np.int32), LEFT)
    with pytest.raises(ValueError, match="some cells have no tag"):
        cell_values(msh, some, {LEFT: 1.0})
