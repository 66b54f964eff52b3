"""Small bodies on which both sides are computed, and their states."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
from dolfinx import mesh

from demos.by_hand import Polar, State
from demos.by_hand.compare.assembly import Array
from meshes import Body, box
from meshes.raw import distribute

E = 10.0
"""Young's modulus [Pa]."""

BODIES = ("one tetrahedron", "12 tetrahedra, renumbered", "8 triangles, renumbered")


@dataclass(frozen=True)
class Setting:
    """What a state is computed with.

    Attributes:
        nu: Poisson's ratio [-].
        h: Time step [s].
    """

    nu: float
    h: float


STATES = {
    "rest": Setting(nu=0.3, h=0.4),
    "feasible": Setting(nu=0.3, h=0.4),
    "infeasible": Setting(nu=0.3, h=0.4),
    "inverted": Setting(nu=0.4999, h=0.013),
}
"""At rest; strained and turned with S = S(F) and Λ = R Y; the same with S and Λ at random; so, too,
with singular values of ratio 200 and det F < 0 in some cells, nearly incompressible."""

FEASIBLE = ("rest", "feasible")
"""The states in which S = S(F)."""


@dataclass(frozen=True, eq=False)
class TimeStep:
    """A state and all that a time step from it depends on.

    Attributes:
        iterate: The point of linearisation.
        start: Positions at the start of the time step [m], shape (n, d).
        velocity: Velocity there [m/s], shape (n, d).
        f_ext: External acceleration [m/s²], shape (n, d).
        rho: Density of each cell [kg/m³], shape (n_e,).
        nu: Poisson's ratio [-]; Young's modulus is `E`.
        h: Time step [s].
    """

    iterate: State
    start: Array
    velocity: Array
    f_ext: Array
    rho: Array
    nu: float
    h: float


def make_body(comm: MPI.Comm, name: str) -> Body:
    """One of `BODIES`, distributed. Collective."""
    if name == "one tetrahedron":
        X = np.array([[0.1, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 0.9, 0.1], [0.0, 0.2, 1.1]])
        cells = np.array([[2, 0, 3, 1]])
    else:
        X, cells = _renumbered_box((2, 1, 1) if "tetrahedra" in name else (2, 2))
    d = X.shape[1]
    if comm.rank > 0:
        X, cells = X[:0], cells[:0]
    kind = mesh.CellType.tetrahedron if d == 3 else mesh.CellType.triangle
    msh = distribute(comm, kind, cells.astype(np.int64), X)
    local = np.arange(len(msh.topology.original_cell_index), dtype=np.int32)
    return Body(msh, mesh.meshtags(msh, d, local, np.zeros(len(local), dtype=np.int32)))


def _renumbered_box(counts: tuple[int, ...]) -> tuple[Array, np.ndarray]:
    """A distorted box with vertices, cells and their corners in random order."""
    body = box(MPI.COMM_SELF, (2.0, 1.0, 1.0)[: len(counts)], counts)
    rng = np.random.default_rng(1)
    X = np.empty((body.num_vertices, len(counts)))
    vertices = rng.permutation(body.num_vertices)
    X[vertices[body.mesh.geometry.input_global_indices]] = body.mesh.geometry.x[:, : len(counts)]
    X += rng.uniform(-0.08, 0.08, X.shape)
    cells = rng.permutation(vertices[body.file_connectivity()])
    return X, rng.permuted(cells, axis=1)


def rest_state(body: Body) -> State:
    """X and the cells of a body in file order, at rest, on every rank. Collective."""
    X = np.asarray(body.gather_points(everywhere=True))
    cells = np.asarray(body.gather(body.file_connectivity(), everywhere=True))
    return State.at_rest(X, cells)


def make_state(rest: State, kind: str, formulation: str, stress: float) -> State:
    """A body at rest, or in a random state far from rest.

    Args:
        rest: The body at rest.
        kind: One of `STATES`.
        formulation: Name of the formulation, which says what the multiplier is.
        stress: Size of the multiplier [Pa].
    """
    if kind == "rest":
        return rest
    rng = np.random.default_rng(list(STATES).index(kind))
    n, d = len(rest.cells), rest.X.shape[1]
    turn = Polar(rng.standard_normal((2, d, d))).R
    gradient = turn[0] @ (np.eye(d) + rng.uniform(-0.2, 0.2, (d, d)))
    noise = rng.uniform(-0.06, 0.06, rest.X.shape)
    if kind == "inverted":
        stretches = np.diag([4.0, 0.5, -0.02] if d == 3 else [4.0, -0.02])
        gradient = turn[0] @ stretches @ turn[1]
        noise *= n > 1  # of one cell the ratio is to be just so
    x = rest.X @ gradient.T + noise
    edges, deformed = (p[rest.cells[:, 1:]] - p[rest.cells[:, :1]] for p in (rest.X, x))
    polar = Polar(np.swapaxes(np.linalg.solve(edges, deformed), 1, 2))
    Y = stress * rng.uniform(-1.0, 1.0, (n, d, d))
    Y = 0.5 * (Y + np.swapaxes(Y, 1, 2))
    S, Lam = polar.S_F, polar.R @ Y
    if kind != "feasible":
        S = S + 0.2 * rng.uniform(-1.0, 1.0, S.shape)
        Lam = stress * rng.uniform(-1.0, 1.0, Lam.shape)
    S = 0.5 * (S + np.swapaxes(S, 1, 2))
    return replace(rest, x=x, S=S, Lam=Y if formulation == "symmetric" else Lam)


def make_step(rest: State, kind: str, formulation: str) -> TimeStep:
    """A state and a time step from it, with loads and densities at random.

    Args:
        rest: The body at rest.
        kind: One of `STATES`.
        formulation: Name of the formulation, which says what the multiplier is.
    """
    state = make_state(rest, kind, formulation, stress=0.4 * E)
    rng = np.random.default_rng(20 + list(STATES).index(kind))
    start, velocity = state.x, np.zeros_like(state.x)
    if kind != "rest":
        start = state.x + rng.uniform(-0.1, 0.1, state.x.shape)
        velocity = rng.uniform(-1.0, 1.0, state.x.shape)
    d = rest.X.shape[1]
    f_ext = np.array([3.0, -9.81, 1.0])[:d] + rng.uniform(-2.0, 2.0, state.x.shape)
    rho = rng.uniform(0.5, 3.5, len(rest.cells))
    setting = STATES[kind]
    return TimeStep(state, start, velocity, f_ext, rho, setting.nu, setting.h)
