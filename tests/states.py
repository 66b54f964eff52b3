"""States and vectors for tests, the same on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from dolfinx import fem, mesh

from forms.discrete import MATERIALS as WITNESSED
from solvers import MixedProblem

# What breadth in three dimensions is for: the formulations and materials with a witness or a
# kernel. All of them, in two dimensions, are the matter of test_formulations.
FIRST_FORMULATIONS = ("symmetric", "seed", "displacement")
FIRST_MATERIALS = tuple(WITNESSED)


def small_mesh(d: int) -> mesh.Mesh:
    """A few unstructured-looking cells: 8 triangles or 12 tetrahedra with moved vertices."""
    comm = MPI.COMM_WORLD
    if d == 2:
        msh = mesh.create_rectangle(comm, [(0.0, 0.0), (1.0, 1.0)], (2, 2))
    else:
        msh = mesh.create_box(comm, [(0.0, 0.0, 0.0), (2.0, 1.0, 1.0)], (2, 1, 1))
    X = msh.geometry.x
    X[:, :d] += 0.08 * np.sin(5.0 * X[:, :d] + 3.0 * np.roll(X[:, :d], 1, axis=1))
    return msh


def random_values(f: fem.Function, seed: int) -> np.ndarray:
    """Values in [-1, 1] for every local dof of a P1 or DG0 function, by vertex or cell number."""
    V, rng = f.function_space, np.random.default_rng(seed)
    msh = V.mesh
    bs = V.dofmap.bs
    if V.element.basix_element.degree == 0:
        index_map, numbers = (
            msh.topology.index_map(msh.topology.dim),
            msh.topology.original_cell_index,
        )
        dofs = V.dofmap.list[:, 0]
    else:
        index_map, numbers = msh.geometry.index_map(), msh.geometry.input_global_indices
        dofs = np.empty(len(numbers), dtype=np.int32)
        dofs[msh.geometry.dofmaps[0].ravel()] = V.dofmap.list.ravel()
    table = rng.uniform(-1.0, 1.0, (index_map.size_global, bs))
    values = np.empty((len(dofs), bs))
    values[dofs] = table[numbers]
    return values.ravel()


def random_directions(
    fields: tuple[fem.Function, ...], stress: float, seed: int = 0
) -> list[np.ndarray]:
    """Changes of the fields with strains of some ten per cent and multipliers of `stress`.

    The fields are u, S or another strain, a multiplier, and a rotation, or the first few of them.
    """
    amplitudes = (0.06, 0.2, stress, 0.1)
    return [
        amplitude * random_values(f, seed + k)
        for k, (f, amplitude) in enumerate(zip(fields, amplitudes, strict=False))
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
