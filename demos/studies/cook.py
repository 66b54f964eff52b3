"""Cook's membrane: its mesh, published tip displacements, and a reference in linear elasticity.

A tapered panel with corners (0, 0), (48, 44), (48, 60), (0, 44), clamped on the left, pulled up
along the right by a total force F; plane strain. What is told is E w / F for the displacement w of
a point on the right in linear elasticity, which depends on ν alone.

R. D. Cook, Improved two-dimensional finite element, J. Struct. Div. ASCE 100 (1974) 1851-1863.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import LinearProblem

from forms import lame_parameters
from meshes import Body, box

HEIGHT = 16.0  # of the loaded face
MIDDLE, CORNER = (48.0, 52.0), (48.0, 60.0)  # of the loaded face

PUBLISHED = {
    # 23.96 in plane stress with E = 1 and ν = 1/3, which is plane strain with E = 15/16 and ν = 1/4
    # (R. D. Cook, D. S. Malkus, M. E. Plesha, Concepts and Applications of Finite Element Analysis,
    # 3rd ed., Wiley, 1989, section 6.13).
    1 / 4: (MIDDLE, 23.96 * 15 / 16),
    # 32.27 with E = 70 and F = 100: CalculiX and Elmer on very fine quadratic meshes (CoFEA
    # benchmark 002, Cook's membrane).
    1 / 3: (CORNER, 32.27 * 70 / 100),
    # 16.4326 with μ = 0.375 and λ = 7500, extrapolated after Richardson (P. Krysl, FinEALE, example
    # Cook_3D_strain).
    0.499975: (MIDDLE, 16.4326 * 1.12498125),
}
"""Point and E w / F by ν, in plane strain."""


def membrane(comm: MPI.Comm, n: int, cell: str = "triangle") -> Body:
    """The panel cut into n × n quadrilaterals, or each of these into two triangles. Collective."""
    body = box(comm, (1.0, 1.0), (n, n), cell)
    x = body.mesh.geometry.x
    s, t = x[:, 0].copy(), x[:, 1].copy()
    x[:, 0] = 48.0 * s
    x[:, 1] = 44.0 * s + t * (44.0 - 28.0 * s)
    return body


def reference(comm: MPI.Comm, nu: float, point: tuple[float, float] = MIDDLE, n: int = 64) -> float:
    """E w / F by linear elasticity in displacement and pressure, Taylor and Hood's P2/P1.

    It shares nothing with the formulations, and does not lock. Collective.

    Args:
        comm: Communicator.
        nu: Poisson's ratio.
        point: A vertex of the mesh.
        n: Quadrilaterals along each edge.
    """
    msh = membrane(comm, n).mesh
    cell = msh.basix_cell()
    pair = [basix.ufl.element("P", cell, 2, shape=(2,)), basix.ufl.element("P", cell, 1)]
    W = fem.functionspace(msh, basix.ufl.mixed_element(pair))
    (u, p), (v, q) = ufl.TrialFunctions(W), ufl.TestFunctions(W)
    mu, lam = lame_parameters(1.0, nu)
    strain, virtual = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
    density = 2 * mu * ufl.inner(strain, virtual) + p * ufl.div(v) + q * ufl.div(u) - p * q / lam
    traction = ufl.as_vector([0.0, 1.0 / HEIGHT])
    on_face = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(msh)[0], 48.0 - 1e-6), 1.0, 0.0)
    L = ufl.inner(traction, v) * on_face * ufl.ds
    V, _ = W.sub(0).collapse()
    held: Any = fem.locate_dofs_geometrical((W.sub(0), V), lambda X: np.isclose(X[0], 0.0))
    bc = fem.dirichletbc(fem.Function(V), held, W.sub(0))
    solver = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    problem = LinearProblem(
        density * ufl.dx, L, bcs=[bc], petsc_options=solver, petsc_options_prefix="cook_"
    )
    solution: Any = problem.solve()
    return value_at(solution.sub(0).collapse(), point)[1]


def value_at(u: fem.Function[Any], point: tuple[float, float]) -> tuple[float, float]:
    """The values of a plane vector field at a vertex of the mesh. Collective."""
    V = u.function_space
    blocks = fem.locate_dofs_geometrical(
        V, lambda X: np.isclose(X[0], point[0]) & np.isclose(X[1], point[1])
    )
    mine = blocks[blocks < V.dofmap.index_map.size_local]
    values = u.x.array.reshape(-1, 2)[mine].sum(axis=0)
    first, second = (float(value) for value in V.mesh.comm.allreduce(values))
    return first, second
