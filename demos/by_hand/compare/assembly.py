"""UFL forms as plain arrays on every rank, in the mesh file's order of vertices and cells."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.jit import DOLFINX_DEFAULT_JIT_OPTIONS
from ufl.algorithms import expand_derivatives

from forms import refresh
from forms.compilation import compile_together
from meshes import Body

Array = npt.NDArray[np.float64]
Space = fem.FunctionSpace[Any]

FIELDS = "xsl"
"""Letters of the unknowns x, s and λ."""


@contextmanager
def without_optimisation() -> Iterator[None]:
    """Have forms compiled in a third of the time, for use on a few cells."""
    name, defaults = "cffi_extra_compile_args", DOLFINX_DEFAULT_JIT_OPTIONS
    before = defaults[name]
    defaults[name] = (["-O0", "-g0"], before[1])
    try:
        yield
    finally:
        defaults[name] = before


class Assembler:
    """Assembles forms on P1 and DG0 spaces into dense arrays, for small meshes.

    Unknowns are numbered block size × vertex + component, or block size × cell + component, with
    the vertices and cells of the mesh file: the orderings of `demos.by_hand`. Every method is
    collective and returns the same on all ranks.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._comm: MPI.Comm = body.mesh.comm

    def put(self, f: fem.Function[Any], values: Array) -> None:
        """Set a field from its values in file order, of any shape."""
        self._body.put(f, values)

    def values(self, f: fem.Function[Any]) -> Array:
        """The values of a field in file order, flat."""
        index_map = f.function_space.dofmap.index_map
        owned = f.x.array[: index_map.size_local * f.function_space.dofmap.index_map_bs]
        return self._gather(f.function_space, owned)

    def _gather(self, V: Space, owned: Array) -> Array:
        """The owned values of all ranks in file order, flat."""
        f = fem.Function(V)
        f.x.array[: len(owned)] = owned
        return np.asarray(self._body.gather(f, everywhere=True)).ravel()

    def scalar(self, form: fem.Form) -> float:
        """Assemble a functional."""
        return float(self._comm.allreduce(fem.assemble_scalar(form)))

    def vector(self, form: fem.Form | None, V: Space) -> Array:
        """Assemble a linear form; None stands for zero."""
        if form is None:
            return np.zeros(V.dofmap.index_map.size_global * V.dofmap.index_map_bs)
        b = fem.assemble_vector(form)
        b.scatter_reverse(la.InsertMode.add)
        return self._gather(V, b.array[: V.dofmap.index_map.size_local * V.dofmap.index_map_bs])

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

    def array(self, form: ufl.Form, *fields: fem.Function[Any]) -> Any:
        """Compile and assemble a form: a number, or an axis for each field it is tested against."""
        refresh([form])
        compiled = fem.form(expand_derivatives(form))
        assemble: Any = (self.scalar, self.vector, self.matrix)[len(fields)]
        return assemble(compiled, *(f.function_space for f in fields))

    def _owned(self, V: Space) -> npt.NDArray[np.int64]:
        return self._body.file_blocks(V)[: V.dofmap.index_map.size_local]


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
    """A functional compiled with its derivatives by UFL; a derivative that vanishes is left out."""

    def __init__(self, energy: ufl.Form, fields: Mapping[str, fem.Function[Any]]) -> None:
        """Differentiate and compile.

        Args:
            energy: The functional.
            fields: The unknowns of which it is one, by letter.
        """
        self._form = energy
        self._spaces = {i: f.function_space for i, f in fields.items()}
        first: dict[str, ufl.Form] = {}
        second: dict[str, ufl.Form] = {}
        for i, f in fields.items():
            slope = expand_derivatives(ufl.derivative(energy, f, ufl.TestFunction(self._spaces[i])))
            if slope.empty():
                continue
            first[i] = slope
            for j in FIELDS[: FIELDS.index(i) + 1]:
                if j not in fields:
                    continue
                trial = ufl.TrialFunction(self._spaces[j])
                block = expand_derivatives(ufl.derivative(slope, fields[j], trial))
                if not block.empty():
                    second[i + j] = block
        self._value, slopes, blocks = compile_together(
            [energy, list(first.values()), list(second.values())]
        )
        self._first: dict[str, fem.Form] = dict(zip(first, slopes, strict=True))
        self._second: dict[str, fem.Form] = dict(zip(second, blocks, strict=True))

    def value(self, assembler: Assembler) -> float:
        """Assemble the functional itself at the current fields. Collective."""
        refresh([self._form])
        return assembler.scalar(self._value)

    def at(self, assembler: Assembler) -> Derivatives:
        """Assemble at the current fields, with zeros for what vanishes. Collective."""
        value, spaces = self.value(assembler), self._spaces
        first = {i: assembler.vector(self._first.get(i), V) for i, V in spaces.items()}
        second = {
            i + j: assembler.matrix(self._second.get(i + j), V, W)
            for i, V in spaces.items()
            for j, W in spaces.items()
            if FIELDS.index(j) <= FIELDS.index(i)
        }
        second |= {key[::-1]: block.T for key, block in second.items() if key[0] != key[1]}
        return Derivatives(value, first, second)
