"""Residuals on the terminal, field by field."""

from __future__ import annotations

from petsc4py import PETSc

from solvers.systems import System


class Printer:
    """Prints the residual norm of each field."""

    def __init__(self, system: System) -> None:
        self._system = system

    def newton(self, snes: PETSc.SNES, iteration: int, norm: float) -> None:
        """That of a Newton iteration. Collective."""
        self._print("Newton", iteration, self._system.b)

    def krylov(self, ksp: PETSc.KSP, iteration: int, norm: float) -> None:
        """That of a Krylov iteration. Collective."""
        self._print("  Krylov", iteration, ksp.buildResidual())

    def _print(self, method: str, iteration: int, b: PETSc.Vec) -> None:
        norms = self._system.unknowns.norms(b)
        if self._system.unknowns.layout.comm.rank == 0:
            parts = (f"|r_{name}| {norm:.6e}" for name, norm in norms.items())
            print(f"{method} {iteration:3d}", *parts, sep="  ", flush=True)
