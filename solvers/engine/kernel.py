"""Arrays for the compiled Newton system of a density: cells, geometry, basis functions and data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from ufl.algorithms.analysis import extract_constants

from forms import CellData
from solvers.engine.density import Density
from solvers.engine.library import load
from solvers.engine.slots import Slot, coefficients
from solvers.engine.source import Source

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


class Kernel:
    """The part of a Newton system that a density makes up, on the cells of this rank.

    Arrays of a field hold local degrees of freedom, ghosts included, as `Function.x.array` does.
    The fields are read where they stand when a method is called. Sums over dofs that ranks share
    are the caller's.

    Attributes:
        sizes: Numbers of unknowns at a point and on a cell, see `point.c`.
        shared: Which of the fields the condensed matrix is of.
        cells: How many cells this rank has of it.
    """

    def __init__(self, density: Density, fields: Sequence[fem.Function]) -> None:
        """Compile, or load what has been compiled before. Collective.

        Raises:
            RuntimeError: There is no C compiler, or it failed.
        """
        self._fields, self._slots = fields, density.data
        self._mesh = fields[0].function_space.mesh
        source = Source(density, fields)
        self.sizes, d = source.sizes, self._mesh.geometry.dim
        self.shared = [row[0] for row in source.arguments][: self.sizes["SHARED"]]
        self._local_fields = [f for f, size, _ in source.local for _ in range(size)]
        self._cellwise_fields = [
            row[0]
            for row in source.arguments[self.sizes["SHARED"] :]
            for _ in range(row[1] * row[2])
        ]
        self._used = sorted({row[0] for row in (*source.arguments, *source.local)})
        self._library, self._ffi = load(self._mesh.comm, source)
        self._points, self._weights = density.points
        self._cells: Ints = np.ascontiguousarray(density.cells, dtype=np.int32)
        self.cells = len(self._cells)
        at_points = self.cells, len(self._weights)
        size = self.sizes
        cellwise = self.cells * size["NC"] * (size["NS"] + 1)
        self._steps: Floats = np.zeros(
            np.prod(at_points) * size["NL"] * (size["NA"] + 1) + cellwise
        )
        self._kept: Floats = np.zeros((*at_points, size["KEPT"]))
        self._data: Floats = np.zeros((*at_points, size["DATA"]))
        self._geometry: Floats = np.zeros((*at_points, d * d + 1))
        self._basis: Floats = np.concatenate(
            [self._tabulate(fields[row[0]]).ravel() for row in source.arguments]
        )
        self._constants = list(density.constants)
        # What the data depend on, and what it was when they were computed.
        self._inputs = [s.source for s in self._slots if s.source is not None]
        self._inputs = list(dict.fromkeys(f for s in self._inputs for f in (s, *coefficients(s))))
        data = [f for f in self._inputs if isinstance(f, CellData)]
        self._input_constants = [c for f in data for c in extract_constants(f.argument)]
        self._known: list[Floats] = []
        self._state: list[Floats] = []  # for which numbers are kept
        dofmaps = [np.ascontiguousarray(f.function_space.dofmap.list) for f in fields]
        self._alive = [self._pointers(dofmaps, "int"), dofmaps]

    def energy(self) -> float:
        """Return the energy of this rank's cells [J]."""
        return float(self._library.energy(self._part()))

    def residual(self, r: Sequence[Floats]) -> None:
        """Add the derivatives of the energy to an array for each field."""
        self._library.residual(self._part(), self._pointers(r))
        self._state = [values.copy() for values in self._read()]

    def matrix(
        self,
        b: Sequence[Floats],
        blocks: Sequence[Floats],
        places: Sequence[Ints],
        g: Sequence[Floats],
        *,
        lift: Sequence[Floats] | None = None,
        projection: int = 0,
        marks: npt.NDArray[np.int8] | None = None,
        squares: Floats | None = None,
    ) -> list[int]:
        """Condense the Newton system at the present state, J δ = b.

        Args:
            b: Right-hand side of each field, of which that of cell-local fields is read.
            blocks: For each pair of shared fields the blocks of the condensed matrix to add to,
                shape (couplings, components, components).
            places: For each pair the block of each pair of nodes of a cell, shape (cells, nodes,
                nodes).
            g: For each shared field an array to which -Bᵀ D⁻¹ b_l is added.
            lift: An array for each field: changes of shared fields that are known, zero elsewhere,
                for which -K lift is added to g.
            projection: 1 to raise negative eigenvalues at each point to zero, 2 to take their
                absolute values, 3 for the identity times the largest diagonal entry in the place of
                what gradients are multiplied by.
            marks: Not zero for the cells that this is done in; in all by default.
            squares: Shape (fields, fields, 2): adds the sum of squares of the entries of blocks in
                the rows of local fields, and how many there are.

        Returns:
            The fields in the null space of a local block that is singular; K is then of no use.
        """
        state = self._read()
        if len(self._state) != len(state) or not all(map(np.array_equal, self._state, state)):
            self.residual([np.zeros_like(f.x.array) for f in self._fields])
        null = self._ffi.NULL
        n, cellwise = self.sizes["NL"], self.sizes["NC"]
        block: Floats = np.zeros(max(n, cellwise) ** 2)
        failed = self._library.matrix(
            self._part(),
            projection,
            null if marks is None else self._pointer(marks, "signed char"),
            self._pointers(b),
            self._pointers(blocks),
            self._pointers(places, "int"),
            self._pointers(g),
            null if lift is None else self._pointers(lift),
            null if squares is None else self._pointer(squares),
            self._pointer(block),
        )
        if not failed:
            return []
        fields, size = (self._local_fields, n) if failed == 1 else (self._cellwise_fields, cellwise)
        return _fields_of_null_space(block[: size**2].reshape(size, size), np.array(fields))

    def recover(self, changes: Sequence[Floats]) -> None:
        """Set the changes of cell-local fields that solve the system last condensed.

        Args:
            changes: An array for each field; those of shared fields are read, ghosts too.
        """
        self._library.recover(self._part(), self._pointers(changes))

    def relax(self, most: int) -> int:
        """Move local fields to where the energy is stationary in them, the others held.

        Args:
            most: Iterations of Newton's method in a cell.

        Returns:
            In how many cells this has failed.
        """
        self._state = []
        return int(self._library.relax(self._part(), most))

    def hold(self, before: Sequence[Floats], most: int) -> int:
        """Move local fields towards former values in cells where the energy has no value.

        Args:
            before: An array for each field, of which those of local fields are read.
            most: How often to halve their distance from the present ones.

        Returns:
            In how many cells.
        """
        return int(self._library.hold(self._part(), self._pointers(before), most))

    def _read(self) -> list[Floats]:
        """What the kept numbers depend on."""
        values = [self._fields[f].x.array for f in self._used] + [c.value for c in self._constants]
        return [*values, *self._known]

    def _part(self) -> Any:
        """The C structure, with geometry, data and constants up to date."""
        inputs = [self._mesh.geometry.x, *(f.x.array for f in self._inputs)]
        inputs += [c.value for c in self._input_constants]
        if len(inputs) != len(self._known) or not all(map(np.array_equal, inputs, self._known)):
            self._set_geometry()
            first = 0
            for slot in self._slots:
                if isinstance(slot.source, CellData):
                    slot.source.refresh()
                self._data[:, :, first : first + slot.size] = self._values(slot)
                first += slot.size
            self._known = [
                self._mesh.geometry.x.copy(),
                *(f.x.array.copy() for f in self._inputs),
                *(np.copy(v) for v in inputs[1 + len(self._inputs) :]),
            ]
        constants = np.concatenate([[0.0], *(c.value.ravel() for c in self._constants)])[1:]
        constants = np.append(constants, 0.0)
        values = self._pointers([f.x.array for f in self._fields])
        part = self._ffi.new("Part *")
        part.cells = self.cells
        part.numbers = self._pointer(self._cells, "int")
        part.geometry, part.basis = self._pointer(self._geometry), self._pointer(self._basis)
        part.data, part.constants = self._pointer(self._data), self._pointer(constants)
        part.kept, part.steps = self._pointer(self._kept), self._pointer(self._steps)
        part.dofs, part.values = self._alive[0], values
        self._alive[2:] = [constants, values]
        return part

    def _set_geometry(self) -> None:
        """Inverse Jacobians, and weights times volumes, of straight cells."""
        geometry = self._mesh.geometry
        d = geometry.dim
        element = basix.create_element(
            basix.ElementFamily.P, self._mesh.basix_cell(), 1, basix.LagrangeVariant.gll_warped
        )
        X = geometry.x[geometry.dofmaps[0][self._cells]][:, :, :d]
        table: Floats = np.asarray(element.tabulate(1, self._points))[:, :, :, 0]
        J = np.einsum("jqa,cai->cqij", table[1:], X)
        self._x = np.einsum("qa,cai->cqi", table[0], X)
        self._geometry[:, :, :-1] = np.linalg.inv(J).reshape(*J.shape[:2], d * d)
        self._geometry[:, :, -1] = np.abs(np.linalg.det(J)) * self._weights

    def _values(self, slot: Slot) -> Floats:
        """Data at the points, shape (cells, points, components)."""
        f = slot.source
        if f is None:
            return self._x
        V = f.function_space
        values = f.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list[self._cells]]
        if f.ufl_element().has_custom_quadrature:
            return values
        basis = self._tabulate(f)
        if not slot.gradient:
            return np.einsum("qa,cai->cqi", basis[:, :, 0], values)
        d = self._mesh.geometry.dim
        inverse = self._geometry[:, :, :-1].reshape(*self._geometry.shape[:2], d, d)
        gradients = np.einsum("qak,cqkj,cai->cqij", basis[:, :, 1:], inverse, values, optimize=True)
        return gradients.reshape(*gradients.shape[:2], slot.size)

    def _tabulate(self, f: fem.Function) -> Floats:
        """Value and gradient of nodes' functions at the points, shape (points, nodes, 1 + d)."""
        table = np.asarray(f.function_space.element.basix_element.tabulate(1, self._points))
        return np.ascontiguousarray(table[:, :, :, 0].transpose(1, 2, 0))

    def _pointer(self, array: npt.NDArray[Any], kind: str = "double") -> Any:
        return self._ffi.cast(f"{kind} *", array.ctypes.data)

    def _pointers(self, arrays: Sequence[npt.NDArray[Any]], kind: str = "double") -> Any:
        return self._ffi.new(f"{kind} *[]", [self._pointer(a, kind) for a in arrays])


def _fields_of_null_space(block: Floats, fields: npt.NDArray[np.int64]) -> list[int]:
    """The fields, one for each unknown, that take part in the null space of a symmetric block."""
    infinite = ~np.isfinite(block).all(axis=1)
    if infinite.any():
        return sorted(set(fields[infinite].tolist()))
    largest = np.abs(block).max(axis=0)
    scale = 1.0 / np.sqrt(np.where(largest > 0.0, largest, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * block * scale)
    null = vectors[:, np.abs(values) <= max(1e-13, np.abs(values).min())]
    return sorted(set(fields[(np.abs(null) > 1e-3).any(axis=1)].tolist()))
