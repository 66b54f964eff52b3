"""Energies that users write: with fields nobody foresaw, and some that are not for the engine."""

from __future__ import annotations

import logging

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from forms import (
    BackwardEuler,
    displacement_field,
    mixed_fields,
    point_field,
    polar_rotation,
    right_stretch,
)
from solvers import MixedProblem
from solvers.engine import library
from solvers.engine.system import EngineProblem
from tests.bodies import largest
from tests.states import random_values, small_mesh

COMM = MPI.COMM_WORLD
MU, LAM = 4.0, 6.0  # [Pa]


def clamped(V, value=None):
    """The end of the small meshes."""
    d = V.dofmap.bs
    dofs = fem.locate_dofs_geometrical(V, lambda X: X[0] < 0.2)
    return fem.dirichletbc(np.zeros(d) if value is None else value, dofs, V)


def function(msh, element, name, value=0.0, noise=0.0):
    f = fem.Function(fem.functionspace(msh, element), name=name)
    f.x.array[:] = value + noise * random_values(f, len(name))
    return f


def left_and_right(msh):
    """dx, with the cells on the left as 1 and those on the right as 2."""
    cells = msh.topology.index_map(msh.topology.dim)
    every = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    right = mesh.compute_midpoints(msh, msh.topology.dim, every)[:, 0] > 0.5
    tags = mesh.meshtags(msh, msh.topology.dim, every, np.where(right, 2, 1).astype(np.int32))
    return ufl.Measure("dx", msh, subdomain_data=tags)


def composite(d, **choices):
    """A viscous, damaged, fibrous body whose parts differ, with Ψ at the midpoint of a step.

    The stretch of before, damage by cell, fibres by cell and by vertex, a stiffness that depends on
    the place; on the right more of Ψ. In 2D with four further fields: a volume ratio θ beside the
    stretch, and its multiplier; a micro-rotation φ and a pressure p, which are continuous.
    """
    msh = small_mesh(d)
    fields = [u, S, Y] = mixed_fields(msh)
    u_old = function(msh, ("P", 1, (d,)), "u_old", noise=0.03)
    by_cell = function(msh, ("DG", 0, (d,)), "by_cell", 1.0, 0.5)
    by_vertex = function(msh, ("P", 1, (d,)), "by_vertex", 1.0, 0.5)
    damage = function(msh, ("DG", 0), "damage", 0.3, 0.2)
    S_old = point_field(msh, 1.1 * np.eye(d), symmetric=True, name="S_old")
    stiffness = fem.Constant(msh, MU)
    X, I, dx = ufl.SpatialCoordinate(msh), ufl.Identity(d), left_and_right(msh)  # noqa: E741
    F = I + ufl.grad((u + u_old) / 2)
    J = ufl.det(F)
    psi = (1 - damage) * stiffness * (1 + X[0]) * ufl.inner(S - I, S - I)
    psi += 0.5 * ufl.inner(S - S_old, S - S_old) - ufl.inner(Y, S - right_stretch(F))
    psi += 0.1 * (ufl.inner(F * by_cell, F * by_cell) - 3) ** 2 + ufl.inner(
        F * by_vertex, by_vertex
    )
    energy = LAM * (J - 1) ** 4 * dx(2)
    if d == 2:
        theta, q = function(msh, ("DG", 0), "theta", 1.0), function(msh, ("DG", 0), "q")
        phi, p = function(msh, ("P", 1), "phi"), function(msh, ("P", 1), "p")
        fields += theta, q, phi, p
        psi += LAM / 2 * (theta - 1) ** 2 - q * (theta - J)
        psi += 2 * (phi - polar_rotation(F)[1, 0]) ** 2 + 0.1 * ufl.inner(
            ufl.grad(phi), ufl.grad(phi)
        )
        energy += (p * (J - 1) - 0.05 * ufl.inner(ufl.grad(p), ufl.grad(p))) * dx(1) - p**2 * dx
    energy += psi * dx + BackwardEuler(u, 0.4, (0.0, -1.0, 0.5)[:d]).kinetic(2.0) * ufl.dx
    return MixedProblem(energy, fields, [clamped(u.function_space)], **choices)


@pytest.mark.parametrize("d", [2, 3])
def test_fields_nobody_foresaw(d, caplog):
    """The engine takes the energy, and ends where the whole system does, by the same steps."""
    problems = [composite(d, solver=solver) for solver in ("direct", "condensed")]
    direct, condensed = problems
    assert isinstance(condensed.problem, EngineProblem)
    assert not caplog.records
    results = [problem.solve() for problem in problems]
    assert results[0].iterations == results[1].iterations >= 3
    for a, b in zip(direct.fields, condensed.fields, strict=True):
        assert largest(a.x.array) > 1e-3, a.name
        assert largest(a.x.array - b.x.array) < 1e-9 * max(1.0, largest(a.x.array)), a.name


# What is not for the engine


def of_size(u, q):
    """The mesh size in a density."""
    h = ufl.CellDiameter(u.function_space.mesh)
    return h * q * ufl.div(u) * ufl.dx


def on_facets(u, q):
    """A local field on the boundary."""
    return q * u[0] * ufl.ds


def by_two_rules(u, q):
    """A local field in integrals with different rules."""
    return q * u[0] ** 2 * ufl.dx(degree=3)


@pytest.mark.parametrize(
    ("energy", "why"),
    [
        (of_size, "it has the geometric quantity"),
        (on_facets, "q is in an exterior facet integral"),
        (by_two_rules, "q is integrated with several rules, or not on all cells"),
    ],
)
def test_what_is_no_function_of_a_point_is_assembled(energy, why, caplog):
    """One log line says why, and `condensed` still ends where `direct` does."""
    found = []
    for solver in ("direct", "condensed"):
        caplog.clear()
        msh = small_mesh(2)
        u, q = displacement_field(msh), function(msh, ("DG", 0), "q")
        plain = (ufl.inner(ufl.grad(u), ufl.grad(u)) + q**2 - u[1]) * ufl.dx
        bcs = [clamped(u.function_space)]
        with caplog.at_level(logging.INFO, "mixed_fem"):
            problem = MixedProblem(plain + energy(u, q), (u, q), bcs, solver=solver)
        said = [r.getMessage() for r in caplog.records if "engine" in r.getMessage()]
        problem.solve()
        found.append(u.x.array.copy())
    assert not isinstance(problem.problem, EngineProblem)
    assert len(said) == (COMM.rank == 0)
    assert all(why in line and "\n" not in line for line in said)
    assert largest(found[0]) > 0.01
    assert largest(found[0] - found[1]) < 1e-10


@pytest.mark.parametrize("solver", ["condensed", "fieldsplit"])
def test_local_fields_on_interior_facets_are_refused_by_name(solver):
    """They are not local to a cell then; `direct` takes them."""
    msh = small_mesh(2)
    u, q = displacement_field(msh), function(msh, ("DG", 0), "q")
    energy = (ufl.inner(ufl.grad(u), ufl.grad(u)) + q**2 + q * ufl.div(u) - u[1]) * ufl.dx
    energy += ufl.jump(q) ** 2 * ufl.dS
    bcs = [clamped(u.function_space)]
    message = r'q is in an integral over interior facets \(dS\).*; choose solver="direct"'
    with pytest.raises(ValueError, match=message):
        MixedProblem(energy, (u, q), bcs, solver=solver)


# Compilation


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of compiled energies, which counts what is in it."""
    folder = tmp_path / "cache"
    options = library.get_options() | {"cache_dir": folder}
    monkeypatch.setattr(library, "get_options", lambda: options)
    return lambda: len(list(folder.glob("mixed_fem_*.so")))


def stretched(factor=1.0):
    u = displacement_field(small_mesh(2))
    energy = (factor * ufl.inner(ufl.grad(u), ufl.grad(u)) - u[1]) * ufl.dx
    problem = MixedProblem(energy, (u,), [clamped(u.function_space)])
    problem.solve()
    return largest(u.x.array)


@pytest.mark.serial
def test_what_is_compiled_anew(cache, monkeypatch):
    """A changed energy, for another processor or by another compiler; and nothing twice."""
    end = stretched()
    assert (stretched(), cache()) == (end, 1)
    assert stretched(2.0) == pytest.approx(end / 2, rel=1e-12)
    assert cache() == 2
    monkeypatch.setattr(library, "_processor", lambda: "a machine that shares the home folder")
    assert (stretched(), cache()) == (end, 3)
    monkeypatch.setattr(library, "FLAGS", [*library.FLAGS, "-DANOTHER"])
    assert (stretched(), cache()) == (end, 4)
    monkeypatch.setenv("CC", f"{' '.join(library.compiler())} -DTHIRD")
    assert (stretched(), cache()) == (end, 5)


@pytest.mark.parametrize(
    ("compiler", "says"),
    [
        ("/no/such/cc", "No such file or directory"),
        ("false", "exit code 1"),
        ("cc -include nothing.h", "error: nothing.h: No such file or directory"),
    ],
)
def test_a_broken_compiler_gives_one_line(cache, monkeypatch, compiler, says):
    """With its name and what it said, on every rank; and nothing is left behind."""
    monkeypatch.setenv("CC", compiler)
    with pytest.raises(RuntimeError) as error:
        stretched()
    (line,) = str(error.value).splitlines()
    assert line.startswith(f"the C compiler {compiler!r} failed: ")
    assert says in line
    assert cache() == 0
