"""UFL forms as plain arrays on every rank, in the mesh file's order of vertices and cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from dolfinx.fem.petsc import assemble_matrix
from ufl.algorithms import expand_derivatives

from meshes import Body

Array = npt.NDArray[np.float64]
Space = fem.FunctionSpace[Any]

FIELDS = "xsl"
"""Letters of the unknowns x, s and λ."""


class Assembler:
    """Assembles forms on P1 and DG0 spaces into dense arrays, for small meshes.

    Unknowns are numbered block size × vertex + component, or block size × cell + component, with
    the vertices and cells of the mesh file: the orderings of `forms.discrete`. Every method is
    collective and returns the same on all ranks.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._comm: MPI.Comm = body.mesh.comm

    def blocks(self, V: Space) -> npt.NDArray[np.int64]:
        """File number of the vertex or cell of each local block, ghosts included."""
        if V.element.basix_element.degree > 0:
            return self._body.file_vertices(V)
        numbers = np.empty(len(V.dofmap.list), dtype=np.int64)
        numbers[V.dofmap.list[:, 0]] = self._body.mesh.topology.original_cell_index
        return numbers

    def put(self, f: fem.Function[Any], values: Array) -> None:
        """Set a field from its values in file order, of any shape."""
        bs = f.function_space.dofmap.index_map_bs
        f.x.array[:] = values.reshape(-1, bs)[self.blocks(f.function_space)].ravel()

    def gather(self, V: Space, owned: Array) -> Array:
        """The owned values of all ranks in file order, flat."""
        index_map, bs = V.dofmap.index_map, V.dofmap.index_map_bs
        whole = np.empty((index_map.size_global, bs))
        for places, rows in self._comm.allgather((self._owned(V), owned.reshape(-1, bs))):
            whole[places] = rows
        return whole.ravel()

    def scalar(self, form: fem.Form) -> float:
        """Assemble a functional."""
        return float(self._comm.allreduce(fem.assemble_scalar(form)))

    def vector(self, form: fem.Form | None, V: Space) -> Array:
        """Assemble a linear form; None stands for zero."""
        if form is None:
            return np.zeros(V.dofmap.index_map.size_global * V.dofmap.index_map_bs)
        b = fem.assemble_vector(form)
        b.scatter_reverse(la.InsertMode.add)
        return self.gather(V, b.array[: V.dofmap.index_map.size_local * V.dofmap.index_map_bs])

    def matrix(self, form: fem.Form | None, V: Space, W: Space) -> Array:
        """Assemble a bilinear form with tests in V and trials in W; None stands for zero."""
        shape = [X.dofmap.index_map.size_global * X.dofmap.index_map_bs for X in (V, W)]
        whole = np.zeros(shape)
        if form is None:
            return whole
        A = assemble_matrix(form)
        A.assemble()
        indptr, columns, values = A.getValuesCSR()
        A.destroy()
        rows = np.repeat(_scalar(self._owned(V), V), np.diff(indptr))
        by_global = np.concatenate(self._comm.allgather(_scalar(self._owned(W), W)))
        entries = rows, by_global[columns], values
        for i, j, values in self._comm.allgather(entries):
            whole[i, j] = values
        return whole

    def _owned(self, V: Space) -> npt.NDArray[np.int64]:
        return self.blocks(V)[: V.dofmap.index_map.size_local]


def _scalar(blocks: npt.NDArray[np.int64], V: Space) -> npt.NDArray[np.int64]:
    bs = V.dofmap.index_map_bs
    numbers: npt.NDArray[np.int64] = (bs * blocks[:, None] + np.arange(bs)).ravel()
    return numbers


@dataclass(frozen=True, eq=False)
class Derivatives:
    """A functional at a state, with its first and second derivatives by fields.

    Attributes:
        value: The functional [J].
        first: By the letter of the field.
        second: By the letters of row and column, such as "lx".
    """

    value: float
    first: Mapping[str, Array]
    second: Mapping[str, Array]


class Functional:
    """A functional of u, S and the multiplier, compiled with its derivatives by UFL."""

    def __init__(
        self,
        value: fem.Form,
        first: Sequence[fem.Form | None],
        second: Sequence[Sequence[fem.Form | None]],
        fields: Sequence[fem.Function[Any]],
    ) -> None:
        """Take compiled forms.

        Args:
            value: The functional.
            first: Its derivative by each field; None where it vanishes.
            second: The rows of its second derivatives, whole or up to the diagonal.
            fields: The unknowns.
        """
        self._value, self._first, self._second = value, first, second
        self._spaces = [f.function_space for f in fields]

    @classmethod
    def of(cls, energy: ufl.Form, fields: Sequence[fem.Function[Any]]) -> Functional:
        """Differentiate and compile a functional."""
        first = [ufl.derivative(energy, f, ufl.TestFunction(f.function_space)) for f in fields]
        trials = [ufl.TrialFunction(f.function_space) for f in fields]
        second = [
            [_compile(ufl.derivative(first[i], fields[j], trials[j])) for j in range(i + 1)]
            for i in range(len(fields))
        ]
        return cls(fem.form(energy), [_compile(r) for r in first], second, fields)

    def at(self, assembler: Assembler) -> Derivatives:
        """Assemble at the current fields. Per-cell data must be up to date."""
        first, second = {}, {}
        for i, V in enumerate(self._spaces):
            first[FIELDS[i]] = assembler.vector(self._first[i], V)
            for j, form in enumerate(self._second[i]):
                second[FIELDS[i] + FIELDS[j]] = assembler.matrix(form, V, self._spaces[j])
        for row, column in ("xs", "xl", "sl"):
            second.setdefault(row + column, second[column + row].T)
        return Derivatives(assembler.scalar(self._value), first, second)


def _compile(form: ufl.Form) -> fem.Form | None:
    form = expand_derivatives(form)
    return None if form.empty() else fem.form(form)
