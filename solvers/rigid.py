"""Rigid motions that nothing resists, to name them where a solve fails for want of support."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import scipy
from dolfinx import fem

from solvers.newton import Newton

Floats = npt.NDArray[np.float64]

BENT, MOVED = 1e-3, 0.1
"""Of the body's size, how far it is deformed, and moved to see whether something resists."""

FREE = 1e-10
"""Of the forces of that deformation, what those of a free motion may be."""

PLANES = {2: [(0, 1)], 3: [(1, 2), (2, 0), (0, 1)]}
"""Axes that rotations turn towards one another: about z, or about x, y and z."""


def free_motions(newton: Newton, bcs: Sequence[fem.DirichletBC]) -> str:
    """Name the rigid motions from the present state that nothing resists. Collective.

    The fields do not keep their values.

    No Dirichlet condition, inertia or spring: the residual stays what it is, to a precision that
    inertia may be below beside a very large stiffness.

    Args:
        newton: Newton's method; the fields are where a solve begins, the displacement first.
        bcs: Its Dirichlet conditions.

    Returns:
        Such as "moving along x and turning about z"; empty if all are resisted, or the present
        state is none.
    """
    u = newton.system.fields[0]
    V, comm, d = u.function_space, u.function_space.mesh.comm, len(u)
    nodes = V.dofmap.index_map.size_local
    before = u.x.array.copy()
    x = V.tabulate_dof_coordinates()[:, :d] + before.reshape(-1, d)
    r = x - comm.allreduce(x[:nodes].sum(axis=0)) / V.dofmap.index_map.size_global
    size = float(comm.allreduce(np.abs(r).max(initial=0.0), MPI.MAX))
    generators = np.zeros((d + len(PLANES[d]), d + 1, d + 1))  # of r -> A r + a
    for i in range(d):
        generators[i, i, d] = size
    for k, (i, j) in enumerate(PLANES[d], start=d):
        generators[k, j, i], generators[k, i, j] = 1.0, -1.0

    def moved(motion: Floats) -> Floats:
        A = scipy.linalg.expm(np.tensordot(MOVED * motion, generators, 1))
        return (r @ A[:d, :d].T + A[:d, d] - r).ravel()

    def forces(change: Floats) -> Floats:
        u.x.array[:] = before + change
        b = newton.system.b
        state = b.duplicate()
        newton.system.unknowns.read(state)
        with newton.evaluation("residual", state):
            newton.system.residual(b)
        state.destroy()
        return np.array(b.array_r)

    if not comm.allreduce(bool(np.isfinite(before).all()), MPI.LAND):
        return ""
    held = np.zeros(before.size, dtype=bool)
    for bc in bcs:
        if V._cpp_object.contains(bc.function_space):
            held[bc.dof_indices()[0]] = True
    every = np.eye(len(generators))
    velocities = np.array([(r @ g[:d, :d].T + g[:d, d]).ravel()[held] for g in generators])
    free = _vanishing(velocities, 1e-9 * size * np.sqrt(before.size), comm) @ every
    bent = BENT * size * np.cos(np.arange(before.size))
    bent[held] = 0.0
    there = forces(np.zeros_like(before))
    if not comm.allreduce(bool(np.isfinite(there).all()), MPI.LAND):
        return ""
    stiff = np.sqrt(comm.allreduce(np.sum((forces(bent) - there) ** 2)))
    changes = np.array([forces(moved(motion)) - there for motion in free])
    free = _vanishing(changes, FREE * stiff, comm) @ free if len(free) else free
    return _named(free, d)


def _vanishing(rows: Floats, tolerance: float, comm: MPI.Comm) -> Floats:
    """Combinations of rows that are below a tolerance, as rows of coefficients. Collective."""
    parts = comm.allgather(np.linalg.qr(rows.T, mode="r"))
    _, sizes, combinations = np.linalg.svd(np.vstack([*parts, np.zeros((1, len(rows)))]))
    return np.asarray(combinations[np.sum(sizes > tolerance) :])


def _named(motions: Floats, d: int) -> str:
    """Translations among the motions, then the axes that others turn about."""
    if not len(motions):
        return ""
    shifts = _vanishing(motions[:, d:], 1e-6, MPI.COMM_SELF) @ motions
    spins = np.linalg.svd(motions[:, d:])[2][: len(motions) - len(shifts)]
    names = ("z",) if d == 2 else ("x", "y", "z")
    said = [
        f"{verb} {_axes(rows, axes)}"
        for verb, rows, axes in (
            ("moving along", shifts[:, :d], ("x", "y", "z")),
            ("turning about", spins, names),
        )
        if len(rows)
    ]
    return " and ".join(said)


def _axes(rows: Floats, names: Sequence[str]) -> str:
    """The axes that rows span, or else their directions."""
    projection = rows.T @ np.linalg.pinv(rows.T)
    found = [name for name, e in zip(names, np.diag(projection), strict=False) if e > 1 - 1e-6]
    if len(found) < len(rows):
        found = [f"({', '.join(f'{v:.2g}' for v in row)})" for row in rows]
    return ", ".join(found)
