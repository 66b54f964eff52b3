"""Whether a strain energy is isotropic, found by evaluating it."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_constants
from ufl.core.expr import Expr

from forms.cell_data import CellData, refresh
from forms.materials.base import StrainEnergy

SAMPLES = 4
TOLERANCE = 1e-9  # relative, well above the rounding errors of Ψ


def require_isotropic(psi: StrainEnergy, S: fem.Function, formulation: str) -> None:
    """Insist that Ψ(Q S Qᵀ) = Ψ(S) for rotations Q.

    Ψ is evaluated at each point of each cell, at random stretches and random rotations of them.
    Fields in Ψ, such as fibres or a former stretch, stand for any values that they may come to
    have, and so do constants that are zero: they are random, too. Collective.

    Args:
        psi: Strain energy density of S.
        S: The right stretch, for its points.
        formulation: Whose assumption it is, for the message.

    Raises:
        ValueError: On all ranks: Ψ depends on directions.
    """
    V = S.function_space
    d = S.ufl_shape[0]
    rng = np.random.default_rng(0)
    at = fem.Constant(V.mesh, np.eye(d))
    energy = psi(at)
    energy = ufl.replace(energy, {f: _random_like(f, rng, V) for f in _free(energy)})
    compiled = fem.Expression(energy, V.element.interpolation_points)
    index_map = V.mesh.topology.index_map(V.mesh.topology.dim)
    cells = np.arange(index_map.size_local, dtype=np.int32)

    def values(stretch: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        at.value[...] = stretch
        refresh([energy])
        return np.array(compiled.eval(V.mesh, cells), dtype=np.float64)

    pairs = []
    for _ in range(SAMPLES):
        Q, turn = _rotation(rng, d), _rotation(rng, d)
        stretch = Q @ np.diag(rng.uniform(0.7, 1.5, d)) @ Q.T
        pairs.append((values(stretch), values(turn @ stretch @ turn.T)))
    energies, turned = np.array(pairs).swapaxes(0, 1)
    size = np.abs(energies).max(axis=0)
    # Where Ψ has no value it says nothing.
    change = np.nan_to_num(np.abs(turned - energies) / np.where(size > 0.0, size, 1.0))
    if V.mesh.comm.allreduce(float(change.max(initial=0.0)), op=MPI.MAX) > TOLERANCE:
        raise ValueError(
            f"{formulation} holds for isotropic strain energies only, and this one depends on "
            "directions: Ψ(Q S Qᵀ) is not Ψ(S); choose another formulation, such as symmetric"
        )


def _free(energy: Expr) -> list[Expr]:
    """The fields, and the constants that are zero, which may have any value."""
    coefficients = extract_coefficients(energy)
    data = [c for c in coefficients if isinstance(c, CellData)]
    # What data are computed from has to be the same in the data and around them.
    bound = {c for d in data for c in extract_coefficients(d.argument)} | set(data)
    constants = [c for c in extract_constants(energy) if not np.any(c.value)]
    return [c for c in coefficients if c not in bound] + constants


def _random_like(f: Expr, rng: np.random.Generator, V: fem.FunctionSpace) -> Expr:
    """A random constant of the shape of f, tensors near the identity, numbers near 1."""
    shape = f.ufl_shape
    value = rng.normal(size=shape)
    if len(shape) == 2:
        value = np.eye(*shape) + 0.2 * (value + value.T)
    return fem.Constant(V.mesh, value if shape else rng.uniform(0.5, 1.5))


def _rotation(rng: np.random.Generator, d: int) -> npt.NDArray[np.float64]:
    """A random rotation, shape (d, d)."""
    Q = np.linalg.qr(rng.normal(size=(d, d)))[0]
    Q[:, 0] *= np.linalg.det(Q)
    return Q
