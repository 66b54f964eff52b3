# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # The Newton system by hand, and by UFL
#
# A mixed method for elastic bodies keeps three unknowns: positions x, a symmetric right stretch S
# in each cell, and a multiplier Λ that holds S to the stretch of F = ∂x/∂X. One time step makes
#
#     ∫ ρ/(2h²) |x - x̃|² + Ψ(S) - Λ : (R(F) S - F) dV,    x̃ = x^t + h ẋ^t + h² f_ext        (1)
#
# stationary, R being the rotation of F. The seed of this project derives Newton's method for it on
# paper, in forty equations. Here we walk through them. Each is written twice, in NumPy from the
# paper and in UFL from (1), and the two must agree to round-off. Numbers in brackets are the
# seed's.

# %%
from mpi4py import MPI

import numpy as np
import scipy.linalg
import ufl
from dolfinx import fem
from ufl import Measure, TestFunction, TrialFunction, derivative, inner

from demos.compare_assembly import Assembler
from demos.compare_cases import make_body, make_state, rest_state
from forms import (
    BackwardEuler,
    StableNeoHookean,
    deformation_gradient,
    mixed_fields,
    polar_rotation,
    seed,
)
from forms import discrete as hand
from solvers import MixedProblem

# %% [markdown]
# The body is a distorted box of twelve tetrahedra whose vertices, cells and corners of cells come
# in random order. It runs on any number of MPI ranks; `Assembler` collects what they assemble into
# arrays in the order of the mesh file, the order in which NumPy works too.

# %%
comm = MPI.COMM_WORLD
body = make_body(comm, "12 tetrahedra, renumbered")
assembler = Assembler(body)

psi = StableNeoHookean(E=10.0, nu=0.3)  # [Pa], [-]
rho, h = 2.0, 0.4  # [kg/m³], [s]
f_ext = np.array([0.0, -9.81, 1.0])  # [m/s²]
velocity_gradient = np.array([[0.3, -1.5, 0.0], [1.5, -0.2, 0.4], [0.0, 0.1, 0.6]])  # [1/s]


def agree(equation, by_hand, by_ufl, tolerance=1e-10):
    """Print the relative difference, and insist that it is small."""
    difference = np.linalg.norm(by_hand - by_ufl) / np.linalg.norm(by_ufl)
    if comm.rank == 0:
        print(f"{equation:<32} {difference:.1e}")
    assert difference < tolerance, equation


def array(form, *fields):
    """A UFL form as an array: one axis for each field it is tested against."""
    compiled = fem.form(ufl.algorithms.expand_derivatives(form))
    assemble = (assembler.scalar, assembler.vector, assembler.matrix)[len(fields)]
    return assemble(compiled, *(f.function_space for f in fields))


# %% [markdown]
# We stand at no particular point: the body is turned, strained and not even feasible, S is not the
# stretch of F and Λ is any matrix. What agrees here agrees everywhere. In UFL the three unknowns
# are finite element functions, P1 for u = x - X and one constant a cell for S and Λ.

# %%
state = make_state(rest_state(body, assembler), "infeasible", "seed", stress=psi.mu)
X, cells, x, Lam_K, S_K = state.X, state.cells, state.x, state.Lam, state.S
n = len(cells)

u, S, Lam = mixed_fields(body.mesh, multiplier="full")
assembler.put(u, x - X)
assembler.put(S, hand.symmetric_dofs(S_K))
assembler.put(Lam, Lam_K)

# %% [markdown]
# ## Cells
#
# On a linear tetrahedron with volume V_K the deformation gradient is a constant and a linear map
# of the positions, (4):
#
#     J_K x = vec(F_K),    vec row by row.
#
# The gradients of the hat functions are the rows of an inverse of the cell's edges. In UFL we test
# a matrix field against one constant a cell, T, which multiplies everything by V_K.

# %%
edges = X[cells[:, 1:]] - X[cells[:, :1]]
V = np.abs(np.linalg.det(edges)) / 6.0
hats = np.swapaxes(np.linalg.inv(edges), 1, 2)
hats = np.concatenate([-hats.sum(axis=1, keepdims=True), hats], axis=1)
J = np.zeros((n, 9, X.size))
for K, cell in enumerate(cells):
    for a, vertex in enumerate(cell):
        for i in range(3):
            J[K, 3 * i : 3 * i + 3, 3 * vertex + i] = hats[K, a]
F_K = (J @ x.ravel()).reshape(n, 3, 3)

dx = Measure("dx", body.mesh)
T = TestFunction(Lam.function_space)
v, dS, dLam = (TestFunction(f.function_space) for f in (u, S, Lam))
du, ds = (TrialFunction(f.function_space) for f in (u, S))
F = deformation_gradient(u)

agree("(4) J_K x", (V[:, None, None] * F_K).ravel(), array(inner(F, T) * dx, Lam))
agree(
    "(4) J_K",
    (V[:, None, None] * J).reshape(9 * n, -1),
    array(inner(derivative(F, u, du), T) * dx, Lam, u),
)

# %% [markdown]
# ## The rotation
#
# R = U Vᵀ with F = U Σ Vᵀ, (14), where U and V are rotations and the smallest singular value takes
# the sign of det F. The derivatives of U and V that (15) asks for do not exist where two singular
# values are equal, as at rest. Their combination does: with P = Uᵀ δF V
#
#     (Uᵀ δR V)_ij = (P_ij - P_ji) / (σ_i + σ_j).
#
# On the UFL side R is an expression around numbers that the same decomposition supplies, exact in
# its first two derivatives; UFL knows nothing of singular values.

# %%
U, sigma, Vt = np.linalg.svd(F_K)
for factor, last in ((U, U[:, :, 2]), (Vt, Vt[:, 2, :])):
    sign = np.sign(np.linalg.det(factor))
    last *= sign[:, None]
    sigma[:, 2] *= sign
R_K = U @ Vt
P = np.einsum("nka,nbl->nabkl", U, Vt)
sums = (sigma[:, :, None] + sigma[:, None, :])[..., None, None]
dR = np.einsum("nia,nabkl,nbj->nijkl", U, (P - np.swapaxes(P, 1, 2)) / sums, Vt)

R = polar_rotation(u)

agree("(14) R_K", (V[:, None, None] * R_K).ravel(), array(inner(R, T) * dx, Lam))
agree(
    "(15) ∂R_K/∂x",
    np.einsum("n,nijq,nqp->nijp", V, dR.reshape(n, 3, 3, 9), J).reshape(9 * n, -1),
    array(inner(derivative(R, u, du), T) * dx, Lam, u),
)

# %% [markdown]
# Six numbers s_K make up a symmetric S_K = Σ_k s_k B_k. The matrix W_K of (3) and (16) maps them to
# R S, and Ŵ_K of (17) is its derivative by F. Its index order matters: (18)-(33) make sense only
# if the entry of F comes first, then that of R S, then the dof of S.

# %%
B = hand.symmetric_basis(3)
s_K = hand.symmetric_dofs(S_K)
W_K = np.einsum("nim,kmj->nijk", R_K, B).reshape(n, 9, 6)
W_hat = np.einsum("nimpq,kmj->npqijk", dR, B).reshape(n, 9, 9, 6)

agree(
    "(3) vec(R S)",
    np.einsum("n,nik,nk->ni", V, W_K, s_K).ravel(),
    array(inner(R * S, T) * dx, Lam),
)
agree(
    "(16) W_K",
    scipy.linalg.block_diag(*(V[:, None, None] * W_K)),
    array(inner(R * ds, T) * dx, Lam, S),
)
for k in range(6):
    agree(
        f"(17) Ŵ_K, dof {k} of S",
        np.einsum("n,nqi,nqp->nip", V, W_hat[..., k], J).reshape(9 * n, -1),
        array(inner(derivative(R * fem.Constant(body.mesh, B[k]), u, du), T) * dx, Lam, u),
    )

# %% [markdown]
# ## The energy
#
# With the mass matrix M the energy (2) is a sum of three, (6): kinetic, (7), elastic, and the
# constraint (12), which is Λ against c_K = W_K s_K - J_K x. The time step starts at x itself, with
# a velocity that spins and strains the body. UFL integrates (1) as it stands.

# %%
M = np.zeros((X.size, X.size))
for K, cell in enumerate(cells):
    dofs = (3 * cell[:, None] + np.arange(3)).ravel()
    local = rho * V[K] / 20.0 * (1.0 + np.eye(4))
    M[np.ix_(dofs, dofs)] += np.kron(local, np.eye(3))
lam_K = Lam_K.reshape(n, 9)
c_K = np.einsum("nik,nk->ni", W_K, s_K) - F_K.reshape(n, 9)
velocity = X @ velocity_gradient.T
ahead = (h * velocity + h**2 * f_ext).ravel()  # x̃ - x
material = hand.StableNeoHookean(psi.mu, psi.lam)

E_M = ahead @ M @ ahead / (2.0 * h**2)
E_Psi = V @ material.psi(s_K)
E_Lambda = V @ np.einsum("ni,ni->n", lam_K, c_K)

scheme = BackwardEuler(u, h, f_ext.tolist())
assembler.put(scheme.v, velocity)
kinetic = scheme.kinetic(rho) * dx
energy = (psi(S) - inner(Lam, R * S - F)) * dx + kinetic

agree("(2) energy", np.array([E_M + E_Psi - E_Lambda]), np.array([array(energy)]))

# %% [markdown]
# ## First derivatives
#
# The gradient by x collects that of the kinetic energy, g_x = M (x - x̃)/h² in (27), and that of the
# constraint, (18). The seed's own g_x in (9) is a displacement, which its later equations do not
# mean; and J_K in (18) has to be transposed. By S there are g_K and (19), by Λ there is (20).

# %%
g_x = -M @ ahead / h**2
g_K = material.g(s_K)
W_s = np.einsum("njkl,nl->njk", W_hat, s_K)  # Ŵ_K · s_K
W_lam = np.einsum("njkl,nk->njl", W_hat, lam_K)  # Ŵ_K · λ_K
E_x = np.einsum("n,njp,njk,nk->p", V, J, W_s - np.eye(9), lam_K)
E_s = np.einsum("n,nik,ni->nk", V, W_K, lam_K)

agree("(9), (18) ∂E/∂x", g_x - E_x, array(derivative(energy, u, v), u))
agree("(10), (19) ∂E/∂s", (V[:, None] * g_K - E_s).ravel(), array(derivative(energy, S, dS), S))
agree("(20) ∂E/∂λ", -(V[:, None] * c_K).ravel(), array(derivative(energy, Lam, dLam), Lam))

# %% [markdown]
# ## Second derivatives
#
# Of the mixed ones the seed makes three matrices,
#
#     F = ∂²E/∂s∂x (32),    G = ∂²E/∂λ∂x (33),    D = ∂²E/∂λ∂s (34).
#
# It prints D without the volume that F and G carry. For UFL they are derivatives of derivatives.

# %%
F_block = -np.einsum("n,njl,njp->nlp", V, W_lam, J).reshape(6 * n, -1)
G_block = np.einsum("n,njk,njp->nkp", V, np.eye(9) - W_s, J).reshape(9 * n, -1)
D_block = -scipy.linalg.block_diag(*(V[:, None, None] * W_K))
H_block = scipy.linalg.block_diag(*(V[:, None, None] * material.H(s_K)))

dE_ds, dE_dlam = derivative(energy, S, dS), derivative(energy, Lam, dLam)

F_ufl = array(derivative(dE_ds, u, du), S, u)
G_ufl = array(derivative(dE_dlam, u, du), Lam, u)
D_ufl = array(derivative(dE_dlam, S, ds), Lam, S)
H_ufl = array(derivative(dE_ds, S, ds), S, S)

agree("(23), (32) F", F_block, F_ufl)
agree("(22), (33) G", G_block, G_ufl)
agree("(21), (34) D", D_block, D_ufl)
agree("(11) H", H_block, H_ufl)

# %% [markdown]
# One derivative the seed leaves open, (24): "i'll get around to it". It needs ∂²R/∂F². Since F is
# linear in x, ∂²E_Λ/∂x² = Σ J_Kᵀ (∂²φ/∂F²) J_K V_K with φ(F) = (Λ S) : R(F), and its closed form
# needs one 3×3 solve a cell; `forms.discrete.rotation` has the derivation. UFL differentiates once
# more.

# %%
second = hand.Polar(F_K).rotation_hessian(Lam_K @ S_K)
E_xx = np.einsum("n,nip,nij,njq->pq", V, J, second, J)

agree("(24) ∂²E/∂x²", M / h**2 - E_xx, array(derivative(derivative(energy, u, v), u, du), u, u))

# %% [markdown]
# ## The Newton system
#
# With λ for the new multiplier λ^t + δλ a step solves
#
#     | M/h²  Fᵀ  Gᵀ | | δx |   | -g_x |
#     | F     H   Dᵀ | | δs | = | -g_s |        (35)
#     | G     D   0  | | λ  |   |  c   |
#
# The signs are right, if H, g_s and c carry volumes as F, G and D do. The matrix is UFL's Hessian
# of (1) but for (24), which the seed drops, and the right-hand side is that of Newton's method once
# the old multiplier has been moved across.

# %%
zero = np.zeros((9 * n, 9 * n))
matrix = np.block(
    [[M / h**2, F_block.T, G_block.T], [F_block, H_block, D_block.T], [G_block, D_block, zero]]
)
rhs = np.concatenate([-g_x, -(V[:, None] * g_K).ravel(), (V[:, None] * c_K).ravel()])

M_ufl = array(derivative(derivative(kinetic, u, v), u, du), u, u)
matrix_ufl = np.block([[M_ufl, F_ufl.T, G_ufl.T], [F_ufl, H_ufl, D_ufl.T], [G_ufl, D_ufl, zero]])
gradient_ufl = np.concatenate(
    [array(derivative(energy, f, test), f) for f, test in ((u, v), (S, dS), (Lam, dLam))]
)
old = np.concatenate([np.zeros(X.size + 6 * n), lam_K.ravel()])

agree("(35) matrix", matrix, matrix_ufl)
agree("(35) right-hand side", rhs, matrix_ufl @ old - gradient_ufl)

# %% [markdown]
# The second row gives δs, (36). Put into the others it leaves M̃ = M/h² - Fᵀ H⁻¹ F (39),
# J̃ = G - D H⁻¹ F (40) and the reduced system (41). The same comes out of UFL's matrix by blind
# elimination.

# %%
H_inv = np.linalg.inv(H_block)
M_tilde = M / h**2 - F_block.T @ H_inv @ F_block
J_tilde = G_block - D_block @ H_inv @ F_block
reduced = np.block([[M_tilde, J_tilde.T], [J_tilde, -D_block @ H_inv @ D_block.T]])

is_s = np.repeat([False, True, False], [X.size, 6 * n, 9 * n])
rows, s_rows = matrix_ufl[~is_s], matrix_ufl[is_s]
schur = rows[:, ~is_s] - rows[:, is_s] @ np.linalg.solve(s_rows[:, is_s], s_rows[:, ~is_s])

agree("(39)-(41) reduced matrix", reduced, schur)

# %% [markdown]
# ## What is wrong with it
#
# Count the rank. Rᵀ c = S - RᵀF is symmetric whatever x is, so that three of the nine rows of c say
# nothing. At every feasible state R times any skew matrix is in the null space of (35) and of (41):
# three vectors a cell. `forms.discrete` has all of the above as a class, which we use from here on.

# %%
options = {"rho": rho, "h": h, "v": velocity, "f_ext": f_ext}
feasible = make_state(rest_state(body, assembler), "feasible", "seed", stress=psi.mu)
printed = hand.SeedSystem(feasible, material, **options, second_derivatives=False)
for number, equations in ((35, printed.kkt()), (41, printed.reduced())):
    values = np.linalg.svd(equations[0].toarray(), compute_uv=False)
    nullity = np.count_nonzero(values < 1e-12 * values[0])
    if comm.rank == 0:
        print(f"({number}): {len(values)} unknowns, {nullity} null vectors in {n} cells")
    assert nullity == 3 * n

# %% [markdown]
# A direct solver may divide by round-off there and return garbage in the skew part of RᵀΛ. There
# are two exact cures. Either Λ = R Y with Y symmetric, which has six components for six
# constraints. Or the energy gets another term, -(ε/2) |skew(RᵀΛ)|², which holds the useless part
# at zero and changes neither x nor S nor sym(RᵀΛ). For this material `forms.seed` takes ε = 1/μ.

# %%
cured = hand.SeedSystem(feasible, material, **options, eps=1.0 / psi.mu)
values = np.linalg.svd(cured.kkt()[0].toarray(), compute_uv=False)
assert values[-1] > 1e-6 * values[0]

cured_energy = seed(u, S, Lam, psi) * dx + kinetic

# %% [markdown]
# ## A time step
#
# Does it all make a method? We start at rest with the given velocity. The solver of this project
# is handed the UFL energy, and PETSc factorises the whole of (35). By hand we solve (41), with (24)
# and the cure, and find δs by (36). After as many iterations both must be in the same state, and
# that state must be stationary.

# %%
at_rest = hand.State.at_rest(X, cells)
for field, start in ((u, 0.0 * X), (S, at_rest.s), (Lam, at_rest.Lam), (scheme.u_old, 0.0 * X)):
    assembler.put(field, start)
result = MixedProblem(cured_energy, (u, S, Lam), solver="direct").solve()

system = hand.SeedSystem(at_rest, material, **options, eps=1.0 / psi.mu)
residuals = [np.linalg.norm(system.gradient())]
for _ in range(result.iterations):
    step = hand.solve_reduced(system)
    system = system.moved(step.dx, step.ds, step.lam - system.lam)
    residuals.append(np.linalg.norm(system.gradient()))
assert residuals[-1] < 1e-9 * residuals[0]

if comm.rank == 0:
    print("residual of each iteration:", ", ".join(f"{r:.1e}" for r in residuals))


def in_file_order(f):
    """The values of a field in the order of the mesh file."""
    owned = f.function_space.dofmap.index_map.size_local * f.function_space.dofmap.index_map_bs
    return assembler.gather(f.function_space, f.x.array[:owned])


agree("step: x", system.state.x.ravel(), X.ravel() + in_file_order(u), tolerance=1e-9)
agree("step: s", system.s.ravel(), in_file_order(S), tolerance=1e-9)
agree("step: λ", system.lam, in_file_order(Lam), tolerance=1e-9)

# %% [markdown]
# ## Errata
#
# `mixed-fem compare` repeats these comparisons for every equation, material and formulation, at
# rest, feasible and not. What it, and the tests of `forms.discrete`, found to need a correction:

# %%
if comm.rank == 0:
    for erratum in hand.ERRATA:
        if erratum.verdict == "corrected":
            print(f"({erratum.number}) {erratum.states}")
            print(f"     printed:   {erratum.printed}")
            print(f"     corrected: {erratum.corrected}")
