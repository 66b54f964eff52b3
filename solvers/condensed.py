"""The condensed solver: a PETSc Python preconditioner that solves exactly, through K."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Protocol

from petsc4py import PETSc

import numpy as np
from dolfinx import fem, la

from forms.spaces import zeros
from solvers.condensation import Condensation
from solvers.inner import InnerSolver
from solvers.interruption import Guard
from solvers.lifetime import shared_communicator
from solvers.systems import System


class CondensedSystem(System, Protocol):
    """A Newton system whose cell-local fields can be eliminated.

    Attributes:
        shared: Fields that the condensed matrix is of.
    """

    shared: list[int]

    def condensation(self) -> Condensation:
        """The elimination; the Jacobian has been assembled. Collective."""


class CondensedSolver:
    """A PETSc Python preconditioner that solves the block system through K.

    Attributes:
        inner: The solver of the condensed system, with options prefix `<problem's>condensed_`.
    """

    def __init__(self, system: CondensedSystem, guard: Guard) -> None:
        """Make this the preconditioner of a system's SNES.

        Args:
            system: The system; its SNES has its options.
            guard: Keeps what callbacks raise.

        Raises:
            ValueError: Options that do not go together.
        """
        # The system holds the SNES, and that holds this.
        self._system: CondensedSystem = weakref.proxy(system)
        self._guard = guard
        fields, shared = system.fields, system.shared
        self._V = fields[0].function_space
        self._names = [f.name for f in fields]
        self._layout, self._shared = system.unknowns.layout, shared
        self._local = [zeros(fields[k].function_space) for k in shared]
        self._blocks: Condensation | None = None
        comm = self._layout.comm
        owned = sum(int(np.diff(self._layout.offsets)[k]) for k in shared)
        self._g = PETSc.Vec().createMPI((owned, None), comm=comm)
        self._z = self._g.duplicate()
        self.inner = InnerSolver(
            comm,
            f"{system.solver.getOptionsPrefix()}condensed_",
            symmetric=system.symmetric,
            bs=self._V.dofmap.index_map_bs if len(shared) == 1 else 1,
        )
        self._counted = 0
        self._singular = ""
        pc = system.solver.getKSP().getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(self)

    def destroy(self, pc: PETSc.PC) -> None:
        """Destroy what this holds. Called by PETSc."""
        for thing in (self.inner, self._g, self._z):
            thing.destroy()

    @property
    def K(self) -> PETSc.Mat:
        """The condensed matrix, in the problem's scaled unknowns; after the first iteration."""
        assert self._blocks is not None
        return self._blocks.K

    @property
    def seconds(self) -> dict[str, float]:
        """Wall time since the last `start` by phase: see `InnerSolver`."""
        return self.inner.seconds

    @property
    def notes(self) -> dict[int, str]:
        """What was not usual, by the number of the Newton iteration."""
        return self.inner.notes

    @property
    def unstable(self) -> str:
        """What the last solve has shown of K that no stable state has."""
        return self.inner.unstable

    @property
    def target(self) -> float:
        """The residual norm at which the Newton iteration ends."""
        return self.inner.target

    @target.setter
    def target(self, norm: float) -> None:
        self.inner.target = norm

    def start(self) -> None:
        """Begin a new nonlinear solve."""
        self._counted = 0
        self.inner.start()

    def restart(self) -> None:
        """Begin again from the start of a nonlinear solve."""
        self.inner.restart()

    def carried(self) -> dict[str, float]:
        """Whether factors take the place of CG, and for how long."""
        return self.inner.carried()

    def carry(self, numbers: Mapping[str, float]) -> None:
        """Take that from another solver."""
        self.inner.carry(numbers)

    def renew(self) -> None:
        """Forget preconditioners and factors. Collective."""
        self.inner.renew()

    def set_up(self, A: PETSc.Mat) -> PETSc.Mat:
        """Nothing; the preconditioner is that of the Jacobian."""
        return A

    def follow(self) -> None:
        """Nothing; PETSc calls `setUp`."""

    def count(self) -> tuple[int, int | None]:
        """Iterations on the condensed system since the last call, or the last `start`."""
        new = self.inner.iterations - self._counted
        self._counted = self.inner.iterations
        return new, None

    def why(self) -> str:
        """What is known about why the last system could not be solved."""
        return self._singular or self.inner.failure

    def setUp(self, pc: PETSc.PC) -> None:
        """Condense the current Jacobian. Called by PETSc."""
        self._guard.protects(self._set_up, lambda pc: None)(pc)

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve with the block system. Called by PETSc."""
        self._guard.protects(self._apply, _fail)(pc, b, x)

    def _set_up(self, pc: PETSc.PC) -> None:
        pc.setFailedReason(PETSc.PC.FailedReason.NOERROR)  # PETSc keeps that of the last time
        with self.inner.timed("condensation"):
            if self._blocks is None:
                self._blocks = self._system.condensation()
                self.K.setOption(PETSc.Mat.Option.SYMMETRIC, self._system.symmetric)
                if len(self._shared) == 1:
                    self.K.setNearNullSpace(rigid_body_modes(self._V))
            singular = ", ".join(self._names[f] for f in self._blocks.update())
            self._singular = f"the local block of {singular} is singular" if singular else ""

    def _apply(self, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
        assert self._blocks is not None
        if self._singular:
            # Not in setUp, after which PETSc would apply this all the same.
            pc.setFailedReason(PETSc.PC.FailedReason.FACTOR_NUMERIC_ZEROPIVOT)
            return
        right = b.array_r
        parts = self._layout.split(right)
        local = [vector.array for vector in self._local]
        with self.inner.timed("condensation"):
            for values in local:
                values[:] = 0.0
            self._blocks.eliminate(right, local)
            for vector, k in zip(self._local, self._shared, strict=True):
                vector.scatter_reverse(la.InsertMode.add)
                vector.array[: len(parts[k])] += parts[k]
            self._g.array_w[:] = np.concatenate(
                [values[: len(parts[k])] for values, k in zip(local, self._shared, strict=True)]
            )
        exact = len(self._shared) == 1 and not self._system.projection
        if not self.inner.solve(self._blocks, self._g, self._z, b.norm(), exact=exact):
            pc.setFailedReason(PETSc.PC.FailedReason.SUBPC_ERROR)
            return
        with self.inner.timed("condensation"):
            solution = x.array_w
            found = self._layout.split(solution)
            ends = np.cumsum([len(parts[k]) for k in self._shared])[:-1]
            for vector, k, values in zip(
                self._local, self._shared, np.split(self._z.array_r, ends), strict=True
            ):
                found[k][:] = vector.array[: len(values)] = values
                vector.scatter_forward()
            self._blocks.recover(right, local, solution)


def _fail(pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec) -> None:
    pc.setFailedReason(PETSc.PC.FailedReason.SUBPC_ERROR)


def rigid_body_modes(V: fem.FunctionSpace) -> PETSc.NullSpace:
    """Return the translations and linearised rotations of a vector space V as a near-nullspace.

    Args:
        V: Continuous vector-valued space of shape (d,), d = 2 or 3.
    """
    d = V.dofmap.index_map_bs
    X = V.tabulate_dof_coordinates()
    planes = [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]
    basis = [zeros(V) for _ in range(d + len(planes))]
    modes = [vector.array.reshape(-1, d) for vector in basis]
    for i in range(d):
        modes[i][:, i] = 1.0
    for mode, (i, j) in zip(modes[d:], planes, strict=True):
        mode[:, i], mode[:, j] = -X[:, j], X[:, i]
    la.orthonormalize(basis)
    owned = V.dofmap.index_map.size_local * d
    comm = shared_communicator(V.mesh.comm)
    return PETSc.NullSpace().create(
        vectors=[PETSc.Vec().createWithArray(v.array[:owned].copy(), comm=comm) for v in basis],
        comm=comm,
    )
