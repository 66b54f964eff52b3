"""Compiled kernels against UFL, the hand-derived derivatives and dense linear algebra."""

from __future__ import annotations

import sys

from mpi4py import MPI

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem, la, mesh
from dolfinx.fem.petsc import assemble_matrix

from forms import FORMULATIONS, MATERIALS, BackwardEuler, CellData, Corotational, mixed_fields
from forms.discrete import MATERIALS as DISCRETE
from forms.discrete import Polar, State, SymmetricSystem, symmetric_dofs, symmetric_tensor
from forms.kernels import MATERIALS as COMPILED
from forms.kernels import DisplacementKernel, SymmetricKernel
from tests.states import dense, random_directions, small_mesh

pytest.importorskip("numba")

COMM = MPI.COMM_WORLD
E, NU = 10.0, 0.3

both_dimensions = pytest.mark.parametrize("d", [2, 3])
every_material = pytest.mark.parametrize("material", COMPILED)


def close(values, reference, tolerance=1e-11):
    """Whether arrays distributed over the ranks agree, relative to their norm."""
    squares = np.array([np.sum((values - reference) ** 2), np.sum(reference**2)])
    COMM.Allreduce(MPI.IN_PLACE, squares)
    return bool(np.sqrt(squares[0]) <= tolerance * np.sqrt(squares[1])) and squares[1] > 0.0


def move(fields):
    """Fields far from rest."""
    for f, change in zip(fields, random_directions(fields, stress=E), strict=True):
        f.x.array[:] += change


def refresh(form):
    for c in form.coefficients():
        if isinstance(c, CellData):
            c.refresh()


def vector(form):
    """Contributions of this rank's cells to local dofs, before ranks are summed."""
    return fem.assemble_vector(fem.form(form)).array


# Against UFL, on a mesh whose cells share vertices


@both_dimensions
@every_material
def test_residual_and_energy_are_ufls(d, material):
    psi, formulation = MATERIALS[material](E, NU), FORMULATIONS["symmetric"]
    fields = formulation.fields(small_mesh(d))
    kernel = SymmetricKernel(*fields, psi)
    move(fields)
    energy = formulation.density(*fields, psi) * ufl.dx
    refresh(energy)
    residuals = [np.zeros_like(f.x.array) for f in fields]
    kernel.residual(*residuals)
    for f, r in zip(fields, residuals, strict=True):
        v = ufl.TestFunction(f.function_space)
        assert close(r, vector(ufl.derivative(energy, f, v)))
    assert np.isclose(
        COMM.allreduce(kernel.energy()),
        COMM.allreduce(fem.assemble_scalar(fem.form(psi(fields[1]) * ufl.dx))),
        rtol=1e-12,
    )


@both_dimensions
@pytest.mark.parametrize("projected", [False, True])
@pytest.mark.parametrize("formulation", ["symmetric", "displacement"])
def test_cells_make_up_the_matrix(d, formulation, projected):
    """v · K v is the sum over the same cells on a mesh where they share no vertex."""
    psi = MATERIALS["stable-neo-hookean"](E, NU)
    fields = FORMULATIONS[formulation].fields(small_mesh(d))
    kernel = FORMULATIONS[formulation].kernel(*fields, psi)
    move(fields)
    V = fields[0].function_space
    v = fem.Function(V)
    v.x.array[:] = random_directions((v,), 0.0, seed=3)[0]
    owned = v.x.array[: V.dofmap.index_map.size_local * d]
    together = COMM.allreduce(owned @ product(matrix_of(kernel, V, projected), v))

    cells = kernel_cells(fields[0])
    X = V.mesh.geometry.x[V.mesh.geometry.dofmaps[0][cells]].reshape(-1, 3)
    apart = FORMULATIONS[formulation].fields(
        mesh.create_mesh(
            MPI.COMM_SELF,
            np.arange(len(X)).reshape(-1, d + 1),
            V.mesh.ufl_domain().ufl_coordinate_element(),
            X[:, :d],
        )
    )
    order = apart[0].function_space.mesh.topology.original_cell_index
    w = fem.Function(apart[0].function_space)
    for f, g in ((v, w), *zip(fields, apart, strict=True)):
        f_map, g_map = f.function_space.dofmap, g.function_space.dofmap
        values = f.x.array.reshape(-1, f_map.bs)[f_map.list[cells]]
        g.x.array.reshape(-1, g_map.bs)[g_map.list] = values[order]
    kernel = FORMULATIONS[formulation].kernel(*apart, psi)
    blocks = np.zeros((len(kernel.couplings), d, d))
    kernel.matrix(blocks, projected=projected)
    assert len(blocks) == len(cells) * (d + 1) ** 2
    at_pairs = w.x.array.reshape(-1, d)[kernel.couplings]
    by_cells = np.einsum("pi,pij,pj", at_pairs[:, 0], blocks, at_pairs[:, 1])
    assert np.isclose(COMM.allreduce(by_cells), together, rtol=1e-12)


@both_dimensions
@every_material
def test_elimination_solves_ufls_block_system(d, material):
    """UFL's whole Jacobian, applied to what `recover` gives, returns the right-hand sides."""
    psi, formulation = MATERIALS[material](E, NU), FORMULATIONS["symmetric"]
    fields = formulation.fields(small_mesh(d))
    kernel = SymmetricKernel(*fields, psi)
    matrix_of(kernel, fields[0].function_space)
    move(fields)  # after a first use: each method reads the fields as they are
    energy = formulation.density(*fields, psi) * ufl.dx
    refresh(energy)

    directions = [fem.Function(f.function_space) for f in fields]
    du, dS, dY = (f.x.array for f in directions)
    right = [fem.Function(f.function_space) for f in fields[1:]]
    b_S, b_Y = (f.x.array for f in right)
    for f, change in zip(
        (directions[0], *right),
        random_directions((directions[0], *right), stress=1.0, seed=7),
        strict=True,
    ):
        f.x.array[:] = change
    kernel.recover(du, b_S, b_Y, dS, dY)
    for f in directions[1:]:
        f.x.scatter_forward()

    rows = [
        vector(
            ufl.derivative(
                ufl.derivative(energy, f, ufl.TestFunction(f.function_space)),
                fields,
                tuple(directions),
            )
        )
        for f in fields
    ]
    owned = len(kernel_cells(fields[1])) * fields[1].function_space.dofmap.bs
    assert close(rows[1][:owned], b_S[:owned])
    assert close(rows[2][:owned], b_Y[:owned])
    # K δu = J_uu δu + J_ul δl + what elimination adds to the right-hand side
    eliminated = np.zeros_like(du)
    kernel.eliminate(b_S, b_Y, eliminated)
    assert close(
        summed(fields[0], rows[0] + eliminated),
        product(matrix_of(kernel, fields[0].function_space), directions[0]),
    )


@both_dimensions
def test_kinematics_follow_the_displacement(d):
    """A kernel that has seen other displacements says what a new one says."""
    fields = FORMULATIONS["symmetric"].fields(small_mesh(d))
    psi = MATERIALS["stable-neo-hookean"](E, NU)
    used = SymmetricKernel(*fields, psi)
    move(fields)
    V, u = fields[0].function_space, fields[0].x.array
    rng = np.random.default_rng(COMM.rank)
    b = [rng.standard_normal(f.x.array.size) for f in fields]

    def answers(kernel):
        residuals, changes = ([np.zeros_like(f.x.array) for f in fields] for _ in range(2))
        kernel.residual(*residuals)
        kernel.eliminate(b[1], b[2], changes[0])
        kernel.recover(b[0], b[1], b[2], changes[1], changes[2])
        return [*residuals, *changes, matrix_of(kernel, V)]

    for change in (0.0, 1e-9, np.nan, 0.0):
        at_rest = u.copy()
        u[-1:] += change  # on every rank, maybe of one cell
        for a, reference in zip(answers(used), answers(SymmetricKernel(*fields, psi)), strict=True):
            assert np.array_equal(a, reference, equal_nan=True)
        u[:] = at_rest
        u *= 1.01


def kernel_cells(f):
    """The owned cells."""
    msh = f.function_space.mesh
    return np.arange(msh.topology.index_map(msh.topology.dim).size_local)


def summed(f, values):
    """Owned dofs of contributions of all ranks."""
    result = la.vector(f.function_space.dofmap.index_map, f.function_space.dofmap.bs)
    result.array[:] = values
    result.scatter_reverse(la.InsertMode.add)
    return result.array[: f.function_space.dofmap.index_map.size_local * f.function_space.dofmap.bs]


def matrix_of(kernel, V, projected=False):
    """A kernel's whole matrix on every rank."""
    dofmap, d = V.dofmap, V.dofmap.bs
    blocks = np.zeros((len(kernel.couplings), d, d))
    kernel.matrix(blocks, projected=projected)
    rows, columns = dofmap.index_map.local_to_global(kernel.couplings.ravel()).reshape(-1, 2).T
    vertices = dofmap.index_map.size_global
    A = np.zeros((vertices, vertices, d, d))
    A[rows, columns] = blocks
    COMM.Allreduce(MPI.IN_PLACE, A)
    return A.transpose(0, 2, 1, 3).reshape(d * vertices, -1)


def product(matrix, f):
    """A whole matrix times a function, owned dofs."""
    dofmap = f.function_space.dofmap
    owned = f.x.array[: dofmap.index_map.size_local * dofmap.bs]
    result = matrix @ np.concatenate(COMM.allgather(owned))
    first = dofmap.index_map.local_range[0] * dofmap.bs
    return result[first : first + len(owned)]


@both_dimensions
@every_material
def test_displacement_kernel_is_ufls(d, material):
    psi, formulation = MATERIALS[material](E, NU), FORMULATIONS["displacement"]
    (u,) = formulation.fields(small_mesh(d))
    kernel = DisplacementKernel(u, psi)
    move((u,))
    energy = formulation.density(u, psi) * ufl.dx
    refresh(energy)
    r = np.zeros_like(u.x.array)
    kernel.residual(r)
    V = u.function_space
    residual = ufl.derivative(energy, u, ufl.TestFunction(V))
    assert close(r, vector(residual))
    assert np.isclose(
        COMM.allreduce(kernel.energy()),
        COMM.allreduce(fem.assemble_scalar(fem.form(energy))),
        rtol=1e-12,
    )
    du = fem.Function(V)
    du.x.array[:] = random_directions((u,), 0.0, seed=3)[0]
    tangent = summed(u, vector(ufl.derivative(residual, u, du)))
    assert close(product(matrix_of(kernel, V), du), tangent)


# Against the hand-derived derivatives, cell by cell


class Separate:
    """Cells that share no vertex, at random F (det F < 0 in some), S, Y and Lamé parameters."""

    def __init__(self, d, material, cells=60, equilibrium=False, strain=1.0):
        rng = np.random.default_rng(d)
        m = d * (d + 1) // 2
        simplex = np.vstack([np.zeros(d), np.eye(d)])
        X = (
            simplex
            + rng.uniform(-0.2, 0.2, (cells, d + 1, d))
            + 3.0 * np.arange(cells)[:, None, None] * (np.arange(d) == 0)
        )
        first = COMM.rank == 0
        self.mesh = mesh.create_mesh(
            COMM,
            np.arange(cells * (d + 1)).reshape(cells, d + 1)[: cells if first else 0],
            basix.ufl.element("P", {2: "triangle", 3: "tetrahedron"}[d], 1, shape=(d,)),
            X.reshape(-1, d)[: None if first else 0],
        )
        self.u, self.S, self.Y = self.fields = mixed_fields(self.mesh)
        self.n = len(kernel_cells(self.u))
        self.d, self.number = d, self.mesh.topology.original_cell_index[: self.n]
        self.dofs = self.u.function_space.dofmap.list[: self.n]
        # Singular values well away from σ_i + σ_j = 0, where R has no derivative.
        U, V = (Polar(rng.uniform(-1.0, 1.0, (cells, d, d))).R for _ in range(2))
        sigma = 1.0 + strain * rng.uniform(-0.5, 0.8, (cells, d))
        if strain == 1.0:
            sigma[::3, -1] = rng.uniform(-0.4, 0.1, len(sigma[::3]))
            sigma[1::6] = sigma[1::6, :1]  # equal singular values
        F = np.einsum("nik,nk,njk->nij", U, sigma, V)
        mu, lam = rng.uniform(2.0, 5.0, cells), rng.uniform(3.0, 9.0, cells)
        x = self.u.function_space.tabulate_dof_coordinates()[:, :d]
        u = self.u.x.array.reshape(-1, d)
        for k, number in enumerate(self.number):
            X = x[self.dofs[k]]
            u[self.dofs[k]] = (X - X[0]) @ (F[number] - np.eye(d)).T
        self.F, self.mu, self.lam = F[self.number], mu[self.number], lam[self.number]
        self.polar = Polar(self.F)
        self.discrete = DISCRETE[material](self.mu, self.lam)
        if equilibrium:
            s = symmetric_dofs(self.polar.S)
            y = symmetric_dofs(self.discrete.stress(self.polar.S))
        else:
            s = symmetric_dofs(np.eye(d)) + 0.3 * rng.uniform(-1, 1, (cells, m))[self.number]
            y = 5.0 * rng.uniform(-1.0, 1.0, (cells, m))[self.number]
        for f, values in ((self.S, s), (self.Y, y)):
            f.x.array.reshape(-1, m)[f.function_space.dofmap.list[: self.n, 0]] = values
        self.s, self.y = s, y
        self.kernel = SymmetricKernel(*self.fields, (material, self.mu, self.lam))
        self.displacement = DisplacementKernel(self.u, (material, self.mu, self.lam))

    def hand_derived(self):
        """∂Sᵀ H ∂S + Y : ∂²S of each cell, shape (n, d², d²)."""
        ds = self.polar.ds
        geometric = self.polar.stretch_hessian(symmetric_tensor(self.y))
        return np.swapaxes(ds, 1, 2) @ self.discrete.H(self.s) @ ds + geometric

    def tangents(self, kernel, projected=False):
        """What a kernel's matrix says of each cell's tangent, shape (n, d², d²)."""
        A, d = matrix_of(kernel, self.u.function_space, projected), self.d
        x = self.u.function_space.tabulate_dof_coordinates()[:, :d]
        tangents = np.empty((self.n, d * d, d * d))
        for k, dofs in enumerate(self.dofs):
            # Displacements e_i X_j have the gradients e_i e_jᵀ.
            X = x[dofs] - x[dofs[0]]
            modes = np.einsum("im,aj->aimj", np.eye(d), X).reshape(-1, d * d)
            numbers = self.u.function_space.dofmap.index_map.local_to_global(dofs)
            places = (d * numbers[:, None] + np.arange(d)).ravel()
            volume = abs(np.linalg.det(X[1:])) / (2.0 if d == 2 else 6.0)
            tangents[k] = modes.T @ A[np.ix_(places, places)] @ modes / volume
        return tangents


def clamped(A):
    """Symmetric matrices with their negative eigenvalues raised to zero."""
    values, V = np.linalg.eigh(A)
    return np.einsum("nik,nk,njk->nij", V, np.maximum(values, 0.0), V)


def sizes(A):
    """The norm of each matrix."""
    return np.linalg.norm(A, axis=(1, 2))


@both_dimensions
@every_material
def test_tangents_are_the_hand_derived_ones(d, material):
    cells = Separate(d, material)
    assert COMM.allreduce(int(np.sum(np.linalg.det(cells.F) < 0.0))) > 5
    C = cells.tangents(cells.kernel)
    reference = cells.hand_derived()
    assert np.all(sizes(C - reference) < 1e-11 * sizes(reference))
    cells = Separate(d, material, equilibrium=True)
    C = cells.tangents(cells.displacement)
    reference = cells.hand_derived()
    assert np.all(sizes(C - reference) < 1e-11 * sizes(reference))


@both_dimensions
@every_material
def test_projection_of_the_displacement_tangent_is_the_nearest(d, material):
    """Against eigenvalues of the whole tangent; the mixed one comes to the same at Y = Ψ'(S_F)."""
    cells = Separate(d, material, equilibrium=True)
    exact = cells.hand_derived()
    nearest = clamped(exact)
    assert COMM.allreduce(int(np.sum(sizes(nearest - exact) > 0.1 * sizes(exact)))) > 5
    for kernel in (cells.displacement, cells.kernel):
        C = cells.tangents(kernel, projected=True)
        assert np.all(sizes(C - nearest) < 1e-11 * sizes(exact))


@both_dimensions
@every_material
def test_projected_tangent_is_positive(d, material):
    """Positive semi-definite anywhere; where the exact tangent is, the same."""
    for strain in (1.0, 0.02):
        cells = Separate(d, material, equilibrium=strain < 1.0, strain=strain)
        exact = cells.tangents(cells.kernel)
        projected = cells.tangents(cells.kernel, projected=True)
        lowest = np.linalg.eigvalsh(projected)[:, 0]
        assert np.all(lowest > -1e-12 * sizes(projected))
        positive = np.linalg.eigvalsh(exact)[:, 0] > 1e-10 * sizes(exact)
        difference = sizes(projected - exact)
        assert np.all(difference[positive] < 1e-13 * sizes(exact)[positive])
        changed = COMM.allreduce(int(np.sum(~positive)))
        assert changed > 20 if strain == 1.0 else changed < 60


@both_dimensions
@every_material
def test_projection_changes_the_spin_alone(d, material):
    """Where H is positive: minimised over sym A, the form on the spin is the nearest."""
    cells = Separate(d, material)
    exact, projected = (cells.tangents(cells.kernel, projected=p) for p in (False, True))
    # Orthonormal coordinates of A = RᵀδF: symmetric ones, then skew ones.
    basis = np.zeros((d * d, d, d))
    skew = [(i, j) for i in range(d) for j in range(i)]
    for k in range(d):
        basis[k, k, k] = 1.0
    for k, (i, j) in enumerate(skew):
        basis[d + k, [i, j], [j, i]] = np.sqrt(0.5)
        basis[d + len(skew) + k, [i, j], [j, i]] = np.sqrt(0.5), -np.sqrt(0.5)
    to_F = np.einsum("nik,pkj->nijp", cells.polar.R, basis).reshape(cells.n, d * d, d * d)
    m = d + len(skew)
    blocks = [np.swapaxes(to_F, 1, 2) @ C @ to_F for C in (exact, projected)]
    stiff = np.linalg.eigvalsh(blocks[0][:, :m, :m])[:, 0] > 0.05 * cells.mu
    assert COMM.allreduce(int(np.sum(stiff))) > 20
    exact, projected = (C[stiff] for C in blocks)
    spin = [
        C[:, m:, m:] - np.swapaxes(C[:, :m, m:], 1, 2) @ np.linalg.solve(C[:, :m, :m], C[:, :m, m:])
        for C in (exact, projected)
    ]
    assert np.all(sizes(spin[1] - clamped(spin[0])) < 1e-10 * (sizes(exact) + sizes(spin[0])))
    difference = projected - exact
    difference[:, m:, m:] = 0.0
    assert np.all(sizes(difference) < 1e-11 * sizes(exact))


# A dense solve


@pytest.mark.serial
@both_dimensions
@every_material
def test_block_system_is_solved_exactly(d, material):
    """δu, δS, δY from K, eliminate and recover: the hand-derived system's dense solution."""
    psi, h, rho = MATERIALS[material](E, NU), 0.4, 2.0
    fields = u, S, Y = mixed_fields(small_mesh(d))
    kernel = SymmetricKernel(*fields, psi)
    move(fields)
    V, m = u.function_space, d * (d + 1) // 2
    X = V.tabulate_dof_coordinates()[:, :d]
    state = State(
        X,
        V.dofmap.list,
        X + u.x.array.reshape(-1, d),
        *(symmetric_tensor(f.x.array.reshape(-1, m)) for f in (S, Y)),
    )
    discrete = DISCRETE[material](psi.mu, psi.lam)
    system = SymmetricSystem(state, discrete, rho=rho, h=h)
    matrix, _ = system.kkt()
    rng = np.random.default_rng(5)
    b = rng.uniform(-1.0, 1.0, matrix.shape[0])
    solution = np.linalg.solve(matrix.toarray(), b)

    b_u, b_S, b_Y = np.split(b, np.cumsum([X.size, S.x.array.size]))
    inertia = BackwardEuler(u, h).kinetic(rho) * ufl.dx
    v, w = ufl.TestFunction(V), ufl.TrialFunction(V)
    mass = assemble_matrix(fem.form(ufl.derivative(ufl.derivative(inertia, u, v), u, w)))
    mass.assemble()
    K = matrix_of(kernel, V) + dense(mass)
    right = b_u.copy()
    kernel.eliminate(b_S, b_Y, right)
    du = np.linalg.solve(K, right)
    dS, dY = np.empty_like(b_S), np.empty_like(b_Y)
    kernel.recover(du, b_S, b_Y, dS, dY)
    assert close(np.concatenate([du, dS, dY]), solution)
    condensed, _ = system.condensed()
    assert close(K, condensed.toarray())


# What cannot be done is said


def test_materials_without_a_kernel_are_refused():
    u, S, Y = mixed_fields(small_mesh(2))

    class Own(Corotational):
        """May be another energy than that which it inherits."""

    for psi in (Own(E, NU), ("neo-hookean", 1.0, 1.0), lambda S: ufl.tr(S)):
        with pytest.raises(ValueError, match=r"no compiled kernel for .*; there are as-rigid-as-"):
            SymmetricKernel(u, S, Y, psi)
    with pytest.raises(ValueError, match="lam has shape"):
        DisplacementKernel(u, ("corotational", 1.0, np.ones(10**4)))


def test_fields_without_a_kernel_are_refused():
    msh = small_mesh(3)
    u, S, _ = mixed_fields(msh)
    psi = MATERIALS["corotational"](E, NU)
    full = mixed_fields(msh, multiplier="full")[2]
    with pytest.raises(ValueError, match="the field Lam is not a symmetric DG0 tensor"):
        SymmetricKernel(u, S, full, psi)
    quadratic = fem.Function(fem.functionspace(msh, ("P", 2, (3,))))
    with pytest.raises(ValueError, match="the displacement is not P1"):
        DisplacementKernel(quadratic, psi)


def test_missing_numba_is_said(monkeypatch):
    u, S, Y = mixed_fields(small_mesh(2))
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ModuleNotFoundError, match="compiled kernels need numba"):
        SymmetricKernel(u, S, Y, MATERIALS["corotational"](E, NU))
