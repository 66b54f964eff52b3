"""What UFL says: energies and blocks on small bodies, at several states, as plain arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from demos.compare_assembly import FIELDS, Array, Assembler, Derivatives, Functional
from demos.progress import Screen
from forms import (
    FORMULATIONS,
    MATERIALS,
    BackwardEuler,
    deformation_gradient,
    polar_rotation,
    seed_singular,
    symmetric,
)
from forms.discrete import MATERIALS as WITNESSED
from forms.discrete import Polar, State, symmetric_basis, symmetric_dofs
from meshes import Body, box
from meshes.raw import distribute
from solvers import ConvergenceError, MixedProblem
from solvers.layout import BlockLayout

E, NU, RHO, H = 10.0, 0.3, 2.0, 0.4  # [Pa], [-], [kg/m³], [s]
ACCELERATION = (0.0, -9.81, 1.0)  # f_ext [m/s²]

STATES = ("rest", "feasible", "infeasible")
SYSTEMS = ("seed", "symmetric")
BODIES = ("one tetrahedron", "12 tetrahedra, renumbered")


@dataclass(frozen=True, eq=False)
class Case:
    """One body, formulation, material and state, with all that UFL gives there.

    Arrays are numbered as in `forms.discrete`. Increments and results of a step are dicts by the
    letter of the field, flat.

    Attributes:
        names: Body, formulation, material and state.
        iterate: The point of linearisation.
        start: Positions at the start of the time step [m].
        velocity: Velocity at the start of the time step [m/s].
        unknowns: (x, s, λ) of the iterate.
        delta: An arbitrary increment (δx, δs, δλ).
        kinetic: E_M.
        elastic: E_Ψ.
        constraint: E_Λ, that is minus the multiplier's term of the energy.
        total: The energy of which the solver takes the derivatives.
        moved: That energy at the iterate plus `delta` [J].
        first_iteration: E_M and ∂E_M/∂x at the iterate plus δx if the step starts at the iterate.
        kinematics: Cell by cell and times V_K: RS, F, J, R, dR, W, W_hat. Seed only.
        newton: The new (x, s, λ) less the old (x, s), by PETSc from the solver's own forms.
    """

    names: tuple[str, str, str, str]
    iterate: State
    start: Array
    velocity: Array
    unknowns: Mapping[str, Array]
    delta: Mapping[str, Array]
    kinetic: Derivatives
    elastic: Derivatives
    constraint: Derivatives
    total: Derivatives
    moved: float
    first_iteration: tuple[float, Array]
    kinematics: Mapping[str, Array]
    newton: Mapping[str, Array]


def ufl_cases(
    comm: MPI.Comm,
    screen: Screen,
    bodies: tuple[str, ...] = BODIES,
    materials: tuple[str, ...] = tuple(WITNESSED),
) -> list[Case]:
    """Assemble every case, the same on all ranks. Collective."""
    cases: list[Case] = []
    kinds = list(product(bodies, SYSTEMS))
    for k, (body, formulation) in enumerate(kinds):
        screen.progress("UFL", k, len(kinds), f"next: {formulation}, {body}")
        side = _Side(comm, body, formulation)
        for material in materials:
            cases += side.cases(material)
    screen.progress("UFL", len(kinds), len(kinds))
    return cases


def renumbered_box() -> tuple[Array, np.ndarray]:
    """A distorted box of 12 tetrahedra with vertices, cells and their corners in random order."""
    body = box(MPI.COMM_SELF, (2.0, 1.0, 1.0), (2, 1, 1))
    rng = np.random.default_rng(1)
    X = np.empty((body.num_vertices, 3))
    vertices = rng.permutation(body.num_vertices)
    X[vertices[body.mesh.geometry.input_global_indices]] = body.mesh.geometry.x
    X += rng.uniform(-0.08, 0.08, X.shape)
    cells = rng.permutation(vertices[body.file_connectivity()])
    return X, rng.permuted(cells, axis=1)


def make_body(comm: MPI.Comm, name: str) -> Body:
    """One of `BODIES`, distributed."""
    if name == "one tetrahedron":
        X = np.array([[0.1, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 0.9, 0.1], [0.0, 0.2, 1.1]])
        cells = np.array([[2, 0, 3, 1]])
    else:
        X, cells = renumbered_box()
    if comm.rank > 0:
        X, cells = np.empty((0, 3)), np.empty((0, 4), dtype=np.int64)
    msh = distribute(comm, mesh.CellType.tetrahedron, cells.astype(np.int64), X)
    local = np.arange(len(msh.topology.original_cell_index), dtype=np.int32)
    return Body(msh, mesh.meshtags(msh, 3, local, np.zeros(len(local), dtype=np.int32)))


def rest_state(body: Body, assembler: Assembler) -> State:
    """X and the cells of a body in file order, at rest, on every rank. Collective."""
    geometry, comm = body.mesh.geometry, body.mesh.comm
    X = np.empty((body.num_vertices, geometry.dim))
    cells = np.empty((body.num_cells, geometry.dim + 1), dtype=np.int64)
    nodes = geometry.index_map().size_local
    mine = (
        (geometry.input_global_indices[:nodes], geometry.x[:nodes, : geometry.dim]),
        (body.file_cells, body.file_connectivity()),
    )
    for vertices, corners in comm.allgather(mine):
        X[vertices[0]], cells[corners[0]] = vertices[1], corners[1]
    return State.at_rest(X, cells)


def make_state(rest: State, kind: str, formulation: str, stress: float) -> State:
    """At rest, or random: far from rest, rotated, and feasible (S = S(F), Λ = R Y) or not.

    Args:
        rest: The body.
        kind: One of `STATES`.
        formulation: Name of the formulation, which says what the multiplier is.
        stress: Size of the multiplier [Pa].
    """
    if kind == "rest":
        return rest
    rng = np.random.default_rng(STATES.index(kind))
    n = len(rest.cells)
    turn = Polar(rng.standard_normal((1, 3, 3))).R[0]
    gradient = turn @ (np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3)))
    x = rest.X @ gradient.T + rng.uniform(-0.06, 0.06, rest.X.shape)
    edges, deformed = (p[rest.cells[:, 1:]] - p[rest.cells[:, :1]] for p in (rest.X, x))
    polar = Polar(np.swapaxes(np.linalg.solve(edges, deformed), 1, 2))
    Y = stress * rng.uniform(-1.0, 1.0, (n, 3, 3))
    Y = 0.5 * (Y + np.swapaxes(Y, 1, 2))
    S, Lam = polar.S, polar.R @ Y
    if kind == "infeasible":
        S = S + 0.2 * rng.uniform(-1.0, 1.0, S.shape)
        Lam = stress * rng.uniform(-1.0, 1.0, Lam.shape)
    S = 0.5 * (S + np.swapaxes(S, 1, 2))
    return replace(rest, x=x, S=S, Lam=Y if formulation == "symmetric" else Lam)


class _Side:
    """UFL's side of one body and formulation."""

    def __init__(self, comm: MPI.Comm, body: str, formulation: str) -> None:
        self._names = (body, formulation)
        self._body = make_body(comm, body)
        self._assembler = Assembler(self._body)
        self._fields = u, S, Lam = FORMULATIONS[formulation].fields(self._body.mesh)
        self._scheme = BackwardEuler(u, H, ACCELERATION)
        without_psi = {"seed": seed_singular, "symmetric": symmetric}[formulation]
        constraint = -without_psi(u, S, Lam, lambda S: ufl.as_ufl(0)) * ufl.dx
        self._kinetic = Functional.of(self._scheme.kinetic(RHO) * ufl.dx, self._fields)
        self._constraint = Functional.of(constraint, self._fields)
        self._kinematics = _Kinematics(*self._fields) if formulation == "seed" else None

    def cases(self, material: str) -> Iterator[Case]:
        """Assemble at every state."""
        psi = MATERIALS[material](E, NU)
        S = self._fields[1]
        elastic = Functional.of(psi(S) * ufl.dx, self._fields)
        density = FORMULATIONS[self._names[1]].density(*self._fields, psi)
        energy = density * ufl.dx + self._scheme.kinetic(RHO) * ufl.dx
        problem = MixedProblem(energy, self._fields, solver="direct")
        compiled: Any = problem.problem
        total = Functional(fem.form(energy), compiled.F, compiled.J, self._fields)
        rest = rest_state(self._body, self._assembler)
        for kind in STATES:
            state = make_state(rest, kind, self._names[1], psi.mu)
            yield self._case((*self._names, material, kind), state, elastic, total, problem)

    def _case(
        self,
        names: tuple[str, str, str, str],
        state: State,
        elastic: Functional,
        total: Functional,
        problem: MixedProblem,
    ) -> Case:
        kind = names[3]
        rng = np.random.default_rng(10 + STATES.index(kind))
        start, velocity = state.x, np.zeros_like(state.x)
        if kind != "rest":
            start = state.x + rng.uniform(-0.1, 0.1, state.x.shape)
            velocity = rng.uniform(-1.0, 1.0, state.x.shape)
        now = self._unknowns(state)
        sizes = dict(zip(FIELDS, (0.1, 0.2, E), strict=True))
        delta = {i: sizes[i] * rng.uniform(-1.0, 1.0, now[i].shape) for i in FIELDS}
        later = {i: now[i] + delta[i] for i in FIELDS}
        put, at = self._assembler.put, self._assembler
        put(self._scheme.v, velocity)
        self._set(later, state.X, state.x)
        first_iteration = self._kinetic.at(at)
        self._set(later, state.X, start)
        problem.refresh()
        moved = total.at(at).value
        self._set(now, state.X, start)
        problem.refresh()
        return Case(
            names,
            state,
            start,
            velocity,
            now,
            delta,
            kinetic=self._kinetic.at(at),
            elastic=elastic.at(at),
            constraint=self._constraint.at(at),
            total=total.at(at),
            moved=moved,
            first_iteration=(first_iteration.value, first_iteration.first["x"]),
            kinematics=self._kinematics.at(at) if self._kinematics else {},
            newton=self._newton(problem, now, state.X),
        )

    def _unknowns(self, state: State) -> dict[str, Array]:
        full = self._names[1] == "seed"
        Lam = state.Lam.ravel() if full else symmetric_dofs(state.Lam).ravel()
        return {"x": state.x.ravel(), "s": state.s.ravel(), "l": Lam}

    def _set(self, unknowns: Mapping[str, Array], X: Array, start: Array) -> None:
        put, (u, S, Lam) = self._assembler.put, self._fields
        put(u, unknowns["x"] - X.ravel())
        put(S, unknowns["s"])
        put(Lam, unknowns["l"])
        put(self._scheme.u_old, start - X)

    def _newton(
        self, problem: MixedProblem, now: Mapping[str, Array], X: Array
    ) -> dict[str, Array]:
        """One iteration of the solver."""
        before = [f.x.array.copy() for f in self._fields]
        snes = problem.problem.solver
        snes.setTolerances(max_it=1)
        snes.setForceIteration(True)
        try:
            problem.solve()
        except ConvergenceError as error:  # PETSc's name for having stopped after one
            if error.result.reason != "DIVERGED_MAX_IT":
                raise
        parts = BlockLayout(self._fields).split(problem.problem.x.array_r)
        new = {
            i: self._assembler.gather(f.function_space, part.copy())
            for i, f, part in zip(FIELDS, self._fields, parts, strict=True)
        }
        for f, values in zip(self._fields, before, strict=True):
            f.x.array[:] = values
        return {"x": new["x"] + X.ravel() - now["x"], "s": new["s"] - now["s"], "l": new["l"]}


class _Kinematics:
    """Cell by cell, times V_K: what the full DG0 matrices of Λ test."""

    def __init__(self, u: fem.Function[Any], S: fem.Function[Any], Lam: fem.Function[Any]) -> None:
        T = ufl.TestFunction(Lam.function_space)
        du, dS = (ufl.TrialFunction(f.function_space) for f in (u, S))
        self._spaces = {i: f.function_space for i, f in zip(FIELDS, (u, S, Lam), strict=True)}
        self._B = fem.Constant(u.function_space.mesh, np.zeros((3, 3)))
        R, F = polar_rotation(u), deformation_gradient(u)

        def against(tensor: Expr) -> fem.Form:
            return fem.form(ufl.inner(tensor, T) * ufl.dx)

        self._vectors = {"RS": against(R * S), "F": against(F), "R": against(R)}
        self._matrices = {
            "J": (against(ufl.derivative(F, u, du)), "x"),
            "dR": (against(ufl.derivative(R, u, du)), "x"),
            "W": (against(R * dS), "s"),
        }
        self._W_hat = against(ufl.derivative(R * self._B, u, du))

    def at(self, assembler: Assembler) -> dict[str, Array]:
        """Assemble; W_hat has a matrix for each dof of S."""
        V = self._spaces["l"]
        arrays = {name: assembler.vector(form, V) for name, form in self._vectors.items()}
        for name, (form, i) in self._matrices.items():
            arrays[name] = assembler.matrix(form, V, self._spaces[i])
        W_hat = []
        for B in symmetric_basis(3):
            self._B.value[:] = B
            W_hat.append(assembler.matrix(self._W_hat, V, self._spaces["x"]))
        arrays["W_hat"] = np.array(W_hat)
        return arrays
