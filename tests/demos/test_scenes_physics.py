"""The built-in scenes: what is known of each by another route."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.special import ellipk

from demos.app.output import final_state
from demos.app.scene import BUILT_IN, Overrides, built_in, load, parse
from demos.app.simulation import Simulation, build_body
from demos.studies import cook
from solvers import ConvergenceError

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.serial


class Played:
    """A scene after its last step, and what was known after each.

    Attributes:
        x: Positions of the vertices [m], shape (steps + 1, vertices, d).
        t: Times [s].
        reactions: Forces of motions [N], shape (steps, motions, d).
        energies: Kinetic, elastic and potential energy [J], shape (steps, 3).
        missing: Work done less what the body has of it [J].
    """

    def __init__(self, scene):
        body = build_body(scene, COMM)
        self.simulation = made = Simulation(scene, body)
        X = body.gather_points()
        self.x, self.t = [X], [0.0]
        self.reactions, self.energies, self.missing, self.iterations = [], [], [], []
        start = made.energies()
        for result in made.march(scene.steps):
            self.x.append(X + body.gather(made.fields[0]))
            self.t.append(made.scheme.t)
            self.reactions.append(made.account.reactions)
            now, done = made.energies(), made.account.balance
            self.energies.append(now)
            gained = now.kinetic + now.elastic - start.kinetic - start.elastic
            self.missing.append(done.loads + done.motions - done.dissipated - gained)
            self.iterations.append(result.iterations)
        self.x, self.reactions, self.energies = map(
            np.array, (self.x, self.reactions, self.energies)
        )


def play(name, steps=None, *changes):
    """Play a built-in scene, with other texts in the place of some of its."""
    text = (BUILT_IN / f"{name}.toml").read_text("utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return Played(parse(text, BUILT_IN / f"{name}.toml", Overrides(steps=steps)))


def test_all_scenes_can_be_read():
    assert len(built_in()) >= 15
    for name in built_in():
        assert load(COMM, name).description


def test_stretched_bar():
    """The force over the way is the energy, by the trapezoidal rule; both ends pull alike."""
    bar = play("stretched-bar")
    left, right = bar.reactions[:, 0], bar.reactions[:, 1]
    assert left == pytest.approx(-right, abs=1e-6 * right.max())
    pull = np.concatenate([[0.0], right[:, 0]])
    assert np.trapezoid(pull, dx=0.2) == pytest.approx(bar.energies[-1, 1], rel=5e-3)


def test_twisted_bar():
    """Its energy begins as that of Saint-Venant's torsion, GJθ²/(2L)."""
    bar = play(
        "twisted-bar",
        3,
        ("[time]", '[time]\nscheme = "static"'),
        ("cells = [32, 4, 4]", "cells = [16, 2, 2]"),
        ('formulation = "symmetric"', "degree = 2"),
    )
    theta, mu = 0.1 * np.arange(1, 4) * np.pi, 1e6 / 2 / 1.4
    torsion = 0.1406 * 0.5**4 * mu * theta**2 / (2 * 4.0)
    assert bar.energies[:, 1] == pytest.approx(torsion, rel=0.05)
    assert np.abs(bar.reactions.sum(axis=1)).max() < 1e-6 * np.abs(bar.reactions).max()


def test_bent_beam():
    """Energy of an arc of curvature κ, Green's strain -κη + κ²η²/2 along it."""
    beam = play("bent-beam")
    kappa = np.pi / 4 * 0.1 * np.arange(1, 11)
    second, fourth = 0.2**4 / 12, 0.2 * 2 * 0.1**5 / 5
    exact = 1e7 / 2 * (kappa**2 * second + kappa**4 * fourth / 4) * 4.0
    assert beam.energies[:, 1] == pytest.approx(exact, rel=0.015)


def test_stiff_inclusions():
    """All strain is in the matrix, whose modulus is less by 6 in the exponent."""
    beam = play("stiff-inclusions", 2)
    S = beam.simulation.cell_means().stretch - np.eye(3)
    body, strain = beam.simulation.body, np.linalg.norm(S, axis=(1, 2))
    in_fibres = np.isin(np.arange(len(strain)), body.regions(["fibres", "matrix"]).find(0))
    assert strain[in_fibres].max() < 1e-2 * strain[~in_fibres].max()
    assert max(beam.iterations) <= 6


def test_spinning_rods():
    """As a rigid body of equal moments does in backward Euler's method.

    Its turn is the polar part of 2 Q₁ - Q₀: by atan(sin δ/(2 - cos δ)) after one by δ.
    """
    rods = play("spinning-rods", 6)
    axis, turn, angle = np.array([0.0, 0.6, 0.8]), np.arctan(0.5), 0.0
    X = rods.x[0]
    for x in rods.x[1:]:
        angle += turn
        across = np.cross(axis, X)
        rotated = X + np.sin(angle) * across + (1 - np.cos(angle)) * np.cross(axis, across)
        assert np.abs(x - rotated).max() < 2e-4
        turn = np.arctan(np.sin(turn) / (2 - np.cos(turn)))


def test_rigid_pendulum():
    """It comes through the vertical after a quarter of the period of a physical pendulum."""
    bar = play("rigid-pendulum", 40)
    centre = bar.x.mean(axis=1) - [0.0, 0.2, 0.1]
    angle = np.arctan2(centre[:, 0], -centre[:, 1])  # from the vertical
    k = int(np.argmax(angle < 0))
    found = bar.t[k - 1] + (bar.t[k] - bar.t[k - 1]) * angle[k - 1] / (angle[k - 1] - angle[k])
    arm = np.hypot(0.5, 0.1)
    inertia = (1.0**2 + 0.2**2) / 12 + arm**2
    exact = np.sqrt(inertia / (9.81 * arm)) * ellipk(np.sin(angle[0] / 2) ** 2)
    assert found == pytest.approx(exact, rel=5e-3)
    weight = 40.0 * 9.81
    assert bar.energies[k, 0] == pytest.approx(weight * (arm - 0.1), rel=0.05)


def test_dropped_bear():
    """It falls freely, as backward Euler does, then keeps above the floor, and loses energy."""
    bear = play("dropped-bear", 25)
    fallen = bear.x[:, :, 1] - bear.x[0, :, 1]
    k = np.arange(15)
    assert fallen[:15] == pytest.approx(
        np.tile(-9.81 * 0.02**2 * (k * (k + 1) / 2)[:, None], (1, fallen.shape[1])), abs=1e-9
    )
    assert -0.52 < bear.x[:, :, 1].min() < -0.5
    assert bear.missing[-1] > bear.missing[15] > 0.0


def test_thrown_bear():
    """Its centre of mass flies as a point does by the same scheme; full displacement steps fail."""
    bear = play("thrown-bear")
    assert max(bear.iterations) <= 6
    cells = final_state(bear.simulation)["cells"]
    corners = bear.x[0][cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    centre = np.array([np.average(x[cells].mean(axis=1), axis=0, weights=volumes) for x in bear.x])
    h, v, g = 0.2, np.array([6.5, 5.0, 0.0]), np.array([0.0, -9.81, 0.0])
    point = [centre[0], centre[0] + h * (v + h * g)]
    for n in range(2, 6):
        point.append((4 * point[-1] - point[-2] + 2 * h * (v + n * h * g)) / 3)
    np.testing.assert_allclose(centre, point, atol=1e-9)
    with pytest.raises(ConvergenceError, match="DIVERGED"):
        play("thrown-bear", 1, ('"symmetric"', '"displacement"\nglobalisation = "full-steps"'))


def test_cooks_membrane():
    """Under a small load the tip goes where linear elasticity has it."""
    small = play("cooks-membrane", 1, ("[0.0, 1e5]", "[0.0, 1e2]"), ("h = 0.2", "h = 1.0"))
    tip = np.argmin(np.linalg.norm(small.x[0] - 1e-3 * np.array(cook.MIDDLE), axis=1))
    moved = (small.x[-1] - small.x[0])[tip, 1]
    force = 1e2 * 1e-3 * cook.HEIGHT
    assert moved * 2.4e6 / force == pytest.approx(cook.reference(COMM, 0.4999), rel=0.01)


def test_buckling_strut():
    """It carries Euler's load of a strut that is clamped at both ends, and hardly more."""
    strut = play("buckling-strut")
    euler = 4 * np.pi**2 * 1e7 * np.pi / 4 * 0.025**4
    carried = -strut.reactions[:, 1, 0]
    assert carried[1] == pytest.approx(2 * carried[0], rel=0.02)
    assert carried[4:] == pytest.approx(euler, rel=0.1)
    aside = np.abs((strut.x[-1] - strut.x[0])[:, 1:]).max()
    assert aside == pytest.approx(2 / np.pi * np.sqrt(0.02 - 4 * np.pi**2 * 0.0125**2), rel=0.1)


def test_inflated_ball():
    """Radii of a hollow ball by its ordinary differential equation."""
    ball = play("inflated-ball", 2, ("h = 0.1", "h = 0.5"))
    simulation = ball.simulation
    law, p = simulation.model.psi, 5e4
    mu, lam = law.mu, law.lam

    def stresses(r, stretch, R):
        hoop = r / R
        bulk = lam * (stretch * hoop**2 - 1) - mu
        return hoop, bulk, mu * stretch + bulk * hoop**2, mu * hoop + bulk * stretch * hoop

    def right(R, y):
        hoop, bulk, radial, around = stresses(*y, R)
        by_stretch = mu + lam * hoop**4
        by_hoop = 2 * hoop * bulk + 2 * lam * hoop**3 * y[1]
        change = 2 * (around - radial) / R - by_hoop * (y[1] - hoop) / R
        return np.array([y[1], change / by_stretch])

    def ends(a, b):
        hoop, _, radial, _ = stresses(*a, 0.8)
        return np.array([radial + p * hoop**2, stresses(*b, 1.0)[2]])

    R = np.linspace(0.8, 1.0, 50)
    exact = solve_bvp(right, ends, R, np.array([R, np.ones_like(R)]), tol=1e-8)
    assert exact.success
    before, after = (np.linalg.norm(x, axis=1) for x in (ball.x[0], ball.x[-1]))
    for radius in (0.8, 1.0):
        on = np.abs(before - radius) < 1e-6
        assert on.sum() > 50
        assert exact.sol(radius)[0] > 1.05 * radius
        grown = after[on].mean() / radius - 1
        assert grown == pytest.approx(exact.sol(radius)[0] / radius - 1, rel=0.02)


def test_gear():
    """The bore takes what the flank is given: the pressure times its area."""
    gear = play("gear")
    share = 2 * np.pi / 12
    root, tip = (
        r * np.array([np.cos(at * share), np.sin(at * share)])
        for r, at in ((0.8, 0.25), (1.0, 0.1))
    )
    area = np.linalg.norm(root - tip) * 0.25
    assert np.linalg.norm(gear.reactions[-1, 0]) == pytest.approx(2e8 * area, rel=5e-3)
