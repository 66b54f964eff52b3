"""States and vectors for tests, the same on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from dolfinx import fem, mesh

from demos.by_hand import MATERIALS as WITNESSED
from solvers import MixedProblem

# What breadth in three dimensions is for: the formulations and materials with a witness or a
# kernel. All of them, in two dimensions, are the matter of test_formulations.
FIRST_FORMULATIONS = ("symmetric", "seed", "displacement")
FIRST_MATERIALS = tuple(WITNESSED)
FIRST = [(2, f, m) for f in FIRST_FORMULATIONS for m in FIRST_MATERIALS]
FIRST += [(3, f, "stable-neo-hookean") for f in FIRST_FORMULATIONS]
FIRST += [(3, "displacement", "corotational")]  # where R has its second derivative


def small_mesh(d: int, *, simplices: bool = True) -> mesh.Mesh:
    """A few unstructured-looking cells with moved vertices.

    8 triangles or 12 tetrahedra; or 4 quadrilaterals or 2 hexahedra.
    """
    comm = MPI.COMM_WORLD
    if d == 2:
        cell = mesh.CellType.triangle if simplices else mesh.CellType.quadrilateral
        msh = mesh.create_rectangle(comm, [(0.0, 0.0), (1.0, 1.0)], (2, 2), cell)
    else:
        cell = mesh.CellType.tetrahedron if simplices else mesh.CellType.hexahedron
        msh = mesh.create_box(comm, [(0.0, 0.0, 0.0), (2.0, 1.0, 1.0)], (2, 1, 1), cell)
    X = msh.geometry.x
    X[:, :d] += 0.08 * np.sin(5.0 * X[:, :d] + 3.0 * np.roll(X[:, :d], 1, axis=1))
    return msh


def random_values(f: fem.Function, seed: int) -> np.ndarray:
    """Values in [-1, 1] for every local dof of a Lagrange or cell-local function."""
    V, rng = f.function_space, np.random.default_rng(seed)
    msh, bs = V.mesh, V.dofmap.bs
    size = V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts
    if V.dofmap.list.size == size:
        index_map = msh.topology.index_map(msh.topology.dim)
        on_cell = V.dofmap.list.shape[1]
        table = rng.uniform(-1.0, 1.0, (index_map.size_global, on_cell, bs))
        values = np.empty((size, bs))
        values[V.dofmap.list] = table[msh.topology.original_cell_index]
        return values.ravel()
    if V.element.basix_element.degree > 1:
        phases = rng.uniform(10.0, 40.0, (bs, 3)) @ V.tabulate_dof_coordinates().T
        return np.sin(phases.T + rng.uniform(0.0, 6.0, bs)).ravel()
    numbers = msh.geometry.input_global_indices
    dofs = np.empty(len(numbers), dtype=np.int32)
    dofs[msh.geometry.dofmaps[0].ravel()] = V.dofmap.list.ravel()
    table = rng.uniform(-1.0, 1.0, (msh.geometry.index_map().size_global, bs))
    values = np.empty((len(dofs), bs))
    values[dofs] = table[numbers]
    return values.ravel()


def random_directions(
    fields: tuple[fem.Function, ...], stress: float, seed: int = 0
) -> list[np.ndarray]:
    """Changes of the fields with strains of some ten per cent and multipliers of `stress`.

    Strains are called S or H, rotations q, changes of volume theta.
    """
    amplitudes = {"u": 0.06, "S": 0.2, "H": 0.2, "q": 0.1, "theta": 0.1}
    return [
        amplitudes.get(f.name, stress) * random_values(f, seed + k) for k, f in enumerate(fields)
    ]


def field_vector(problem: MixedProblem, values: list[np.ndarray]) -> PETSc.Vec:
    """A PETSc vector in the problem's layout with the given local dof values, a list by field."""
    vector = problem.problem.x.duplicate()
    owned = [
        v[: f.function_space.dofmap.index_map.size_local * f.function_space.dofmap.index_map_bs]
        for f, v in zip(problem.fields, values, strict=True)
    ]
    vector.array_w[:] = np.concatenate(owned)
    return vector


def by_field(problem: MixedProblem, vector: PETSc.Vec) -> list[np.ndarray]:
    """The owned part of each field in a PETSc vector of the problem."""
    sizes = [
        f.function_space.dofmap.index_map.size_local * f.function_space.dofmap.index_map_bs
        for f in problem.fields
    ]
    return np.split(vector.array_r.copy(), np.cumsum(sizes)[:-1])


def global_norm(comm: MPI.Comm, owned: np.ndarray) -> float:
    """Euclidean norm of an array distributed over the ranks."""
    return float(np.sqrt(comm.allreduce(float(np.sum(owned**2)), op=MPI.SUM)))


def dense(A: PETSc.Mat) -> np.ndarray:
    """The whole matrix on every rank."""
    indptr, columns, values = A.getValuesCSR()
    first, last = A.getOwnershipRange()
    rows = np.zeros((last - first, A.size[1]))
    rows[np.repeat(np.arange(last - first), np.diff(indptr)), columns] = values
    return np.vstack(A.comm.tompi4py().allgather(rows))
