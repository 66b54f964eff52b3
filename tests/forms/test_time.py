"""Time schemes: their orders, what they conserve, and Ψ at another point of the step."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.linalg
import ufl
from dolfinx import fem

from forms import (
    SCHEMES,
    Corotational,
    Fixed,
    Formulation,
    Gravity,
    ImplicitMidpoint,
    Model,
    Rayleigh,
    StableNeoHookean,
    displacement_field,
)
from meshes import Where, box
from solvers import MixedProblem, StepControl, march
from tests.bodies import LEFT, body_on, largest, steps
from tests.states import random_directions, random_values, small_mesh
from tests.taylor import check_taylor_orders

COMM = MPI.COMM_WORLD
E, NU, RHO = 2.0, 0.3, 2.0
TIGHT = {"snes_rtol": 1e-13}
CLAMP = Where(extents=(("x", "min"),))


class Linear(Formulation):
    """Linear elasticity: Ψ(I + ε), quadratic in u where Ψ is so in S."""

    name = "linear"

    def fields(self, msh, degree=1):
        return (displacement_field(msh, degree),)

    def density(self, u, psi):
        return psi(self.stretch(u))

    def stretch(self, u):
        return ufl.Identity(len(u)) + ufl.sym(ufl.grad(u))

    def stress(self, u, psi):
        S = ufl.variable(self.stretch(u))
        return ufl.diff(psi(S), S)


class Swing:
    """A soft plane bar that is clamped and struck from the side."""

    def __init__(self, scheme, h, formulation="symmetric", psi=None, g=-0.5, **keys):
        psi = StableNeoHookean(E, NU) if psi is None else psi
        self.model = Model(
            box(COMM, (2.0, 1.0), (4, 2)),
            formulation,
            psi,
            rho=RHO,
            loads=[Gravity((0.0, g))],
            motions=[Fixed(CLAMP)],
        )
        self.scheme = SCHEMES[scheme](self.model.u, h, **keys)
        self.scheme.v.interpolate(lambda X: np.array([0.0 * X[0], 0.3 * X[0]]))
        energy = self.model.energy(self.scheme)
        self.problem = MixedProblem(energy, self.model.fields, self.model.bcs, options=TIGHT)

    def march(self, count):
        return steps(self.model, self.scheme, self.problem, count)


def end(scheme, count, lengths=(1.0,), **keys):
    """Displacement, velocity and energy after 1 s in `count` steps, whose lengths take turns."""
    swing = Swing(scheme, 1.0 / count, **keys)
    for k in range(count):
        swing.scheme.h.value = lengths[k % len(lengths)] / count
        next(swing.march(1))
    assert swing.scheme.t == pytest.approx(1.0)
    energy = np.array([sum(swing.model.energies(swing.scheme).now())])
    return swing.scheme.u_old.x.array.copy(), swing.scheme.v.x.array.copy(), energy


@pytest.fixture(scope="module")
def reference():
    """With a step 8 times finer than the finest."""
    return end("implicit-midpoint", 512)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("scheme", "counts", "order", "lengths", "keys"),
    [
        ("backward-euler", (64, 128, 256), 1, (1.0,), {}),
        ("implicit-midpoint", (16, 32, 64), 2, (1.0,), {}),
        ("bdf2", (16, 32, 64), 2, (1.0,), {}),
        ("bdf2", (16, 32, 64), 2, (0.7, 1.3), {}),
        ("trapezoidal", (16, 32, 64), 2, (1.0,), {}),
        ("trapezoidal", (16, 32, 64), 2, (0.7, 1.3), {}),
        ("newmark", (32, 64, 128), 1, (1.0,), {"beta": 0.36, "gamma": 0.7}),
        ("generalised-alpha", (32, 64, 128), 2, (1.0,), {"rho_inf": 0.5}),
        ("generalised-alpha", (16, 32, 64), 2, (1.0,), {"rho_inf": 0.0}),
    ],
)
def test_order(reference, scheme, counts, order, lengths, keys):
    """Of displacement, velocity and energy, in a motion by half of the bar's height."""
    assert largest(reference[0]) > 0.1
    errors = [
        [
            largest(f - exact)
            for f, exact in zip(end(scheme, n, lengths, **keys), reference, strict=True)
        ]
        for n in counts
    ]
    found = -np.diff(np.log(errors), axis=0) / np.diff(np.log(counts))[:, None]
    assert np.abs(found[-1] - order).max() < 0.15, found


@pytest.mark.serial
def test_midpoint_keeps_the_energy_of_a_linear_oscillation():
    """To 1e-8 over 1,000 steps, in which it goes to and fro between kinetic and elastic."""
    swing = Swing("implicit-midpoint", 0.1, Linear(), Corotational(E, NU), g=0.0)
    energies = swing.model.energies(swing.scheme)
    history = [energies.now()]
    history += [energies.now() for _ in swing.march(1000)]
    kinetic, elastic, potential = np.array(history).T
    total = kinetic + elastic + potential
    assert np.abs(total - total[0]).max() < 1e-8 * total[0]
    assert kinetic.min() < 0.2 * total[0] < 0.8 * total[0] < elastic.max()


class Pendulum:
    """Two triangles that hang by an edge, linear elastic, pushed along a mode or at random."""

    def __init__(self, scheme, h, psi=None, damping=None, options=TIGHT, **keys):
        formulation = "displacement" if psi else Linear()
        self.model = Model(
            box(COMM, (1.0, 1.0), (1, 1)),
            formulation,
            psi or Corotational(E, NU),
            rho=RHO,
            motions=[Fixed(CLAMP)],
            damping=damping,
        )
        self.scheme = SCHEMES[scheme](self.model.u, h, **keys)
        self.problem = MixedProblem(
            self.model.energy(self.scheme), self.model.fields, self.model.bcs, options=options
        )
        self.energies = self.model.energies(self.scheme)

    def push(self, velocity):
        self.scheme.v.interpolate(lambda X: np.array([0.0 * X[0], velocity * X[0]]))

    def march(self, count, control=None):
        return march(self.problem, self.scheme, count, self.model, control)

    def energy(self):
        return sum(self.energies.now())

    def modes(self):
        """Angular frequencies [rad/s], and the modes as columns on all local dofs; in serial."""
        u, form = self.model.u, Linear()
        v, w = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        elastic = form.density(u, self.model.psi) * ufl.dx
        matrices = (
            ufl.derivative(ufl.derivative(elastic, u, v), u, w),
            RHO * ufl.inner(v, w) * ufl.dx,
        )
        free = np.setdiff1d(
            np.arange(8), 2 * self.model.body.dofs(u.function_space, CLAMP)[:, None] + [0, 1]
        )
        K, M = (fem.assemble_matrix(fem.form(a)).to_dense()[np.ix_(free, free)] for a in matrices)
        squares, vectors = scipy.linalg.eigh(K, M)
        modes = np.zeros((8, len(free)))
        modes[free] = vectors
        return np.sqrt(squares), modes


@pytest.mark.serial
def test_midpoint_bounds_the_energy_of_a_nonlinear_oscillation():
    """Over 1,000 steps, far from rest, it goes to and fro without a drift."""
    pendulum = Pendulum("implicit-midpoint", 0.2, StableNeoHookean(E, NU), options={})
    pendulum.push(0.6)
    energies = [pendulum.energy()]
    moved = []
    for _ in pendulum.march(1000):
        energies.append(pendulum.energy())
        moved.append(largest(pendulum.model.u.x.array))
    energies = np.array(energies) / energies[0]
    assert max(moved) > 0.4
    assert np.abs(energies - 1).max() < 0.05
    assert abs(energies[-200:].mean() - energies[:200].mean()) < 0.005


@pytest.mark.serial
def test_the_trapezoidal_rule_keeps_the_energy_of_a_linear_oscillation():
    """From the second step on; the first loses what is of second order in h."""
    lost = []
    for h in (0.1, 0.05):
        pendulum = Pendulum("trapezoidal", h)
        pendulum.push(0.1)
        before = pendulum.energy()
        next(pendulum.march(1))
        begun = pendulum.energy()
        lost.append(1 - begun / before)
        for _ in pendulum.march(200):
            assert abs(pendulum.energy() / begun - 1) < 1e-10
    assert 1e-4 < lost[1] < 0.3 * lost[0]


@pytest.mark.serial
@pytest.mark.parametrize(
    ("scheme", "keys", "radius"),
    [
        ("generalised-alpha", {"rho_inf": 0.0}, 0.0),
        ("generalised-alpha", {"rho_inf": 0.6}, 0.6),
        ("generalised-alpha", {"rho_inf": 1.0}, 1.0),
        ("newmark", {"beta": 0.36, "gamma": 0.7}, 2 / 3),
        ("trapezoidal", {}, 1.0),
        ("bdf2", {}, 0.0),
    ],
)
def test_what_a_scheme_does_not_resolve(scheme, keys, radius):
    """With h infinitely long the velocity is multiplied by the spectral radius in each step."""
    pendulum = Pendulum(scheme, 1e6, **keys)
    pendulum.push(1.0)
    speeds = []
    for _ in pendulum.march(10):
        speeds.append(largest(pendulum.scheme.v.x.array))
    if radius == 0.0:
        assert speeds[-1] < 1e-12
    else:  # a double eigenvalue makes it n radiusⁿ
        assert abs(speeds[-1] / speeds[-2] / radius - 1) < 0.15


@pytest.mark.serial
@pytest.mark.parametrize(
    ("scheme", "kind", "order"),
    [
        ("implicit-midpoint", "mass", 2),
        ("generalised-alpha", "mass", 2),
        ("bdf2", "mass", 2),
        ("implicit-midpoint", "stiffness", 2),
        ("bdf2", "stiffness", 1),
    ],
)
def test_rayleigh_damping(scheme, kind, order):
    """A mode decays as in closed form, ζ = ηM/(2ω) + ηK ω/2."""
    eta = {"mass": 0.3, "stiffness": 0.2}[kind]
    errors = []
    for count in (32, 64):
        damping = Rayleigh(**{kind: eta})
        pendulum = Pendulum(scheme, 2.0 / count, damping=damping)
        omega, modes = pendulum.modes()
        pendulum.scheme.v.x.array[:] = modes[:, 0]
        for _ in pendulum.march(count):
            pass
        sigma = eta / 2 if kind == "mass" else eta * omega[0] ** 2 / 2
        omega_d = np.sqrt(omega[0] ** 2 - sigma**2)
        exact = np.exp(-2.0 * sigma) * np.sin(2.0 * omega_d) / omega_d
        errors.append(largest(pendulum.model.u.x.array - exact * modes[:, 0]))
    assert errors[1] < 0.01 * largest(modes[:, 0])
    assert errors[0] / errors[1] > 0.85 * 2**order, errors


@pytest.mark.parametrize("formulation", ["symmetric", "log-strain"])
def test_damping_leaves_rigid_motions_and_formulations_alone(formulation):
    """By stiffness: positions of the displacement method, and no force on a body that turns."""
    found = []
    for name in (formulation, "displacement"):
        model = Model(
            box(COMM, (1.0, 1.0), (1, 1)),
            name,
            StableNeoHookean(E, NU),
            rho=RHO,
            damping=Rayleigh(stiffness=0.5),
        )
        scheme = ImplicitMidpoint(model.u, 0.1)
        scheme.v.interpolate(lambda X: np.array([0.5 - X[1], X[0] + X[0] ** 2]))
        problem = MixedProblem(model.energy(scheme), model.fields, options=TIGHT)
        for _ in steps(model, scheme, problem, 5):
            pass
        found.append(model.u.x.array.copy())
    assert largest(found[0] - found[1]) < 1e-9


@pytest.mark.serial
@pytest.mark.parametrize("scheme", ["backward-euler", "implicit-midpoint", "generalised-alpha"])
def test_steps_follow_the_error(scheme):
    """A tolerance ten times smaller: an error smaller by so much as the order says."""
    errors, counts = [], []
    for tolerance in (1e-4, 1e-5):
        pendulum = Pendulum(scheme, 0.3)
        omega, modes = pendulum.modes()
        pendulum.scheme.v.x.array[:] = modes[:, 0]
        lengths = []
        before = 0.0
        for _ in pendulum.march(10, StepControl(tolerance=tolerance)):
            lengths.append(pendulum.scheme.t - before)
            before = pendulum.scheme.t
        assert pendulum.scheme.t == pytest.approx(3.0)
        assert float(pendulum.scheme.h.value) == 0.3
        exact = np.sin(3.0 * omega[0]) / omega[0] * modes[:, 0]
        errors.append(largest(pendulum.model.u.x.array - exact))
        counts.append(len(lengths))
    assert max(lengths) > 1.2 * min(lengths)
    order = 1 if scheme == "backward-euler" else 2
    expected = 10 ** (order / (order + 1))  # of n steps of error h^(order + 1) each
    assert errors[0] / errors[1] > 0.6 * expected
    assert 0.6 < counts[1] / counts[0] / 10 ** (1 / (order + 1)) < 1.6


@pytest.mark.parametrize(
    ("scheme", "kept"), [("implicit-midpoint", True), ("backward-euler", False)]
)
def test_midpoint_keeps_the_angular_momentum(scheme, kept):
    """Of a free bar that turns by some 200 degrees and stretches; backward Euler does not."""
    model = Model(box(COMM, (2.0, 1.0), (4, 2)), "symmetric", StableNeoHookean(E, NU), rho=RHO)
    made = SCHEMES[scheme](model.u, 0.1)
    made.v.interpolate(lambda X: np.array([0.5 - X[1], X[0]]))
    problem = MixedProblem(model.energy(made), model.fields, options=TIGHT)
    x, v = ufl.SpatialCoordinate(model.body.mesh) + model.u, made.v
    forms = [fem.form(RHO * m * ufl.dx) for m in (v[0], v[1], x[0] * v[1] - x[1] * v[0])]

    def momenta():
        return [COMM.allreduce(fem.assemble_scalar(form)) for form in forms]

    history = [momenta()]
    history += [momenta() for _ in steps(model, made, problem, 40)]
    lost = np.abs(np.array(history) - history[0]).max(axis=0) / RHO
    assert largest(model.u.x.array) > 2.0
    assert lost[:2].max() < 1e-10
    assert lost[2] < 1e-10 if kept else lost[2] > 1e-2


# Ψ at another point than the end of the step


@pytest.mark.serial
@pytest.mark.parametrize(
    ("formulation", "d"),
    [("symmetric", 3), ("displacement", 3), ("log-strain", 2), ("rotation-field", 2)],
)
def test_taylor_at_the_midpoint(formulation, d):
    """The whole density stands at (u + u_old)/2, and is differentiated there."""
    msh = small_mesh(d)
    model = Model(body_on(msh), formulation, StableNeoHookean(E, NU), rho=RHO)
    scheme = ImplicitMidpoint(model.u, 0.4)
    scheme.u_old.x.array[:] = 0.05 * random_values(scheme.u_old, 7)
    energy = model.energy(scheme)
    problem = MixedProblem(energy, model.fields, solver="direct")
    for f, change in zip(model.fields, random_directions(model.fields, stress=E), strict=True):
        f.x.array[:] += change
    check_taylor_orders(problem, fem.form(energy), stress=E)


@pytest.mark.parametrize("formulation", ["symmetric", "hu-washizu"])
def test_positions_at_the_midpoint(formulation):
    """In 3D, those of the displacement method; S(F) at the end of the step, not in its middle."""
    found = []
    for name in (formulation, "displacement"):
        model = Model(
            body_on(small_mesh(3)),
            name,
            StableNeoHookean(E, NU),
            rho=RHO,
            loads=[Gravity((0.0, -2.0, 0.0))],
            motions=[Fixed(LEFT)],
        )
        scheme = ImplicitMidpoint(model.u, 0.2)
        problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, options=TIGHT)
        for _ in steps(model, scheme, problem, 3):
            pass
        energies = model.energies(scheme).now()
        found.append((model.u.x.array.copy(), np.array(energies)))
    (u, energies), (v, same) = found
    assert largest(v) > 0.2
    assert largest(u - v) < 1e-10
    np.testing.assert_allclose(energies, same, rtol=1e-9)


def test_backward_differences_begin_with_backward_euler():
    """And then are (3 u - 4 u_old + u_older) / 2h."""
    found = []
    for scheme in ("backward-euler", "bdf2"):
        swing = Swing(scheme, 0.1)
        next(swing.march(1))
        found.append(swing.model.u.x.array.copy())
    assert largest(found[0] - found[1]) < 1e-14
    u, u_old, u_older = swing.model.u.x.array, found[1], np.zeros_like(found[1])
    next(swing.march(1))
    velocity = (3 * u - 4 * u_old + u_older) / 0.2
    assert largest(swing.scheme.v.x.array - velocity) < 1e-12
