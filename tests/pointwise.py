"""The Newton system of any element by UFL's of P1 simplices, which are quick to compile.

At a point an energy density is a function of F and of the other fields there, and so it is on a P1
simplex, whose energy, residual and Jacobian blocks UFL derives and DOLFINx assembles. A simplex for
each point of a rule, and the derivatives of basis functions that DOLFINx evaluates, make up the
system of any element with the same density.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mpi4py import MPI

import basix
import basix.ufl
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.fem.petsc import assemble_matrix, create_matrix
from ufl.algorithms import expand_derivatives

from forms import FORMULATIONS, deformation_gradient, quadrature_degree, refresh
from forms.compilation import compile_together
from solvers.layout import is_local
from tests.states import dense

COUNT = 64  # of simplices
# Where they have the same density; on simplices of degree 1 a continuous field is not one a point.
ALIKE = {"taylor-hood": "mean-dilatation"}


class PointSystems:
    """A density at points by UFL on P1 simplices, with its first and second derivatives."""

    def __init__(self, formulation: str, d: int, psi_on) -> None:
        """Compile. Each rank by itself.

        Args:
            formulation: Its name.
            d: Dimension.
            psi_on: Makes Ψ, given a mesh.
        """
        msh = mesh.create_mesh(
            MPI.COMM_SELF,
            np.arange(COUNT * (d + 1), dtype=np.int64).reshape(COUNT, d + 1),
            basix.ufl.element("P", {2: "triangle", 3: "tetrahedron"}[d], 1, shape=(d,)),
            np.tile(np.vstack([np.zeros(d), np.eye(d)]), (COUNT, 1)),
        )
        self.psi = psi_on(msh)
        form = FORMULATIONS[ALIKE.get(formulation, formulation)]
        self.fields = form.fields(msh)
        self._volume = 1 / (d * (d - 1))
        density = form.density(*self.fields, self.psi)
        self._energy = density * ufl.dx
        dg0 = fem.functionspace(msh, ("DG", 0))
        residual = [derivative(self._energy, f, ufl.TestFunction) for f in self.fields]
        # Of two blocks that mirror each other one.
        blocks = {
            (i, j): expand_derivatives(derivative(residual[i], f, ufl.TrialFunction))
            for i in range(len(self.fields))
            for j, f in enumerate(self.fields[: i + 1])
        }
        self._pairs = [pair for pair, block in blocks.items() if not block.empty()]
        forms = [density * ufl.TestFunction(dg0) * ufl.dx, *residual]
        forms, self._blocks = compile_together([forms, [blocks[pair] for pair in self._pairs]])
        self._value, *self._residual = forms
        self._matrices = {
            pair: create_matrix(form) for pair, form in zip(self._pairs, self._blocks, strict=True)
        }
        # On a simplex with edges along the axes F_ij changes as u_i at the end of axis j does.
        self._nodes = self.fields[0].function_space.dofmap.list
        self._X = self.fields[0].function_space.tabulate_dof_coordinates()[:, :d]
        X = self._X[self._nodes]
        ends = np.stack([self._nodes[X[:, :, j] > 0.5] for j in range(d)], axis=1)
        self._columns = [(ends[:, None, :] * d + np.arange(d)[:, None]).reshape(COUNT, -1)]
        self._columns += [cell_dofs(f) for f in self.fields[1:]]
        self._cells = dg0.dofmap.list[:, 0]

    def at(self, F, others):
        """Value, gradient and Hessian of the density by F and the other fields, in this order.

        Args:
            F: Shape (points, d, d).
            others: Values of each other field as its dofs have them, shape (points, dofs a point).

        Returns:
            Shapes (points,), (points, N) and (points, N, N).
        """
        chunks = [slice(k, k + COUNT) for k in range(0, max(len(F), 1), COUNT)]
        found = [self._at(F[part], [values[part] for values in others]) for part in chunks]
        return [np.concatenate(parts) for parts in zip(*found, strict=True)]

    def _at(self, F, others):
        n, u = len(F), self.fields[0].x.array.reshape(-1, F.shape[1])
        nodes = self._nodes[:n]
        u[nodes] = np.einsum("cij,caj->cai", F - np.eye(F.shape[1]), self._X[nodes])
        for f, columns, values in zip(self.fields[1:], self._columns[1:], others, strict=True):
            f.x.array[columns[:n]] = values
        refresh([self._energy])
        value = fem.assemble_vector(self._value).array[self._cells]
        rows = zip(self._residual, self._columns, strict=True)
        gradient = np.hstack([fem.assemble_vector(form).array[columns] for form, columns in rows])
        ends = np.cumsum([0, *(columns.shape[1] for columns in self._columns)])
        hessian = np.zeros((COUNT, ends[-1], ends[-1]))
        for (i, j), form in zip(self._pairs, self._blocks, strict=True):
            A = self._matrices[i, j]
            A.zeroEntries()
            assemble_matrix(A, form)
            A.assemble()
            block = dense(A)[self._columns[i][:, :, None], self._columns[j][:, None, :]]
            at = slice(*ends[i : i + 2]), slice(*ends[j : j + 2])
            hessian[:, *at] = block
            hessian[:, *at[::-1]] = block.transpose(0, 2, 1)
        return [values[:n] / self._volume for values in (value, gradient, hessian)]


def with_eigenvalues(A: np.ndarray, modify: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Symmetric matrices with the same eigenvectors."""
    values, vectors = np.linalg.eigh((A + np.swapaxes(A, -1, -2)) / 2)
    return (vectors * modify(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def derivative(form, f, argument):
    return ufl.derivative(form, f, argument(f.function_space))


def cell_dofs(f: fem.Function) -> np.ndarray:
    """Local dofs of a field on each local cell, shape (cells, dofs a cell)."""
    dofs, bs = f.function_space.dofmap.list, f.function_space.dofmap.bs
    return (dofs[:, :, None] * bs + np.arange(bs)).reshape(len(dofs), -1)


class Reference:
    """The Newton system of a formulation, cell by cell, from systems at points.

    Attributes:
        F: At the points of this rank's cells, shape (points, d, d).
        energy: Of this rank's cells [J].
        residual: Of each of them by its dofs, field by field, shape (cells, dofs).
        jacobian: Shape (cells, dofs, dofs).
    """

    def __init__(self, systems: PointSystems, fields: Sequence[fem.Function]) -> None:
        """Prepare for the fields of a formulation of any degree on any cells. Collective."""
        V = fields[0].function_space
        msh, d = V.mesh, V.mesh.geometry.dim
        self._systems, self._fields, self._mesh = systems, fields, msh
        self._cells = np.arange(msh.topology.index_map(d).size_local, dtype=np.int32)
        X, weights = basix.make_quadrature(V.element.basix_element.cell_type, quadrature_degree(V))
        scale = fem.Expression(ufl.JacobianDeterminant(msh), X).eval(msh, self._cells)
        self._weights = np.abs(scale).reshape(-1, len(weights)) * weights
        self._F = fem.Expression(deformation_gradient(fields[0]), X)
        self.dofs = [cell_dofs(f)[self._cells] for f in fields]
        # How F and the other fields at a point change with the dofs of a cell.
        gradient = fem.Expression(ufl.grad(ufl.TrialFunction(V)), X).eval(msh, self._cells)
        maps = [gradient.reshape(*self._weights.shape, d * d, self.dofs[0].shape[1])]
        maps += [self._values_at(f, X) for f in fields[1:]]
        self._map = np.zeros((*self._weights.shape, *np.sum([m.shape[2:] for m in maps], axis=0)))
        row = column = 0
        for m in maps:
            rows, columns = m.shape[2:]
            self._map[:, :, row : row + rows, column : column + columns] = m
            row, column = row + rows, column + columns
        self._others = np.cumsum([m.shape[2] for m in maps])
        local = np.concatenate(
            [np.full(dofs.shape[1], is_local(f)) for f, dofs in zip(fields, self.dofs, strict=True)]
        )
        self._local, self._shared = np.flatnonzero(local), np.flatnonzero(~local)

    def _values_at(self, f: fem.Function, X) -> np.ndarray:
        """Values by dofs of a cell, of a field at the points or of a polynomial."""
        bs, nodes = f.function_space.dofmap.bs, f.function_space.dofmap.list.shape[1]
        if f.function_space.ufl_element().has_custom_quadrature:
            table = np.eye(len(X))
        else:
            table = f.function_space.element.basix_element.tabulate(0, X)[0, :, :, 0]
        values = np.einsum("qa,ij->qiaj", table, np.eye(bs)).reshape(len(X), bs, nodes * bs)
        return np.broadcast_to(values, (len(self._cells), *values.shape))

    def deformation_gradients(self) -> np.ndarray:
        """F at the points of this rank's cells now."""
        F = self._F.eval(self._mesh, self._cells)
        return F.reshape(-1, *F.shape[2:])

    def update(self) -> None:
        """Assemble at the present state of the fields."""
        state = self.on_cells([f.x.array for f in self._fields])
        cells, points = self._weights.shape
        values = np.einsum("cqij,cj->cqi", self._map, state).reshape(cells * points, -1)
        _, *others = np.split(values, self._others[:-1], axis=1)
        self.F = self.deformation_gradients()
        value, gradient, hessian = (
            a.reshape(cells, points, *a.shape[1:]) for a in self._systems.at(self.F, others)
        )
        self._hessian = hessian
        self.energy = float(np.sum(self._weights * value))
        weighted = self._weights[:, :, None, None] * self._map
        self.residual = np.einsum("cqij,cqi->cj", weighted, gradient)
        # The sum over the points within the product.
        rows = weighted.reshape(cells, -1, weighted.shape[3]).transpose(0, 2, 1)
        columns = (hessian @ self._map).reshape(cells, -1, weighted.shape[3])
        self.jacobian = rows @ columns

    def on_cells(self, values: Sequence[np.ndarray]) -> np.ndarray:
        """Values of fields on local dofs by the dofs of this rank's cells."""
        return np.hstack([v[dofs] for v, dofs in zip(values, self.dofs, strict=True)])

    def split(self, values: np.ndarray, fields: Sequence[int] | None = None) -> list[np.ndarray]:
        """Values by the dofs of this rank's cells, for each field."""
        sizes = [self.dofs[k].shape[1] for k in (fields or range(len(self.dofs)))]
        return np.split(values, np.cumsum(sizes)[:-1], axis=1)

    def condensed(self) -> np.ndarray:
        """Each cell's matrix on shared dofs, the others eliminated."""
        return self._block("s", "s") - self._block("s", "l") @ self._solved(self._block("l", "s"))

    def projected(self, modify: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """The same with its eigenvalues modified: by F at each point, or those of each cell.

        Of cells where there are polynomials on them. Only of a displacement beside local fields.
        """
        d2, points = self.F.shape[1] ** 2, self._weights.shape[1]
        if len(self._local) != points * (self._hessian.shape[2] - d2):
            return with_eigenvalues(self.condensed(), modify)
        H, n = self._hessian, len(self._shared)
        tangent = H[:, :, :d2, :d2] - H[:, :, :d2, d2:] @ np.linalg.solve(
            H[:, :, d2:, d2:], H[:, :, d2:, :d2]
        )
        B = self._map[:, :, :d2, :n]
        tangent = with_eigenvalues(tangent, modify) * self._weights[:, :, None, None]
        return np.einsum("cqki,cqkl,cqlj->cij", B, tangent, B, optimize=True)

    def eliminated(self, right: np.ndarray) -> np.ndarray:
        """What right-hand sides of local dofs, given on cells, add to those of shared ones."""
        return -np.einsum("cij,cj->ci", self._block("s", "l"), self._solved(right[:, self._local]))

    def recovered(self, right: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Changes of local dofs on cells, given right-hand sides and changes of shared ones."""
        moved = np.einsum("cij,cj->ci", self._block("l", "s"), step[:, self._shared])
        return self._solved(right[:, self._local] - moved)

    def _block(self, rows: str, columns: str) -> np.ndarray:
        dofs = {"s": self._shared, "l": self._local}
        return self.jacobian[:, dofs[rows][:, None], dofs[columns]]

    def _solved(self, right: np.ndarray) -> np.ndarray:
        if right.ndim == 2:
            return np.linalg.solve(self._block("l", "l"), right[:, :, None])[:, :, 0]
        return np.linalg.solve(self._block("l", "l"), right)
