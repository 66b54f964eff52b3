"""Units of the unknowns, in which the blocks of the first Jacobian have comparable entries."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.fem.petsc import assign

from forms import cell_not_finite
from solvers.layout import BlockLayout

Floats = npt.NDArray[np.float64]


class Unknowns:
    """The fields as one PETSc vector, each in a unit of its own; equations in the inverse unit.

    Attributes:
        layout: Their numbering.
        scales: The units, shape (fields,).
        D: The unit of each unknown.
        unscaled: The unknowns without units that `write` has put into the fields.
    """

    def __init__(self, fields: Sequence[fem.Function], layout: BlockLayout, x: PETSc.Vec) -> None:
        """Begin with units of one.

        Args:
            fields: The unknowns.
            layout: Their numbering.
            x: A vector of that layout.
        """
        self.layout, self._fields = layout, tuple(fields)
        self.scales: Floats = np.ones(len(fields))
        self.D, self.unscaled = x.duplicate(), x.duplicate()
        self.D.set(1.0)

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        self.D.destroy()
        self.unscaled.destroy()

    def set_scales(self, scales: Floats) -> None:
        """Change the units."""
        self.scales[:] = scales
        self.D.array_w[:] = np.repeat(self.scales, np.diff(self.layout.offsets))

    def read(self, x: PETSc.Vec) -> None:
        """Put the present values of the fields into a vector."""
        assign(self._fields, x)
        x.pointwiseDivide(x, self.D)

    def write(self, x: PETSc.Vec) -> None:
        """Put a vector into the fields, ghosts included. Collective."""
        v = self.unscaled
        v.pointwiseMult(x, self.D)
        for part in v.getNestSubVecs() if v.getType() == PETSc.Vec.Type.NEST else [v]:
            part.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        assign(v, self._fields)

    def norms(self, b: PETSc.Vec) -> dict[str, float]:
        """The norm of each field's part of a scaled residual, in the field's own units."""
        # Not np.dot, which wakes the threads of BLAS.
        sums = np.array([np.einsum("i,i", part, part) for part in self.layout.split(b.array_r)])
        norms = np.sqrt(self.layout.comm.allreduce(sums, op=MPI.SUM)) / self.scales
        return {f.name: float(n) for f, n in zip(self._fields, norms, strict=True)}

    def not_finite(self, b: PETSc.Vec) -> str:
        """In which field and cell a residual is no number, of cell-local fields if any. Collective.

        Returns:
            Such as "S in cell 12 (from 0)", by the number in the mesh file; empty if it is one.
        """
        parts = self.layout.split(b.array_r)
        for f, part in reversed(list(zip(self._fields, parts, strict=True))):
            if (cell := cell_not_finite(f.function_space, part)) is not None:
                return f"{f.name} in cell {cell} (from 0)"
        return ""

    def round_off(self, x: PETSc.Vec) -> float:
        """The scaled residual below which there is only rounding error.

        Entries of the scaled Jacobian are of order one, so that a perturbation of the unknowns by
        machine precision changes the scaled residual by machine precision times their norm. The
        displacement counts with the size of the body, whose positions are what rounding acts on.
        """
        V = self._fields[0].function_space
        size = self.size() / self.scales[0]
        norm = np.hypot(x.norm(), size * np.sqrt(V.dofmap.index_map.size_global))
        # A start that is no state is for Newton's method to report.
        return float(np.nan_to_num(np.finfo(float).eps * norm))

    def size(self) -> float:
        """The diagonal of the box around the body at rest [m]. Collective."""
        X = self._fields[0].function_space.mesh.geometry.x
        corners = np.concatenate([X.max(axis=0, initial=-np.inf), -X.min(axis=0, initial=np.inf)])
        self.layout.comm.Allreduce(MPI.IN_PLACE, corners, op=MPI.MAX)
        return float(np.linalg.norm(corners[:3] + corners[3:]))

    def largest_move(self, y: PETSc.Vec) -> float:
        """The largest component of the displacement [m] in a scaled step. Collective."""
        moves = self.layout.split(y.array_r)[0]
        largest = self.layout.comm.allreduce(np.abs(moves).max(initial=0.0), MPI.MAX)
        return float(largest * self.scales[0])


def equilibrate(entries: Floats) -> Floats:
    """Units in which blocks have comparable entries (Ruiz, RAL-TR-2001-034).

    Args:
        entries: A typical entry of each block of the Jacobian, shape (fields, fields), the
            displacement first.

    Returns:
        The unit of each field; ones where there is none that is finite.
    """
    # The cell-local fields among themselves first: a multiplier takes the unit of the Hessian
    # that it stands beside, whatever inertia adds to the displacement's own block.
    scales = np.ones(len(entries))
    local = np.s_[1:]
    for _ in range(50 if len(entries) > 1 else 0):
        block = scales[local, None] * entries[local, local] * scales[local]
        largest = block.max(axis=1)
        scales[local] /= np.sqrt(np.where(largest > 0.0, largest, 1.0))
    with np.errstate(divide="ignore"):
        scales[0] = 1.0 / max(np.sqrt(entries[0, 0]), *(entries[0, local] * scales[local]), 0.0)
    # A state without a Jacobian is for Newton's method to report, or all of u is given.
    return scales if np.isfinite(scales).all() else np.ones(len(entries))


def block_entries(A: PETSc.Mat, layout: BlockLayout) -> Floats:
    """Root mean square of the entries of each block of a Jacobian, shape (fields, fields)."""
    n = len(layout.offsets) - 1
    sums = np.zeros((2, n, n))
    if A.getType() == PETSc.Mat.Type.NEST:
        for f, g in np.ndindex(n, n):
            if block := A.getNestSubMatrix(f, g):
                indptr, _, values = block.getValuesCSR()
                sums[:, f, g] = _squares(values, _carries(indptr, values, f == g == 0))
    else:
        indptr, columns, values = A.getValuesCSR()
        row_field = np.repeat(np.arange(n), np.diff(layout.offsets))
        weight = _carries(indptr, values, row_field == 0)
        pair = np.repeat(row_field, np.diff(indptr)) * n + layout.fields_of(columns)
        for k, w in enumerate((weight * values**2, weight.astype(float))):
            sums[k] = np.bincount(pair, w, n * n).reshape(n, n)
    squares, counts = layout.comm.allreduce(sums, op=MPI.SUM)
    entries: Floats = np.sqrt(squares / np.maximum(counts, 1))
    return entries


def _carries(
    indptr: npt.NDArray[np.int32], values: Floats, may_be_given: bool | npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Which entries have a unit: not the identity rows of Dirichlet conditions, and no zeros."""
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    in_row = np.bincount(rows, values != 0, len(indptr) - 1)
    return ((in_row > 1) | ~np.asarray(may_be_given))[rows] & (values != 0)


def _squares(values: Floats, carries: npt.NDArray[np.bool_]) -> tuple[float, int]:
    return float(np.sum(values[carries] ** 2)), int(np.count_nonzero(carries))
