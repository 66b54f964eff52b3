"""Block preconditioners on the nested Newton system: PETSc's field splits, with their matrices.

The algebra of blocks is PETSc's. What it lacks are the index sets, and for each Schur complement a
matrix to precondition it with: that Schur complement itself, assembled.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from petsc4py import PETSc

from dolfinx import fem

from solvers.condensation import Floats, LocalBlocks
from solvers.condensed import rigid_body_modes
from solvers.elimination import DiagonalBlocks, Elimination, SchurComplements
from solvers.layout import BlockLayout, Ints, require_local
from solvers.lifetime import Factors, weakly
from solvers.linear import forget_factors
from solvers.options import KEEP_WHILE, Options
from solvers.preconditioners import INEXACT, Preconditioner


class FieldSplitSolver:
    """Preconditions the Newton system of a displacement and cell-local fields.

    Attributes:
        elimination: Which fields are eliminated in which order. None before the first solve, and
            with the displacement alone.
        blocks: The matrices of the preconditioner, of which `blocks.K` is the condensed one. None
            at the same times.
        options: The options that it has put in, by their names without the problem's prefix.
        inner: Iterations on the condensed matrix since the last `start`; 1 for each application of
            a preconditioner alone.
        seconds: Wall time since the last `start` by phase: "condensation".
        notes: Empty.
        unstable: Empty.
    """

    def __init__(
        self,
        fields: Sequence[fem.Function],
        layout: BlockLayout,
        ksp: PETSc.KSP,
        preconditioner: Preconditioner,
        set_options: Callable[[Options], None],
    ) -> None:
        """Put in the options that do not depend on the elimination.

        Args:
            fields: The displacement, then cell-local fields.
            layout: Their numbering.
            ksp: The Krylov solver of the Newton system.
            preconditioner: What to make its preconditioner.
            set_options: Puts options of the problem where the user has not put any.

        Raises:
            ValueError: A field other than the first is not local to cells.
        """
        require_local(fields)
        self._fields, self._layout, self._ksp = tuple(fields), layout, ksp
        self._preconditioner, self._set_options = preconditioner, set_options
        self.elimination: Elimination | None = None
        self.blocks: SchurComplements | DiagonalBlocks | None = None
        self.options: Options = INEXACT
        if len(fields) == 1:
            self.options = {**INEXACT, **preconditioner.options}
        set_options(self.options)
        self.notes: dict[int, str] = {}
        self.unstable = ""
        self._target = 0.0
        self._atol: float | None = None  # that of the options
        self._P: PETSc.Mat | None = None
        # Of the condensed matrix.
        self._innermost = ksp
        self._right = Factors(layout.comm, self)
        self._iterative: PETSc.KSP | None = None
        # The most iterations on the condensed matrix in one application with the preconditioner
        # in use, and with the last new one.
        self._cost = self._fresh_cost = 0
        self._kept = False
        self.start()

    @property
    def target(self) -> float:
        """The residual norm at which the Newton iteration ends, which PETSc's tolerances miss."""
        return self._target

    @target.setter
    def target(self, norm: float) -> None:
        self._target, ksp = norm, self._ksp
        if self._atol is None:
            self._atol = ksp.getTolerances()[1]
        if ksp.getNormType() == PETSc.KSP.NormType.UNPRECONDITIONED:
            ksp.setTolerances(atol=max(self._atol, 0.1 * norm))

    def start(self) -> None:
        """Begin a new nonlinear solve."""
        self.inner = self._counted = 0
        self.seconds = {"condensation": 0.0}

    def restart(self) -> None:
        """Nothing."""

    def carried(self) -> dict[str, float]:
        """Nothing; a kept preconditioner is no number."""
        return {}

    def carry(self, numbers: Mapping[str, float]) -> None:
        """Nothing."""

    def renew(self) -> None:
        """Keep no preconditioner; the splits stay as they are. Collective."""
        self._cost, self._fresh_cost, self._kept = 0, 0, False
        if self._innermost.getPC().getType() in ("lu", "cholesky"):
            forget_factors(self._innermost)

    def set_up(self, A: PETSc.Mat) -> PETSc.Mat:
        """Choose the order of elimination, and make the preconditioner, once.

        Args:
            A: The scaled Jacobian, assembled.

        Returns:
            The matrix that PETSc is to build the preconditioner of.
        """
        if self._P is not None:
            return self._P
        K, P = A, A
        if len(self._fields) > 1:
            self.elimination = Elimination(LocalBlocks(self._layout, A))
            if self._preconditioner.nested:
                self.blocks = SchurComplements(self.elimination)
            else:
                self.blocks = DiagonalBlocks(self.elimination)
            K, P = self.blocks.K, self.blocks.systems[0]
        K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        K.setNearNullSpace(rigid_body_modes(self._fields[0].function_space))
        if self.elimination is not None and self.blocks is not None:
            names = [["_".join(map(self._name, part)) for part in s] for s in self.blocks.parts]
            point_blocks = [self.elimination.is_point_block(g) for g in self.elimination.groups]
            ours = self._preconditioner.split_options(names, point_blocks)
            self.options = {**self.options, **ours}
            self._set_options(ours)
            self._ksp.setOperators(A, P)
            self._ksp.setFromOptions()
            self._split(self._ksp.getPC(), names)
        self._P = P
        return P

    def _watch(self, ksp: PETSc.KSP) -> None:
        """Count the iterations on the condensed matrix from here on."""
        if ksp.getPC().getType() == PETSc.PC.Type.KSP:
            self._iterative = ksp = ksp.getPC().getKSP()
        self._innermost = ksp
        ksp.setPostSolve(weakly(self._count))

    def _count(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        iterations = ksp.getIterationNumber()
        self.inner += iterations
        self._cost = max(self._cost, iterations)

    def follow(self) -> None:
        """Follow the Jacobian, which has changed.

        An iterative solver's preconditioner of the condensed matrix is kept while it serves.
        """
        start = time.perf_counter()
        if self.blocks is not None:
            self.blocks.update()
        if self._iterative is not None:
            if not self._kept:
                self._fresh_cost = self._cost
            self._kept = 0 < self._cost <= KEEP_WHILE * self._fresh_cost
            self._iterative.getPC().setReusePreconditioner(self._kept)
            self._cost = 0
        self.seconds["condensation"] += time.perf_counter() - start

    def count(self) -> tuple[int, int | None]:
        """Iterations of the last solve, and those on the condensed matrix since the last call."""
        inner = self.inner - self._counted
        self._counted = self.inner
        self._right.used()
        return int(self._ksp.getIterationNumber()), inner

    def why(self) -> str:
        """What the factorisation of the condensed matrix says."""
        return forget_factors(self._innermost)

    def _name(self, field: int) -> str:
        return str(self._fields[field].name)

    def _split(self, pc: PETSc.PC, names: Sequence[Sequence[str]], level: int = 0) -> None:
        """Hand a field split and those inside it what options cannot express."""
        assert self.blocks is not None and self.elimination is not None
        if pc.getType() != PETSc.PC.Type.FIELDSPLIT:
            return  # the user's choice
        pc.setFieldSplitIS(*zip(names[level], self.blocks.splits[level], strict=True))
        last = level == len(self.blocks.splits) - 1
        if self._preconditioner.nested:
            pc.setFieldSplitSchurPreType(
                PETSc.PC.FieldSplitSchurPreType.USER, self.blocks.systems[level + 1]
            )
            pc.setFromOptions()  # where the user wants another one
        pc.setUp()
        *groups, rest = pc.getFieldSplitSubKSP()
        for k, ksp in enumerate(groups):
            if ksp.getPC().getType() == PETSc.PC.Type.PYTHON:
                group = self.blocks.parts[level][k]
                number = self.elimination.groups.index(group)
                rows = self.elimination.rows(group)
                ksp.getPC().setPythonContext(LocalInverse(rows, self.blocks.inverses, number))
        if last:
            self._watch(rest)
        else:
            self._split(rest.getPC(), names, level + 1)


class LocalInverse:
    """A PETSc Python preconditioner that applies the inverse of a group's blocks."""

    def __init__(self, rows: Ints, inverses: Sequence[Floats], number: int) -> None:
        """Keep references.

        Args:
            rows: This rank's unknowns of the group on each part, shape (parts, m).
            inverses: Current inverses of the groups, each of shape (parts, m, m).
            number: The group.
        """
        self._rows, self._inverses, self._number = rows, inverses, number

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Multiply by the inverse. Called by PETSc."""
        right = b.array_r[self._rows][:, :, None]
        x.array_w[self._rows] = (self._inverses[self._number] @ right)[:, :, 0]
