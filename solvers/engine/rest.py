"""The part of a Newton system that DOLFINx assembles beside the engine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix, create_matrix

from forms.compilation import compile_together
from solvers.systems import derivatives, or_none

# Their overloads are not typed.
_assemble_matrix: Any = assemble_matrix
_assemble_vector: Any = fem.assemble_vector
_create_matrix: Any = create_matrix

Floats = npt.NDArray[np.float64]


class Rest:
    """What DOLFINx assembles, in fields that are not local to cells: part of an energy, and a work.

    Its Jacobian is assembled only when what it depends on has changed: inertia is quadratic, so
    that its Jacobian changes with the time step and the density alone.
    """

    def __init__(
        self,
        energy: ufl.Form,
        work: ufl.Form | None,
        fields: Sequence[fem.Function],
        bcs: Sequence[fem.DirichletBC],
    ) -> None:
        self._bcs, self._fields = list(bcs), fields
        self._matrix: PETSc.Mat | None = None
        self._residual: list[fem.Form | None] = [None] * len(fields)
        self._comm = fields[0].function_space.mesh.comm
        self._known: list[Floats] = []
        self._values: Floats = np.zeros(0)
        self._energy: fem.Form | None = None
        if energy.empty() and work is None:
            return
        residual, jacobian = derivatives(energy, work, fields)
        for k, f in enumerate(fields if len(fields) > 1 else ()):
            if jacobian[k][k] is None:  # DOLFINx asks for a block in each row and column
                du, v = ufl.TrialFunction(f.function_space), ufl.TestFunction(f.function_space)
                zero = fem.Constant(f.function_space.mesh, 0.0)
                jacobian[k][k] = zero * ufl.inner(du, v) * ufl.dx
        self._energy, self._residual, blocks = compile_together(
            [None if energy.empty() else energy, [or_none(r) for r in residual], jacobian]
        )
        present = [form for row in blocks for form in row if form is not None]
        if not present:
            return
        self._jacobian: Any = blocks if len(fields) > 1 else present[0]
        kind = {"kind": "mpi"} if len(fields) > 1 else {}
        self._matrix = _create_matrix(self._jacobian, **kind)
        compiled = [form._cpp_object for form in present]
        self._inputs = lambda: [
            *(c.value for form in compiled for c in form.constants),
            *(c.x.array for form in compiled for c in form.coefficients),
        ]

    def destroy(self) -> None:
        """Destroy the matrix. Collective."""
        if self._matrix is not None:
            self._matrix.destroy()

    def residual(self, r: Sequence[Floats]) -> None:
        """Add this rank's part of the residual to the local dofs of each field."""
        for form, values in zip(self._residual, r, strict=True):
            if form is not None:
                _assemble_vector(values, form)

    def lift(self, g: Sequence[Floats], changes: Sequence[Floats]) -> None:
        """Add -J changes to local dofs of each field, of changes of prescribed dofs.

        Args:
            g: An array for each field.
            changes: For each field, zero but where there are conditions.
        """
        if self._matrix is None:
            return
        rows = self._jacobian if len(self._fields) > 1 else [[self._jacobian]]
        for values, row in zip(g, rows, strict=True):
            for form, f, change in zip(row, self._fields, changes, strict=True):
                own = [
                    bc
                    for bc in self._bcs
                    if f.function_space._cpp_object.contains(bc.function_space)
                ]
                if form is not None and own:
                    start = f.x.array + 0.0
                    for bc in own:
                        bc.set(start)
                    # DOLFINx subtracts J (prescribed - start), which is to be J changes.
                    fem.apply_lifting(values, [form], [own], [start - change], 1.0)

    def energy(self) -> float:
        """This rank's part of the energy [J]."""
        return 0.0 if self._energy is None else float(np.real(fem.assemble_scalar(self._energy)))

    def pattern(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Global rows and columns of the entries of this rank."""
        if self._matrix is None:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        self.values()
        indptr, columns, _ = self._matrix.getValuesCSR()
        first, _ = self._matrix.getOwnershipRange()
        rows = first + np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        return rows.astype(np.int64), columns.astype(np.int64)

    def values(self) -> Floats:
        """The values of these entries, zero in rows and columns with conditions. Collective."""
        if self._matrix is None:
            return self._values
        inputs = self._inputs()
        same = len(self._known) > 0 and all(map(np.array_equal, inputs, self._known))
        if not self._comm.allreduce(same, op=MPI.LAND):
            self._known = [np.copy(values) for values in inputs]
            self._matrix.zeroEntries()
            _assemble_matrix(self._matrix, self._jacobian, self._bcs, diag=0.0)
            self._matrix.assemble()
            self._values = self._matrix.getValuesCSR()[2]
        return self._values
