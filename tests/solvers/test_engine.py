"""The engine gives the Newton system of UFL's forms, condensed: for every energy of the package.

UFL's derivatives of a density are compiled on P1 simplices; `tests.pointwise` puts them together on
other cells and for other degrees, as DOLFINx's own assembly confirms.
"""

from __future__ import annotations

from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem, la

from forms import FORMULATIONS, MATERIALS, measure
from solvers.engine import library
from solvers.engine.system import EngineProblem
from solvers.layout import BlockLayout
from tests.bodies import NU, UNDEFINED, E, Switch, largest
from tests.pointwise import PointSystems, Reference
from tests.states import dense, random_directions, random_values, small_mesh

COMM = MPI.COMM_WORLD
CELLS = {
    "triangle": (2, True),
    "quadrilateral": (2, False),
    "tetrahedron": (3, True),
    "hexahedron": (3, False),
}
FEW = ("stable-neo-hookean", "hencky")
# They know FᵀF alone, which has no square root that is smooth at det F = 0.
POSITIVE = ("hu-washizu", "log-strain")


@pytest.fixture(scope="module")
def systems():
    """UFL's derivatives at points, with materials behind switches, compiled when asked for."""

    @cache
    def compiled(formulation, d):
        materials = materials_with(formulation, d)
        return PointSystems(formulation, d, lambda msh: Switch(msh, tuple(materials)))

    return compiled


MULTIPLIERS = ("Y", "Lam", "Sigma", "T", "p")


def materials_with(formulation, d):
    """All of them in 2D, and in 3D with `symmetric`; one of logarithms where there are others."""
    if d == 2 or formulation == "symmetric":
        return MATERIALS
    return FEW if formulation in ("displacement", *POSITIVE) else FEW[:1]


class Case:
    """A formulation on some cells, by both routes."""

    def __init__(self, systems, formulation, cell, degree):
        d, simplices = CELLS[cell]
        self.systems, self.formulation = systems(formulation, d), formulation
        msh = small_mesh(d, simplices=simplices)
        form = FORMULATIONS[formulation]
        self.fields = form.fields(msh, degree)
        materials = materials_with(formulation, d)
        if degree > 1 or cell not in ("triangle", "tetrahedron"):
            materials = [name for name in materials if name in FEW]
        self.psi = Switch(msh, tuple(materials))
        self.energy = form.density(*self.fields, self.psi) * measure(self.fields[0])
        self.at_rest = [f.x.array.copy() for f in self.fields]
        self.reference = Reference(self.systems, self.fields)

    def states(self):
        """Put states far from rest into the fields, and yield their names."""
        for material in self.psi.materials:
            for name in ("moved", "rotated", "incompressible", "inverted"):
                if name == "inverted" and (material in UNDEFINED or self.formulation in POSITIVE):
                    continue
                for psi in (self.psi, self.systems.psi):
                    psi.select(material, E, 0.4999 if name == "incompressible" else NU)
                self.move(name)
                yield f"{material}, {name}"

    def move(self, name):
        # Near incompressibility a change of volume takes so much energy that it must be small.
        far = 0.02 if name == "incompressible" else 0.5
        changes = random_directions(self.fields, stress=E)
        for f, values, change in zip(self.fields, self.at_rest, changes, strict=True):
            f.x.array[:] = values + (0.5 if f.name in MULTIPLIERS else far) * change
        u = self.fields[0]
        d = len(u)
        X = u.function_space.tabulate_dof_coordinates()[:, :d]
        x = u.x.array.reshape(-1, d)
        x *= 0.8 * far / largest(self.reference.deformation_gradients() - np.eye(d))
        x += X
        if name == "rotated":
            x[:] = x @ rotation(d).T
        if name == "inverted":
            x[:, 0] -= 0.75 * X[:, 0] ** 2  # F_xx = 1 - 1.5 X
        x -= X
        self.reference.update()
        det = np.linalg.det(self.reference.F)
        counts = COMM.allreduce(np.array([np.sum(det < 0), np.sum(det > 0)]))
        assert all(counts > 0) if name == "inverted" else counts[0] == 0


def rotation(d):
    """By 2 radians, in 3D about a skew axis."""
    c, s = np.cos(2.0), np.sin(2.0)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    if d == 2:
        return turn[:2, :2]
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    return Q @ turn @ Q.T


def summed(f, dofs, values):
    """Contributions of this rank's cells to its owned dofs, those of other ranks' cells added."""
    total = fem.Function(f.function_space)
    np.add.at(total.x.array, dofs, values)
    total.x.scatter_reverse(la.InsertMode.add)
    return total.x.array[: owned(f)].copy()


def owned(f):
    dofmap = f.function_space.dofmap
    return dofmap.index_map.size_local * dofmap.index_map_bs


def assembled(fields, dofs, cells):
    """The matrix of some fields on all ranks, given those of this rank's cells."""
    layout = BlockLayout(fields)
    numbers = np.hstack([layout.numbers(k, at.astype(np.int32)) for k, at in enumerate(dofs)])
    size = COMM.allreduce(int(layout.offsets[-1]))
    whole = np.zeros((size, size))
    np.add.at(whole, (numbers[:, :, None], numbers[:, None, :]), cells)
    return COMM.allreduce(whole)


def error(mine, theirs):
    """Largest difference relative to the largest number, on all ranks."""
    return largest(mine - theirs) / max(largest(theirs), np.finfo(float).tiny)


def errors(engine, reference, fields):
    """How far the engine is from the reference at the present state."""
    found = {"energy": error(engine.energy(), COMM.allreduce(reference.energy))}
    engine.residual(engine.b)
    right = engine.b.array_r.copy()
    parts = engine.layout.split(right)
    for f, mine, dofs, theirs in zip(
        fields, parts, reference.dofs, reference.split(reference.residual), strict=True
    ):
        found[f"residual of {f.name}"] = error(mine, summed(f, dofs, theirs))
    engine.condense(right)
    assert engine.singular == []
    shared = [fields[k] for k in engine.shared]
    dofs = [reference.dofs[k] for k in engine.shared]
    found["matrix"] = error(dense(engine.K), assembled(shared, dofs, reference.condensed()))
    if len(shared) == len(fields):
        return found
    # Right-hand sides of local dofs are where the dofs are, on cells of their own.
    local = [np.zeros_like(f.x.array) for f in fields]
    for values, part in zip(local, parts, strict=True):
        values[: len(part)] = part
    local = reference.on_cells(local)
    g = [np.zeros_like(f.x.array) for f in shared]
    engine.eliminate(right, g)
    for f, mine, at, theirs in zip(
        shared, g, dofs, reference.split(reference.eliminated(local), engine.shared), strict=True
    ):
        mine = summed(f, np.arange(len(mine)), mine)
        found[f"elimination into {f.name}"] = error(mine, summed(f, at, theirs))
    step = [np.zeros_like(f.x.array) for f in fields]
    for k in engine.shared:
        step[k][:] = random_values(fields[k], 20 + k)
    x = np.zeros(len(right))
    engine.recover(right, [step[k] for k in engine.shared], x)
    rest = [k for k in range(len(fields)) if k not in engine.shared]
    recovered = reference.split(reference.recovered(local, reference.on_cells(step)), rest)
    for k, theirs in zip(rest, recovered, strict=True):
        mine = engine.layout.split(x)[k]
        found[f"step of {fields[k].name}"] = error(
            mine, summed(fields[k], reference.dofs[k], theirs)
        )
    return found


def check(case, tolerance=1e-11):
    """Both routes give the same at every state."""
    engine = EngineProblem(case.energy, case.fields, [], "test_engine_")
    worst = {}
    for name in case.states():
        for what, value in errors(engine, case.reference, case.fields).items():
            worst[f"{what}, {name}"] = value
    engine.destroy()
    far = {what: value for what, value in worst.items() if not value < tolerance}
    assert not far
    return worst


# All formulations on P1 simplices, where a point is a cell, and three on each other element.
CASES = [(f, c, 1) for c in ("triangle", "tetrahedron") for f in FORMULATIONS]
CASES += [
    (f, c, k)
    for c in CELLS
    for k in (1, 2)
    for f in ("symmetric", "mean-dilatation", "taylor-hood")
    if (f, c, k) not in CASES
]


@pytest.mark.serial
@pytest.mark.parametrize(("formulation", "cell", "degree"), CASES)
def test_agrees_with_ufl(systems, formulation, cell, degree):
    """Energy, residual, condensed matrix, elimination and recovery, at states far from rest.

    On triangles of degree 1 with every material, and `symmetric` on tetrahedra; elsewhere with one
    that has a value where det F < 0, and on some one of logarithms.
    """
    check(Case(systems, formulation, cell, degree))


@pytest.mark.serial
def test_agrees_as_it_is_shipped(systems, monkeypatch):
    """Optimised and in vectors, where the other tests spare the seconds of the compiler."""
    assert library._flags() != library.FLAGS
    monkeypatch.setattr(library, "_flags", lambda: library.FLAGS)
    check(Case(systems, "displacement", "tetrahedron", 1))


PROJECTIONS = {1: lambda values: np.maximum(values, 0.0), 2: np.abs}


@pytest.mark.serial
@pytest.mark.parametrize(
    ("formulation", "cell", "degree"),
    [
        ("displacement", "tetrahedron", 1),
        ("symmetric", "quadrilateral", 1),
        ("mean-dilatation", "triangle", 2),
    ],
)
def test_projected_tangents(systems, formulation, cell, degree):
    """Negative eigenvalues to zero or to their absolute values, as NumPy finds them."""
    case = Case(systems, formulation, cell, degree)
    engine = EngineProblem(case.energy, case.fields, [], "test_engine_")
    dofs, indefinite = case.reference.dofs[:1], 0
    for name in case.states():
        engine.residual(engine.b)
        plain = assembled(case.fields[:1], dofs, case.reference.condensed())
        for mode, modify in PROJECTIONS.items():
            engine.condense(engine.b.array_r, mode)
            expected = case.reference.projected(modify)
            assert np.linalg.eigvalsh(expected).min() > -1e-12 * largest(expected)
            expected = assembled(case.fields[:1], dofs, expected)
            assert error(dense(engine.K), expected) < 1e-11, (name, mode)
            indefinite += error(plain, expected) > 1e-3
    engine.destroy()
    assert indefinite >= 2


@pytest.mark.serial
@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
def test_second_derivatives_where_cells_are_inverted(systems, formulation):
    """Against differences of the residual, which know no second derivative.

    Along a change of u and the changes of local fields that are recovered for it, the residual of
    u changes by K δu, and that of local fields does not change.
    """
    case = Case(systems, formulation, "tetrahedron", 1)
    engine = EngineProblem(case.energy, case.fields, [], "test_engine_")
    for material in set(case.psi.materials) - set(UNDEFINED):
        case.psi.select(material, E, NU)
        case.move("inverted")
        engine.residual(engine.b)
        nothing = np.zeros_like(engine.b.array_r)
        engine.condense(nothing)
        assert engine.singular == []
        du = random_values(case.fields[0], 30)
        x = nothing.copy()
        engine.recover(nothing, [du.copy()], x)
        along = engine.layout.split(x)
        along[0][:] = du
        start, eps = [f.x.array.copy() for f in case.fields], 1e-4

        def residual(step, along=along, start=start):
            for f, values, change in zip(case.fields, start, along, strict=True):
                f.x.array[:] = values + step * change
            engine.residual(engine.b)
            return engine.b.array_r.copy()

        near, far = (residual(k * eps) - residual(-k * eps) for k in (1, 2))
        found = engine.layout.split((8 * near - far) / (12 * eps))
        force = dense(engine.K) @ du
        assert largest(found[0] - force) < 1e-7 * largest(force), material
        for change in found[1:]:
            assert largest(change) < 1e-7 * largest(force), material
    engine.destroy()
