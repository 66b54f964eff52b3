r"""Static condensation of cell-local fields, as a preconditioner that is an exact solver.

The Newton system in a displacement u and cell-local fields l,

    ( J_uu  J_ul ) ( δu )   ( b_u )
    ( J_lu  J_ll ) ( δl ) = ( b_l ),

has a J_ll with one dense block D a cell, or one a quadrature point if all of l lives at such
points, so that with B the rows of J_lu of that cell or point

    K = J_uu - Σ_K Bᵀ D⁻¹ B,   K δu = b_u - Σ_K Bᵀ D⁻¹ b_l,   δl = D⁻¹ (b_l - B δu).

K has the size and the sparsity of a displacement method's matrix. For the seed's system this does
eqs. (36) and (41) in one elimination. Everything is read off the assembled Jacobian of whatever
energy there is: a row of a cell-local unknown couples with the dofs of its own cell alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
from dolfinx import fem, la
from dolfinx.fem.petsc import create_vector

from solvers.layout import BlockLayout, Ints, require_local
from solvers.options import FACTORISE_UP_TO, FORCING_LIMITS, KEEP_WHILE, MODEST

Floats = npt.NDArray[np.float64]


class CondensedBlocks(Protocol):
    """Elimination of the cell-local unknowns of a Newton system.

    Attributes:
        K: The condensed matrix.
    """

    K: PETSc.Mat

    def update(self, A: PETSc.Mat) -> Sequence[int]:
        """Condense the current Jacobian into K. Collective.

        Returns:
            Where there is no condensed system, the numbers of the fields whose local block is
            singular, the same on all ranks.
        """

    def project(self) -> bool:
        """Put a positive semi-definite stand-in into K, if there is one. Collective."""

    def eliminate(self, b: Floats, g: Floats) -> None:
        """Add -Bᵀ D⁻¹ b_l to g on local displacement dofs, for this rank's unknowns b."""

    def recover(self, b: Floats, u: Floats, x: Floats) -> None:
        """Put δl = D⁻¹ (b_l - B δu) into this rank's unknowns x; u on local dofs."""


class CellBlocks:
    """Reads J_uu, B and D of each part off the assembled Jacobian, and assembles K.

    A part is an owned cell, or a quadrature point of one.
    """

    def __init__(self, layout: BlockLayout, A: PETSc.Mat, block_size: int) -> None:
        """Work out where each entry goes; the sparsity of A never changes.

        Args:
            layout: Numbering of the unknowns.
            A: The Jacobian, assembled once.
            block_size: Components of the displacement.
        """
        self._parts = layout.cells * layout.points
        cell_dofs = layout.cell_dofs(0)
        self._u_dofs = np.repeat(cell_dofs, layout.points, axis=0)
        self._local_u_dofs = layout.local_dofs(0)
        local_fields = range(1, len(layout.offsets) - 1)
        # On a cell the points come one after the other.
        l_dofs = [
            dofs.reshape(self._parts, dofs.shape[1] // layout.points)
            for dofs in map(layout.cell_dofs, local_fields)
        ]
        # Rows of the local unknowns of a part among this rank's unknowns.
        self._l_rows: Ints = np.hstack(
            [dofs + layout.offsets[f] for f, dofs in zip(local_fields, l_dofs, strict=True)]
        )
        self._comm = layout.comm
        # The field of each local unknown of a part.
        self._l_fields: Ints = np.repeat(local_fields, [dofs.shape[1] for dofs in l_dofs])
        first, _ = A.getOwnershipRange()
        nu, nl = self._u_dofs.shape[1], self._l_rows.shape[1]
        self._shape_B, self._shape_D = (self._parts, nl, nu), (self._parts, nl, nl)
        self._shape_of_cells = layout.cells, layout.points * nl, nu

        indptr, columns, _ = A.getValuesCSR()
        columns = columns.astype(np.int64)
        row = np.repeat(np.arange(layout.offsets[-1]), np.diff(indptr))
        is_u = layout.fields_of(columns) == 0
        # Part and place in the part of each row of a local unknown.
        place = np.full(layout.offsets[-1], -1)
        place[self._l_rows.ravel()] = np.arange(self._l_rows.size)
        # B: columns matched within the part by a key that orders by part, then by column.
        stride = np.int64(A.size[1])
        self._from_B = np.flatnonzero((place[row] >= 0) & is_u)
        self._to_B = self._match(
            place[row[self._from_B]], columns[self._from_B], layout.numbers(0, self._u_dofs), stride
        )
        self._from_D = np.flatnonzero((place[row] >= 0) & ~is_u)
        if layout.points > 1:  # there are entries, all zero, between the points of a cell
            from_row = place[row[self._from_D]] // nl
            from_column = place[columns[self._from_D] - first] // nl
            self._from_D = self._from_D[from_row == from_column]
        self._to_D = self._match(
            place[row[self._from_D]], columns[self._from_D], self._l_rows + first, stride
        )
        # K: the entries of J_uu, then the cells' contributions, both in u's own numbering.
        self._from_uu = np.flatnonzero((place[row] < 0) & is_u)
        # Owned u unknowns are first among the rank's unknowns, so a row's number is its dof.
        uu_rows = layout.own_global(0, row[self._from_uu].astype(np.int32))
        uu_columns = layout.own_numbers(0, columns[self._from_uu])
        dofs = layout.own_global(0, cell_dofs)
        cell_rows, cell_columns = np.repeat(dofs, nu, axis=1), np.tile(dofs, (1, nu))
        rows = np.concatenate([uu_rows, cell_rows.ravel()])
        columns = np.concatenate([uu_columns, cell_columns.ravel()])

        self.K = PETSc.Mat().create(layout.comm)
        self.K.setSizes(((layout.offsets[1], None),) * 2, bsize=block_size)
        self.K.setType("aij")
        self.K.setPreallocationCOO(
            rows.astype(PETSc.IntType, copy=False), columns.astype(PETSc.IntType, copy=False)
        )

    def _match(self, place: Ints, columns: Ints, of_part: Ints, stride: np.int64) -> Ints:
        """Flat positions in an array (parts, local rows, columns of the part)."""
        part, local_row = np.divmod(place, self._l_rows.shape[1])
        keys = np.arange(self._parts)[:, None] * stride + of_part
        order = np.argsort(keys, axis=None)
        found = order[np.searchsorted(keys.ravel()[order], part * stride + columns)]
        width = of_part.shape[1]
        return (part * self._l_rows.shape[1] + local_row) * width + found % width

    def update(self, A: PETSc.Mat) -> Sequence[int]:
        """Eliminate the local unknowns from the assembled Jacobian A, into K."""
        values = A.getValuesCSR()[2]
        self._B, D = np.zeros(self._shape_B), np.zeros(self._shape_D)
        self._B.ravel()[self._to_B] = values[self._from_B]
        D.ravel()[self._to_D] = values[self._from_D]
        self._inverse, null = _inverse(D)
        here = self._l_fields[np.flatnonzero(null)]
        if singular := set().union(*self._comm.allgather(set(here.tolist()))):
            return sorted(singular)
        # Not einsum, which does not call BLAS for a product in each cell.
        B = self._B.reshape(self._shape_of_cells)
        D_B = (self._inverse @ self._B).reshape(self._shape_of_cells)
        condensed = -(B.transpose(0, 2, 1) @ D_B)
        self.K.setValuesCOO(
            np.concatenate([values[self._from_uu], condensed.ravel()]), PETSc.InsertMode.INSERT
        )
        return ()

    def project(self) -> bool:
        """The parts of J_uu are summed already, so that no cell's can be projected."""
        return False

    def eliminate(self, b: Floats, g: Floats) -> None:
        """Add -Bᵀ D⁻¹ b_l to g on local displacement dofs, for this rank's unknowns b."""
        D_b = self._inverse @ b[self._l_rows][:, :, None]
        parts = self._B.transpose(0, 2, 1) @ D_b
        g -= np.bincount(self._u_dofs.ravel(), parts.ravel(), self._local_u_dofs)

    def recover(self, b: Floats, u: Floats, x: Floats) -> None:
        """Put δl = D⁻¹ (b_l - B δu) into this rank's unknowns x; u on local dofs."""
        right = b[self._l_rows][:, :, None] - self._B @ u[self._u_dofs][:, :, None]
        x[self._l_rows] = (self._inverse @ right)[:, :, 0]


class NothingToEliminate:
    """The blocks of a problem in the displacement alone, whose Jacobian is K itself."""

    def __init__(self, A: PETSc.Mat, project: Callable[[], bool] = lambda: False) -> None:
        """Keep the Jacobian and what makes it positive semi-definite, if there is that."""
        self.K = A
        self._project = project

    def update(self, A: PETSc.Mat) -> Sequence[int]:
        """Nothing."""
        return ()

    def project(self) -> bool:
        """Put a positive semi-definite stand-in into K, if there is one. Collective."""
        return self._project()

    def eliminate(self, b: Floats, g: Floats) -> None:
        """Nothing."""

    def recover(self, b: Floats, u: Floats, x: Floats) -> None:
        """Nothing."""


class CondensedSolver:
    """A PETSc Python preconditioner that solves the block system through K.

    An iterative solver's preconditioner is kept from one Newton iteration to the next as long as it
    serves. Where conjugate gradients meet negative curvature, or do not converge, the system is
    solved with a positive semi-definite stand-in for K if the blocks have one, else by LDLᵀ.

    Attributes:
        ksp: The solver of the condensed system, with options prefix `<problem's>condensed_`.
        iterations: Linear iterations since the last `start`.
        seconds: Wall time since then by phase: "condensation", "setup" of the preconditioner,
            "solve".
        target: The residual norm at which the Newton iteration ends.
        notes: What was done since then about a K that conjugate gradients did not solve with, by
            the number of the Newton iteration.
        failure: Why the last system could not be solved, as far as that is known.
    """

    def __init__(
        self,
        fields: Sequence[fem.Function],
        prefix: str,
        make_blocks: Callable[[PETSc.Mat], CondensedBlocks],
    ) -> None:
        """Prepare for the fields of a problem.

        Args:
            fields: The displacement, then cell-local fields.
            prefix: Options prefix of the problem.
            make_blocks: Makes the elimination, given the assembled Jacobian.

        Raises:
            ValueError: A field other than the first is not local to cells.
        """
        require_local(fields)
        self._V = fields[0].function_space
        self._names = [f.name for f in fields]
        self._make_blocks = make_blocks
        self._blocks: CondensedBlocks | None = None
        self._g, self._z = create_vector(self._V), create_vector(self._V)
        self.ksp = PETSc.KSP().create(self._V.mesh.comm)
        self.ksp.setOptionsPrefix(f"{prefix}condensed_")
        self._keep = False
        self._fresh_cost = 0.0
        self.start()

    def destroy(self, pc: PETSc.PC) -> None:
        """Destroy what this holds. Called by PETSc."""
        for thing in (self.ksp, self._g, self._z):
            thing.destroy()
        if self._blocks is not None:
            self.K.destroy()

    @property
    def K(self) -> PETSc.Mat:
        """The condensed matrix, in the problem's scaled unknowns; after the first iteration."""
        assert self._blocks is not None
        return self._blocks.K

    def start(self) -> None:
        """Begin a new nonlinear solve."""
        self.iterations = 0
        self.seconds = {"condensation": 0.0, "setup": 0.0, "solve": 0.0}
        self.notes: dict[int, str] = {}
        self.target = 0.0
        self.failure = ""
        self._newton_iteration = 0
        self._last_norm = 0.0

    def restart(self) -> None:
        """Begin again from the start of a nonlinear solve."""
        self._keep = False
        self._last_norm = 0.0

    def setUp(self, pc: PETSc.PC) -> None:
        """Condense the current Jacobian. Called by PETSc."""
        A, _ = pc.getOperators()
        pc.setFailedReason(PETSc.PC.FailedReason.NOERROR)  # PETSc keeps that of the last time
        with self._timed("condensation"):
            if self._blocks is None:
                self._blocks = self._make_blocks(A)
                self.K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
                self.K.setNearNullSpace(rigid_body_modes(self._V))
                self.ksp.setOperators(self.K)
                self.ksp.setFromOptions()
            singular = ", ".join(self._names[f] for f in self._blocks.update(A))
            self.failure = f"the local block of {singular} is singular" if singular else ""

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve with the block system. Called by PETSc."""
        assert self._blocks is not None
        if self.failure:
            # Not in setUp, after which PETSc would apply this all the same.
            pc.setFailedReason(PETSc.PC.FailedReason.FACTOR_NUMERIC_ZEROPIVOT)
            return
        self._newton_iteration += 1
        owned = self._g.getLocalSize()
        right = b.array_r
        with self._timed("condensation"):
            with self._g.localForm() as g:
                local = g.array_w
                local[:] = 0.0
                self._blocks.eliminate(right, local)
                local[:owned] += right[:owned]
            self._g.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        self._set_tolerance(b.norm())
        if not self._solve():
            pc.setFailedReason(PETSc.PC.FailedReason.SUBPC_ERROR)
            return
        with self._timed("condensation"):
            self._z.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
            solution = x.array_w
            with self._z.localForm() as z:
                solution[:owned] = z.array_r[:owned]
                self._blocks.recover(right, z.array_r, solution)

    def _solve(self) -> bool:
        """Solve with K, or with what may stand for it; whether that succeeded."""
        assert self._blocks is not None
        kept = self._keep
        if self._solved(keep=kept) or (kept and self._solved(keep=False)):
            return True
        self._keep = False
        if self.ksp.getType() == PETSc.KSP.Type.PREONLY:
            self.failure = f"the condensed matrix has {forget_factors(self.ksp)}"
            return False
        with self._timed("condensation"):
            projected = self._blocks.project()
        reason = self.ksp.getConvergedReason()
        if projected:
            self._note(reason, "projected tangent")
            solved = self._solved(keep=False)
            self._keep = False
            return solved
        if self.K.size[0] > FACTORISE_UP_TO:
            return False
        self._note(reason, "LDLᵀ")
        return self._factorised()

    def _solved(self, *, keep: bool) -> bool:
        """Whether the iterative or direct solver in `ksp` solves with K as it is."""
        ksp = self.ksp
        ksp.getPC().setReusePreconditioner(keep)
        with self._timed("setup"):
            ksp.setUp()
        with self._timed("solve"):
            ksp.solve(self._g, self._z)
        its = ksp.getIterationNumber()
        self.iterations += its
        solved = bool(ksp.getConvergedReason() > 0)
        if ksp.getType() != PETSc.KSP.Type.PREONLY:
            cost = its / -np.log10(ksp.getTolerances()[0])
            if not keep:
                self._fresh_cost = cost
            self._keep = solved and cost <= KEEP_WHILE * self._fresh_cost
        return solved

    def _factorised(self) -> bool:
        direct = PETSc.KSP().create(self.ksp.comm)
        direct.setOperators(self.K)
        direct.setType(PETSc.KSP.Type.PREONLY)
        pc = direct.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY)
        pc.setFactorSolverType(PETSc.Mat.SolverType.MUMPS)
        with self._timed("setup"):
            direct.setUp()
        with self._timed("solve"):
            direct.solve(self._g, self._z)
        solved = direct.getConvergedReason() > 0
        direct.destroy()
        return bool(solved)

    def _note(self, reason: int, remedy: str) -> None:
        indefinite = (
            PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT,
            PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
        )
        what = "negative curvature" if reason in indefinite else "no convergence of CG"
        self.notes[self._newton_iteration] = f"{what}: {remedy}"

    def _set_tolerance(self, norm: float) -> None:
        """Solve as exactly as this Newton step can use.

        Choice 2 of Eisenstat and Walker (1996), and no more than what ends the Newton iteration
        (Kelley 1995, eq. 6.20). What the condensed system leaves is what the block system leaves.

        Args:
            norm: Of the block system's right-hand side.
        """
        loose, tight = FORCING_LIMITS
        ratio = norm / self._last_norm if self._last_norm > 0.0 else 1.0
        self._last_norm = norm
        forcing = np.clip(ratio ** ((1 + 5**0.5) / 2), tight, loose)
        condensed = self._g.norm()
        if condensed > 0.0:
            enough = max(forcing * norm, 0.1 * self.target) / condensed
            self.ksp.setTolerances(rtol=float(np.clip(enough, tight, MODEST)))

    @contextmanager
    def _timed(self, phase: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[phase] += time.perf_counter() - start


def _inverse(D: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Inverses of the parts' blocks, and which of the unknowns are in a null space of one."""
    resolved = 1.0 / np.finfo(float).eps
    nothing = np.zeros(D.shape[1], dtype=bool)
    try:
        inverse: Floats = np.linalg.inv(D)
        condition = np.linalg.norm(D, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
        suspects = D[condition > resolved]
    except np.linalg.LinAlgError:
        inverse, suspects = D, D[np.isfinite(D).all(axis=(1, 2))]
    if not len(suspects):
        return inverse, nothing
    _, values, vectors = np.linalg.svd(suspects)
    null = vectors[values * resolved <= 10.0 * values[:, :1]]
    return inverse, (np.abs(null) > 1e-3).any(axis=0)


def forget_factors(ksp: PETSc.KSP) -> str:
    """Have a matrix that could not be factorised factorised from scratch the next time.

    PETSc 3.25 would not try again, and go on to solve with what there is not.

    Returns:
        What happened, in PETSc's words.
    """
    pc = ksp.getPC()
    reason = _FAILURES.get(pc.getFailedReason(), "no factors")
    operators = ksp.getOperators()
    pc.reset()
    ksp.setOperators(*operators)
    return reason


_FAILURES = {
    value: name for name, value in vars(PETSc.PC.FailedReason).items() if isinstance(value, int)
}


def rigid_body_modes(V: fem.FunctionSpace) -> PETSc.NullSpace:
    """Return the translations and linearised rotations of a vector space V as a near-nullspace.

    Args:
        V: Continuous vector-valued space of shape (d,), d = 2 or 3.
    """
    d = V.dofmap.index_map_bs
    X = V.tabulate_dof_coordinates()
    planes = [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]
    basis = [la.vector(V.dofmap.index_map, bs=d) for _ in range(d + len(planes))]
    modes = [vector.array.reshape(-1, d) for vector in basis]
    for i in range(d):
        modes[i][:, i] = 1.0
    for mode, (i, j) in zip(modes[d:], planes, strict=True):
        mode[:, i], mode[:, j] = -X[:, j], X[:, i]
    la.orthonormalize(basis)
    owned = V.dofmap.index_map.size_local * d
    comm = V.mesh.comm
    return PETSc.NullSpace().create(
        vectors=[PETSc.Vec().createWithArray(v.array[:owned].copy(), comm=comm) for v in basis],
        comm=comm,
    )
