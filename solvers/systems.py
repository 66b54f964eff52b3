"""What a Newton system is asked for, and the one that UFL derives and DOLFINx assembles."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from functools import partial, singledispatchmethod
from typing import Any, Protocol

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from dolfinx.fem.petsc import NonlinearProblem
from ufl.algorithms import expand_derivatives
from ufl.corealg.dag_traverser import DAGTraverser

from forms import CellData, refresh
from forms.compilation import compile_together
from solvers.condensation import CellBlocks, Condensation, LocalBlocks, NothingToEliminate
from solvers.layout import BlockLayout
from solvers.scaling import Unknowns, block_entries

logger = logging.getLogger("mixed_fem")

Floats = npt.NDArray[np.float64]


class System(Protocol):
    """A Newton system of an energy in several fields, in units of its own.

    Fields are read where they stand when a method is called.

    Attributes:
        fields: The unknowns, the displacement first.
        unknowns: The same as a vector, and their units.
        problem: DOLFINx's `NonlinearProblem`, or what stands in its place.
        solver: The SNES.
        x: Unknowns.
        b: Residual.
        A: Jacobian, or a stand-in that is only ever solved with.
        data: Per-cell data to be refreshed before an evaluation.
        symmetric: Whether the Jacobian is.
        descends: Whether it has what a descent on the energy needs: `projection`, 1 or 2 for a
            tangent that is positive semi-definite, and `relax`.
        projection: 0 for the exact tangent.
    """

    fields: tuple[fem.Function, ...]
    unknowns: Unknowns
    solver: PETSc.SNES
    x: PETSc.Vec
    b: PETSc.Vec
    A: PETSc.Mat
    data: list[CellData]
    symmetric: bool
    descends: bool
    projection: int

    @property
    def problem(self) -> Any:
        """DOLFINx's problem, or what stands in its place."""

    def residual(self, b: PETSc.Vec) -> None:
        """Assemble the scaled residual. Collective."""

    def jacobian(self, b: PETSc.Vec) -> None:
        """Assemble the scaled Jacobian; b is the residual. Collective."""

    def energy(self) -> float:
        """The energy [J]. Collective."""

    def unbalanced(self) -> Floats:
        """The derivative of energy less work by the displacement, without conditions. Collective.

        Returns:
            A force [N] for each local degree of freedom, ghosts included.
        """

    def rescale(self, scales: Floats) -> None:
        """Give units to unknowns that had none, and to the Jacobian last assembled."""

    def block_entries(self) -> Floats:
        """Typical entries of blocks of the Jacobian last assembled, shape (fields, fields)."""

    def meet_conditions(self) -> None:
        """Put the values of the Dirichlet conditions into the fields."""

    def relax(self) -> bool:
        """Move the cell-local fields to where the energy is stationary in them. Collective.

        Returns:
            Whether this has succeeded in every cell.
        """

    def hold(self, before: Sequence[Floats]) -> int:
        """Move cell-local fields towards former values where the energy has no value. Collective.

        Args:
            before: Former values of each field.

        Returns:
            In how many cells.
        """

    def destroy(self) -> None:
        """Destroy PETSc's objects. Collective."""


class AssembledSystem:
    """The first and second UFL derivatives of an energy, in DOLFINx's `NonlinearProblem`.

    Attributes are those of `System`, and `shared`: only the first field is not cell-local.
    """

    descends = False
    projection = 0

    def __init__(
        self,
        energy: ufl.Form,
        fields: Sequence[fem.Function],
        bcs: Sequence[fem.DirichletBC],
        prefix: str,
        *,
        work: ufl.Form | None = None,
        nested: bool = False,
    ) -> None:
        """Derive and compile.

        Args:
            energy: The energy [J].
            fields: The unknowns.
            bcs: Dirichlet conditions.
            prefix: Options prefix of the SNES.
            work: Virtual work [J] on a test function of the first field, or None.
            nested: Whether the Jacobian is a nest of blocks.
        """
        self.fields = tuple(fields)
        self._energy, self._bcs = energy, list(bcs)
        self._compiled_energy: fem.Form | None = None
        self.symmetric = work is None
        self.shared = [0]
        self._condensed: PETSc.Mat | None = None
        logger.info("compiling the residual and the Jacobian (cached on disk afterwards)")
        start = time.perf_counter()
        self.problem: Any = _nonlinear_problem(energy, work, fields, bcs, prefix, nested=nested)
        logger.info("compiled in %.1f s", time.perf_counter() - start)
        problem = self.problem
        self.solver, self.x, self.b, self.A = problem.solver, problem.x, problem.b, problem.A
        self.unknowns = Unknowns(fields, BlockLayout(fields), self.x)
        self.data = cell_data(energy, work)
        _, (assemble, _args, kwargs) = self.solver.getFunction()
        self._assemble_residual = partial(assemble, **kwargs)
        *_, (assemble, _args, kwargs) = self.solver.getJacobian()
        self._assemble_jacobian = partial(assemble, **kwargs)

    def destroy(self) -> None:
        """Destroy what is not DOLFINx's, and let go of that. Collective."""
        self.unknowns.destroy()
        if self._condensed is not None:
            self._condensed.destroy()
        del self.problem, self._assemble_residual, self._assemble_jacobian

    def residual(self, b: PETSc.Vec) -> None:
        """Assemble the scaled residual at the vector last written into the fields. Collective."""
        self._assemble_residual(self.solver, self.unknowns.unscaled, b)
        b.pointwiseMult(b, self.unknowns.D)

    def jacobian(self, b: PETSc.Vec) -> None:
        """Assemble the scaled Jacobian at the same place. Collective."""
        self._assemble_jacobian(self.solver, self.unknowns.unscaled, self.A, self.A)
        self.A.diagonalScale(self.unknowns.D, self.unknowns.D)

    def energy(self) -> float:
        """The energy [J]. Collective."""
        if self._compiled_energy is None:
            self._compiled_energy = fem.form(self._energy)
        refresh([self._energy])
        local = float(np.real(fem.assemble_scalar(self._compiled_energy)))
        return float(self.unknowns.layout.comm.allreduce(local))

    def unbalanced(self) -> Floats:
        """The derivative of energy less work by the displacement, without conditions. Collective.

        Returns:
            A force [N] for each local degree of freedom, ghosts included.
        """
        for data in self.data:
            data.refresh()
        forces = fem.assemble_vector(self.problem.F[0])
        forces.scatter_reverse(la.InsertMode.add)
        forces.scatter_forward()
        return np.asarray(forces.array, dtype=np.float64)

    def rescale(self, scales: Floats) -> None:
        """Give units to unknowns that had none, and to the Jacobian last assembled."""
        self.unknowns.set_scales(scales)
        self.A.diagonalScale(self.unknowns.D, self.unknowns.D)

    def block_entries(self) -> Floats:
        """Root mean square of the entries of each block, shape (fields, fields)."""
        return block_entries(self.A, self.unknowns.layout)

    def meet_conditions(self) -> None:
        """Put the values of the Dirichlet conditions into the fields."""
        for bc in self._bcs:
            for f in self.fields:
                if f.function_space._cpp_object.contains(bc.function_space):
                    bc.set(f.x.array)

    def relax(self) -> bool:
        """Nothing: this does not descend."""
        return False

    def hold(self, before: Sequence[Floats]) -> int:
        """Nothing: this does not look into cells."""
        return 0

    def condensation(self) -> Condensation:
        """The elimination of the cell-local fields; the Jacobian has been assembled. Collective."""
        if len(self.fields) == 1:
            return NothingToEliminate(self.A)
        blocks = CellBlocks(LocalBlocks(self.unknowns.layout, self.A))
        self._condensed = blocks.K
        return blocks


def cell_data(*forms: ufl.Form | None) -> list[CellData]:
    """The per-cell data in forms, each once."""
    found = [c for form in forms if form is not None for c in form.coefficients()]
    return list(dict.fromkeys(c for c in found if isinstance(c, CellData)))


def _nonlinear_problem(
    energy: ufl.Form,
    work: ufl.Form | None,
    fields: Sequence[fem.Function],
    bcs: Sequence[fem.DirichletBC],
    prefix: str,
    *,
    nested: bool,
) -> NonlinearProblem:
    """The Newton system of an energy: its first and second UFL derivatives by block."""
    residual, jacobian = derivatives(energy, work, fields)
    if jacobian[0][0] is None:
        # The rows of Dirichlet conditions need a block to stand in.
        V = fields[0].function_space
        zero = fem.Constant(V.mesh, 0.0)
        product = ufl.inner(ufl.TrialFunction(V), ufl.TestFunction(V))
        jacobian[0][0] = zero * product * ufl.dx
    residual, jacobian = compile_together([residual, jacobian])
    problem = NonlinearProblem(
        residual,  # compiled here, as the problem cannot be deleted where that fails
        fields,
        J=jacobian,
        bcs=list(bcs),
        kind="nest" if nested and len(fields) > 1 else "mpi",
        petsc_options_prefix=prefix,
    )
    forget_traversals()
    return problem


def derivatives(
    energy: ufl.Form, work: ufl.Form | None, fields: Sequence[fem.Function]
) -> tuple[list[ufl.Form], Any]:
    """Residual and Jacobian of an energy and a virtual work, by field.

    Returns:
        Forms of the residual, and rows of forms of the Jacobian, None where one vanishes.
    """
    tests = [ufl.TestFunction(f.function_space) for f in fields]
    trials = [ufl.TrialFunction(f.function_space) for f in fields]
    residual = [ufl.derivative(energy, f, v) for f, v in zip(fields, tests, strict=True)]
    if work is not None:
        residual[0] -= work
    # DOLFINx takes None for a block that vanishes; its type does not say so.
    jacobian: Any = [
        [or_none(ufl.derivative(r, f, du)) for f, du in zip(fields, trials, strict=True)]
        for r in residual
    ]
    return residual, jacobian


def or_none(form: ufl.Form) -> ufl.Form | None:
    """A form, or None where it vanishes identically."""
    form = expand_derivatives(form)
    return None if form.empty() else form


def forget_traversals() -> None:
    """Free what UFL's algorithms keep alive: forms, and so meshes and their communicators.

    They are single-dispatch methods, whose cache in Python 3.13 holds each object that called them.
    MPICH has 2048 communicators; a study would run out of them.
    """
    kinds = [DAGTraverser]
    for kind in kinds:
        kinds += kind.__subclasses__()
        for attribute in vars(kind).values():
            if isinstance(attribute, singledispatchmethod):
                getattr(attribute, "_method_cache", {}).clear()
