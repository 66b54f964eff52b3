"""A model is what one would write by hand, and tells the energies of its body."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

from forms import (
    FORMULATIONS,
    BackwardEuler,
    Fixed,
    Gravity,
    Model,
    StableNeoHookean,
    Static,
    Stretch,
    Traction,
    cell_values,
    measure,
)
from meshes import Where, box
from solvers import MixedProblem, march
from tests.bodies import largest, steps

COMM = MPI.COMM_WORLD
RHO, H, G = 1000.0, 0.1, (0.0, -9.81, 0.0)
LEFT, RIGHT = (Where(extents=(("x", end),)) for end in ("min", "max"))


@pytest.mark.parametrize(
    ("formulation", "d", "degree"),
    [("symmetric", 3, 1), ("symmetric", 2, 2), ("displacement", 2, 1), ("log-strain", 2, 1)],
)
def test_positions_of_the_energy_written_by_hand(formulation, d, degree):
    """To 1e-12 of the body's size, in as many iterations of Newton's method."""
    body = box(COMM, (4.0, 1.0, 1.0)[:d], (8, 2, 2)[:d])
    psi = StableNeoHookean(1e6, 0.45)
    model = Model(
        body,
        formulation,
        psi,
        rho=RHO,
        loads=[Gravity(G[:d])],
        motions=[Fixed(LEFT)],
        degree=degree,
    )
    scheme = BackwardEuler(model.u, H)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    ours = [result.iterations for result in steps(model, scheme, problem, 3)]

    form = FORMULATIONS[formulation]
    fields = form.fields(body.mesh, degree)
    u = fields[0]
    euler = BackwardEuler(u, H, G[:d])
    energy = form.density(*fields, psi) * measure(u) + euler.kinetic(RHO) * ufl.dx
    V = u.function_space
    bc = fem.dirichletbc(np.zeros(d), body.dofs(V, LEFT), V)
    by_hand = MixedProblem(energy, fields, [bc])
    theirs = [result.iterations for result in march(by_hand, euler, 3)]
    assert largest(u.x.array) > 0.3
    assert largest(model.u.x.array - u.x.array) < 1e-12 * 4.0
    assert ours == theirs


def test_energies():
    """Of a body that falls while it is stretched: each in closed form."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    psi = StableNeoHookean(10.0, 0.3)
    model = Model(
        body,
        "displacement",
        psi,
        rho=3.0,
        loads=[Gravity((0.0, -2.0)), Traction((5.0, 0.0), RIGHT)],
    )
    scheme = BackwardEuler(model.u, H)
    energies = model.energies(scheme)
    model.u.interpolate(lambda X: np.array([0.2 * X[0], 0 * X[0] - 0.7]))
    model.update(scheme)
    model.accept(scheme)
    kinetic, elastic, potential = energies.now()
    # v = (2 x, -7), on 2 m × 1 m: ∫ |v|² = 4 · 8/3 + 49 · 2.
    assert kinetic == pytest.approx(3.0 / 2 * (4 * 8 / 3 + 49 * 2))
    density = psi.mu * (1 - 1.2) + psi.lam / 2 * 0.2**2 + psi.mu / 2 * (1.2**2 - 1)
    assert elastic == pytest.approx(2.0 * density)
    assert potential == pytest.approx(-3.0 * 2.0 * 0.7 * 2.0 - 5.0 * 0.4)


def test_energy_of_a_free_fall():
    """Kinetic and potential energy exchange but for what backward Euler loses, m g² h t / 2."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    density = cell_values(body.mesh, body.cell_tags, {0: 3.0})
    model = Model(
        body, "symmetric", StableNeoHookean(10.0, 0.3), rho=density, loads=[Gravity((0.0, -2.0))]
    )
    scheme = BackwardEuler(model.u, 0.05)
    problem = MixedProblem(model.energy(scheme), model.fields)
    energies = model.energies(scheme)
    for _ in steps(model, scheme, problem, 4):
        kinetic, elastic, potential = energies.now()
        mass, t = 3.0 * 2.0, scheme.t
        assert kinetic == pytest.approx(mass / 2 * (2.0 * t) ** 2)
        assert potential == pytest.approx(-mass / 2 * 2.0**2 * t * (t + 0.05))
        assert abs(elastic) < 1e-12


def test_a_formulation_that_is_not_registered():
    """An object in place of a name; and fields of a degree."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    by_name, by_object = (
        Model(body, given, StableNeoHookean(10.0, 0.3), degree=2)
        for given in ("symmetric", FORMULATIONS["symmetric"])
    )
    assert by_name.form is by_object.form
    assert by_object.u.function_space.element.basix_element.degree == 2
    message = "formulation is 'symetric'; available: symmetric, seed"
    with pytest.raises(ValueError, match=message):
        Model(body, "symetric", StableNeoHookean(10.0, 0.3))
    with pytest.raises(ValueError, match="the scheme moves another displacement than that of the"):
        by_name.energy(Static(by_object.u))


def test_stress_balances_the_pull():
    """In a bar that is drawn out: P₁₁ the same everywhere, and the traction that does the same."""
    body = box(COMM, (2.0, 1.0), (4, 2))
    rollers = [Fixed(Where(extents=((axis, "min"),)), components=axis) for axis in "xy"]
    found = []
    for loads, more in (
        ([], [Stretch(RIGHT, 0.2, components="x")]),
        ([Traction(lambda t: (pull, 0.0) if t else (0.0, 0.0), RIGHT)], []),
    ):
        psi = StableNeoHookean(10.0, 0.3)
        model = Model(body, "symmetric", psi, loads=loads, motions=[*rollers, *more])
        scheme = Static(model.u)
        problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
        next(steps(model, scheme, problem, 1))
        problem.refresh()
        stress = model.stress(scheme)
        P = fem.Expression(stress, np.full((1, 2), 1 / 3))
        cells = np.arange(body.mesh.topology.index_map(2).size_local, dtype=np.int32)
        values = P.eval(body.mesh, cells)[:, 0]
        pull = COMM.allgather(values[:1, 0, 0].tolist())[0][0]
        assert largest(values - [[pull, 0.0], [0.0, 0.0]]) < 1e-9
        found.append(model.u.x.array.copy())
    assert pull > 0.5
    assert largest(found[0] - found[1]) < 1e-9


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("formulation", ["hu-washizu", "log-strain", "symmetric"])
def test_cells_turned_inside_out_are_told_of(formulation, degree, caplog):
    """Once as long as they do not become more, and only where the energy does not see them."""
    body = box(COMM, (4.0, 1.0), (8, 2))
    model = Model(body, formulation, StableNeoHookean(1e6, 0.45), rho=RHO, degree=degree)
    scheme = BackwardEuler(model.u, H)
    model.accept(scheme)
    model.u.interpolate(lambda X: np.stack([-2 * X[0] * (X[0] > 2.1), 0 * X[0]]))
    for _ in range(2):
        model.accept(scheme)
    blind = formulation != "symmetric"
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == (blind and COMM.rank == 0)
    if messages:
        assert messages[0].startswith(f"{formulation}: 16 of the cells turned inside out")
