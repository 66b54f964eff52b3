"""The full Newton step (δx, δs, λ) from (35), from (41) and (36), and from the condensed system."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from demos.by_hand.basis import Array, IntArray
from demos.by_hand.seed import SeedSystem
from demos.by_hand.symmetric import SymmetricSystem
from demos.by_hand.system import DiscreteSystem

# Relative residual of a linear solve above which the matrix counts as singular.
RESIDUAL_TOLERANCE = 1e-8


@dataclass(frozen=True, eq=False)
class Step:
    """A Newton step.

    Attributes:
        dx: δx [m], flat, zero at fixed dofs.
        ds: δs, flat.
        lam: The new multiplier [Pa], flat; δλ is `lam - system.lam`.
    """

    dx: Array
    ds: Array
    lam: Array


def solve_kkt(system: DiscreteSystem, fixed: IntArray | None = None) -> Step:
    """Return the step of (35).

    The printed matrix (`SeedSystem` with eps = 0) is singular; the system is then solved for
    multipliers Λ = R Y, on the rows that these have. At a feasible state that is the solution of
    (35) with the smallest λ.

    Args:
        system: The system at the current iterate.
        fixed: Position dofs that do not move, none by default.

    Raises:
        numpy.linalg.LinAlgError: The matrix is singular.
    """
    matrix, rhs = system.kkt()
    sizes = (system.g_x.size, system.g_s.size)
    solution = _solve(matrix, rhs, sizes, fixed, system.multiplier_basis)
    dx, ds, lam = np.split(solution, np.cumsum(sizes))
    return Step(dx, ds, lam)


def solve_printed(system: SeedSystem) -> Step:
    """Return the solution of (35) with ε = 0 that has the smallest λ, at infeasible states too.

    There it is not the step of `solve_kkt`, which leaves out the rows of R skew: as printed these
    demand that cells do not turn.

    Raises:
        numpy.linalg.LinAlgError: There is no unique one.
    """
    matrix, rhs = system.kkt()
    sizes = (system.g_x.size, system.g_s.size)
    solution = _solve(matrix, rhs, sizes, None, system.determined_multipliers)
    return Step(*np.split(solution, np.cumsum(sizes)))


def solve_reduced(system: DiscreteSystem, fixed: IntArray | None = None) -> Step:
    """Return the step of (41) with δs by (36); arguments and errors as for `solve_kkt`."""
    matrix, rhs = system.reduced()
    sizes = (system.g_x.size,)
    solution = _solve(matrix, rhs, sizes, fixed, system.multiplier_basis)
    dx, lam = np.split(solution, sizes)
    return Step(dx, system.recover_ds(dx, lam), lam)


def solve_condensed(system: SymmetricSystem, fixed: IntArray | None = None) -> Step:
    """Return the step of the displacement-sized system; arguments and errors as for `solve_kkt`."""
    matrix, rhs = system.condensed()
    dx = _solve(matrix, rhs, (system.g_x.size,), fixed, None)
    ds, lam = system.recover(dx)
    return Step(dx, ds, lam)


def _solve(
    matrix: sp.csr_array,
    rhs: Array,
    sizes: tuple[int, ...],
    fixed: IntArray | None,
    multiplier_basis: sp.csr_array | None,
) -> Array:
    """Solve with fixed position dofs and the multipliers (after `sizes`) in a subspace."""
    free = np.ones(sizes[0], dtype=bool)
    if fixed is not None:
        free[np.asarray(fixed, dtype=np.int64)] = False
    blocks = [sp.eye_array(sizes[0], format="csc")[:, np.flatnonzero(free)]]
    blocks += [sp.eye_array(size) for size in sizes[1:]]
    multipliers = len(rhs) - sum(sizes)
    if multipliers:
        full = multiplier_basis is None
        blocks.append(sp.eye_array(multipliers) if full else multiplier_basis)
    prolong = sp.block_diag(blocks, format="csr")
    solution: Array = prolong @ _equilibrated_lu(prolong.T @ matrix @ prolong, prolong.T @ rhs)
    return solution


def _equilibrated_lu(matrix: sp.csr_array, rhs: Array) -> Array:
    """Solve a symmetric system; the blocks differ by stiffness, so scale rows and columns first."""
    scale = np.ones(matrix.shape[0])
    scaled = matrix
    for _ in range(4):
        largest = abs(scaled).max(axis=1).toarray().ravel()
        if np.any(largest == 0.0):
            raise np.linalg.LinAlgError("the matrix is singular: it has a zero row")
        scale /= np.sqrt(largest)
        scaled = sp.diags_array(scale) @ matrix @ sp.diags_array(scale)
    b = scale * rhs
    try:
        y = spla.splu(scaled.tocsc()).solve(b)
    except RuntimeError as error:
        raise np.linalg.LinAlgError(f"the matrix is singular: {error}") from error
    residual = np.linalg.norm(scaled @ y - b)
    size = np.linalg.norm(b)
    if not residual <= RESIDUAL_TOLERANCE * size:
        raise np.linalg.LinAlgError(
            f"the matrix is singular or nearly so: relative residual {residual / size:.1e}"
        )
    solution: Array = scale * y
    return solution
