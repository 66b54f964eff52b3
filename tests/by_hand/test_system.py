"""The hand-derived system against finite differences of its own energy.

The ground truth is the discrete energy (2)/(5). Nothing here uses MPI or UFL: every rank runs the
same.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp

from demos.by_hand import Corotational, SeedSystem, State, SymmetricSystem, solve_kkt
from tests.by_hand.systems import (
    DIMENSIONS,
    FORMULATIONS,
    LAM,
    MU,
    assert_derivative,
    make_mesh,
    make_system,
    random_step,
    relative,
    rotation_matrix,
    sizes,
    split,
)

pytestmark = pytest.mark.serial  # plain NumPy, with the same arrays on all ranks


@DIMENSIONS
@FORMULATIONS
@pytest.mark.parametrize("kind", ["rest", "feasible", "infeasible"])
def test_gradient_and_every_block_by_differences_of_the_energy(d, formulation, kind):
    """Energy (2) → gradient → the nine blocks of (35) with (24)."""
    system = make_system(d, formulation, kind)
    rng = np.random.default_rng(4)

    def moved(step):
        return system.moved(*split(system, step))

    direction = random_step(system)
    assert_derivative(
        lambda step: np.array([moved(step).energy()]),
        np.array([system.gradient() @ direction]),
        direction,
    )
    matrix, _ = system.kkt()
    edges = np.cumsum((0, *sizes(system)))
    for column in range(3):
        direction = np.zeros(edges[-1])
        part = slice(edges[column], edges[column + 1])
        direction[part] = rng.standard_normal(part.stop - part.start)
        product = split(system, matrix @ direction)
        for row in range(3):
            assert_derivative(
                lambda step, row=row: split(system, moved(step).gradient())[row],
                product[row],
                direction,
            )


@DIMENSIONS
@FORMULATIONS
def test_right_hand_side_is_for_the_new_multiplier(d, formulation):
    """K (0, 0, λ^t) - gradient = right-hand side, so that the solution's last part is λ^t + δλ."""
    system = make_system(d, formulation)
    matrix, rhs = system.kkt()
    zero = np.zeros(system.g_x.size + system.g_s.size)
    np.testing.assert_allclose(
        matrix @ np.concatenate([zero, system.lam]) - system.gradient(), rhs, atol=1e-13
    )


@DIMENSIONS
@FORMULATIONS
def test_dropping_second_derivatives_changes_one_block(d, formulation):
    system = make_system(d, formulation)
    frozen = dataclasses.replace(system, second_derivatives=False)
    difference = frozen.kkt()[0] - system.kkt()[0]
    n = system.g_x.size
    assert relative(difference[:n, :n], system.E_xx) < 1e-13
    assert abs(difference).sum() == pytest.approx(abs(difference[:n, :n]).sum())
    assert sp.linalg.norm(system.E_xx) > 0.1


# Invariance


@DIMENSIONS
@FORMULATIONS
def test_rigid_motion_rotates_the_step(d, formulation):
    system = make_system(d, formulation)
    rng = np.random.default_rng(5)
    Q, b = rotation_matrix(d, rng), rng.standard_normal(d)
    state = system.state
    Lam = state.Lam if formulation == "symmetric" else Q @ state.Lam
    turned = dataclasses.replace(
        system,
        state=dataclasses.replace(state, x=state.x @ Q.T + b, Lam=Lam),
        x_n=system.start @ Q.T + b,
        v=system.v @ Q.T,
        f_ext=system.f_ext @ Q.T,
    )
    assert turned.energy() == pytest.approx(system.energy(), rel=1e-13)
    step, turned_step = solve_kkt(system), solve_kkt(turned)
    assert relative(turned_step.dx.reshape(-1, d), step.dx.reshape(-1, d) @ Q.T) < 1e-10
    assert relative(turned_step.ds, step.ds) < 1e-10
    lam = system.multiplier_tensor(step.lam)
    expected = lam if formulation == "symmetric" else Q @ lam
    assert relative(turned.multiplier_tensor(turned_step.lam), expected) < 1e-10


@DIMENSIONS
@FORMULATIONS
def test_renumbering_permutes_the_result(d, formulation):
    """Vertices, cells, and the order of vertices within a cell, odd permutations included."""
    system = make_system(d, formulation)
    rng = np.random.default_rng(6)
    state = system.state
    vertices, order = rng.permutation(len(state.X)), rng.permutation(len(state.cells))
    new_number = np.argsort(vertices)
    cells = rng.permuted(new_number[state.cells[order]], axis=1)
    renumbered = dataclasses.replace(
        system,
        state=State(state.X[vertices], cells, state.x[vertices], state.S[order], state.Lam[order]),
        rho=system.rho[order],
        v=system.v[vertices],
        x_n=system.x_n[vertices],
    )
    position = (d * vertices[:, None] + np.arange(d)).ravel()
    dofs = [position]
    offset = system.g_x.size
    for size in sizes(system)[1:]:
        block = size // len(order)
        dofs.append(offset + (block * order[:, None] + np.arange(block)).ravel())
        offset += size
    permutation = np.concatenate(dofs)
    assert relative(renumbered.kkt()[0], system.kkt()[0][permutation][:, permutation]) < 1e-13
    assert relative(renumbered.kkt()[1], system.kkt()[1][permutation]) < 1e-13


# Interface


@FORMULATIONS
def test_every_block_can_be_replaced_and_changes_what_follows(formulation):
    system = make_system(3, formulation)

    def outcome(system):
        outputs = [*system.kkt(), *system.reduced(), system.gradient()]
        if formulation == "symmetric":
            outputs += system.condensed()
        return np.concatenate([(m.toarray() if sp.issparse(m) else m).ravel() for m in outputs])

    reference = outcome(system)
    for name in system.block_names():
        block = getattr(system, name)
        if np.linalg.norm(block.toarray() if sp.issparse(block) else block) == 0.0:
            continue
        changed = system.with_blocks(**{name: 1.001 * block})
        assert np.linalg.norm(outcome(changed) - reference) > 0.0, name
        np.testing.assert_array_equal(outcome(system), reference)
    with pytest.raises(ValueError, match="no block Q"):
        system.with_blocks(Q=np.eye(3))


def test_errors_name_what_is_wrong():
    X, cells = make_mesh(3, np.random.default_rng(0))
    state = State.at_rest(X, cells)
    material = Corotational(MU, LAM)
    with pytest.raises(ValueError, match=r"x has shape \(2, 3\)"):
        dataclasses.replace(state, x=X[:2])
    with pytest.raises(ValueError, match="outside"):
        dataclasses.replace(state, cells=cells + 5)
    with pytest.raises(ValueError, match="not symmetric"):
        dataclasses.replace(state, S=state.S + np.eye(3)[[1, 0, 2]] * [[1.0], [0.0], [0.0]])
    with pytest.raises(ValueError, match="h is 0"):
        SeedSystem(state, material, h=0.0)
    with pytest.raises(ValueError, match="eps is -1"):
        SeedSystem(state, material, eps=-1.0)
    with pytest.raises(ValueError, match=r"cells \[0\] are flat"):
        flat = X.copy()
        flat[cells[0, 3]] = flat[cells[0, :3]].mean(axis=0)
        _ = SeedSystem(State.at_rest(flat, cells[:1]), material).volume
    massless = SymmetricSystem(state, material, rho=0.0)
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        solve_kkt(dataclasses.replace(massless, f_ext=np.ones(3)).with_blocks(g_x=np.ones(X.size)))
