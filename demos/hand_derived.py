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
from dolfinx import fem
from ufl import Measure, TestFunction, TrialFunction, derivative, inner

from demos import by_hand as hand
from demos.by_hand.compare.assembly import Assembler
from demos.by_hand.compare.bodies import make_body, make_state, rest_state
from forms import (
    BackwardEuler,
    StableNeoHookean,
    deformation_gradient,
    mixed_fields,
    polar_rotation,
    seed,
)
from solvers import MixedProblem

# %% [markdown]
# The body is a distorted box of twelve tetrahedra whose vertices, cells and corners of cells come
# in random order. It runs on any number of MPI ranks; `Assembler` collects what they assemble into
# arrays in the order of the mesh file, the order in which NumPy works too.

# %%
comm = MPI.COMM_WORLD
body = make_body(comm, "12 tetrahedra, renumbered")
assembler = Assembler(body)
array = assembler.array  # of a UFL form, with an axis for each field it is tested against

E, nu = 10.0, 0.3  # [Pa], [-]
rho, h = 3.0, 0.4  # [kg/m³], [s]
f_ext = np.array([2.0, -9.81, 1.0])  # [m/s²]
velocity_gradient = np.array([[0.3, -1.5, 0.0], [1.5, -0.2, 0.4], [0.0, 0.1, 0.6]])  # [1/s]


def agree(equation, by_hand, by_ufl, tolerance=1e-10):
    """Print the relative difference, and insist that it is small."""
    difference = np.linalg.norm(np.ravel(by_hand) - np.ravel(by_ufl)) / np.linalg.norm(by_ufl)
    if comm.rank == 0:
        print(f"{equation:<32} {difference:.1e}")
    assert difference < tolerance, equation


# %% [markdown]
# We stand at no particular point: the body is turned, strained and not even feasible, S is not the
# stretch of F and Λ is any matrix. In UFL the three unknowns are finite element functions, P1 for
# u = x - X and one constant a cell for S and Λ.

# %%
state = make_state(rest_state(body), "infeasible", "seed", stress=0.4 * E)
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
V_3 = V[:, None, None]  # before matrices
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
agree("(4) J_K x", V_3 * F_K, array(inner(F, T) * dx, Lam))
agree("(4) J_K", V_3 * J, array(inner(derivative(F, u, du), T) * dx, Lam, u))

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
U, sigma, V_F = hand.signed_svd(F_K)
R_K = U @ np.swapaxes(V_F, 1, 2)
P = np.einsum("nka,nlb->nabkl", U, V_F)
sums = (sigma[:, :, None] + sigma[:, None, :])[..., None, None]
dR = np.einsum("nia,nabkl,njb->nijkl", U, (P - np.swapaxes(P, 1, 2)) / sums, V_F)
dR_9 = dR.reshape(n, 9, 9)

R = polar_rotation(deformation_gradient(u))
agree("(14) R_K", V_3 * R_K, array(inner(R, T) * dx, Lam))
agree("(15) ∂R_K/∂x", V_3 * (dR_9 @ J), array(inner(derivative(R, u, du), T) * dx, Lam, u))

# %% [markdown]
# Six numbers s_K make up a symmetric S_K = Σ_k s_k B_k. The matrix W_K of (3) and (16) maps them to
# R S, and Ŵ_K of (17) is its derivative by F. Its index order matters: (18)-(33) make sense only
# if the entry of F comes first, then that of R S, then the dof of S.

# %%
B = hand.symmetric_basis(3)
s_K = hand.symmetric_dofs(S_K)
W_K = np.einsum("nim,kmj->nijk", R_K, B).reshape(n, 9, 6)
W_hat = np.einsum("nimpq,kmj->npqijk", dR, B).reshape(n, 9, 9, 6)

VW = scipy.linalg.block_diag(*(V_3 * W_K))
agree("(3) vec(R S)", VW @ s_K.ravel(), array(inner(R * S, T) * dx, Lam))
agree("(16) W_K", VW, array(inner(R * ds, T) * dx, Lam, S))
for k in range(6):
    R_B = R * fem.Constant(body.mesh, B[k])
    by_hand = V_3 * (np.swapaxes(W_hat[..., k], 1, 2) @ J)
    agree(f"(17) Ŵ_K, dof {k} of S", by_hand, array(inner(derivative(R_B, u, du), T) * dx, Lam, u))

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
mu, lam = hand.lame_parameters(E, nu)
material = hand.StableNeoHookean(mu, lam)

E_M = ahead @ M @ ahead / (2.0 * h**2)
E_Psi = V @ material.psi(s_K)
E_Lambda = V @ np.einsum("ni,ni->n", lam_K, c_K)

psi = StableNeoHookean(E, nu)
scheme = BackwardEuler(u, h, f_ext.tolist())
assembler.put(scheme.v, velocity)
kinetic = scheme.kinetic(rho) * dx
energy = (psi(S) - inner(Lam, R * S - F)) * dx + kinetic
agree("(2) energy", E_M + E_Psi - E_Lambda, array(energy))

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

dE_dx, dE_ds, dE_dlam = (derivative(energy, *p) for p in ((u, v), (S, dS), (Lam, dLam)))
gradient_ufl = [array(dE_dx, u), array(dE_ds, S), array(dE_dlam, Lam)]
agree("(9), (18) ∂E/∂x", g_x - E_x, gradient_ufl[0])
agree("(10), (19) ∂E/∂s", V[:, None] * g_K - E_s, gradient_ufl[1])
agree("(20) ∂E/∂λ", -V[:, None] * c_K, gradient_ufl[2])

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
D_block = -VW
H_block = scipy.linalg.block_diag(*(V_3 * material.H(s_K)))

F_ufl = array(derivative(dE_ds, u, du), S, u)
G_ufl = array(derivative(dE_dlam, u, du), Lam, u)
D_ufl = array(derivative(dE_dlam, S, ds), Lam, S)
H_ufl = array(derivative(dE_ds, S, ds), S, S)
agree("(23), (32) F", F_block, F_ufl)
agree("(22), (33) G", G_block, G_ufl)
agree("(21), (34) D", D_block, D_ufl)
agree("(11) H", H_block, H_ufl)

# %% [markdown]
# One derivative the seed leaves open, (24): "i'll get around to it". F is linear in x, so it is
# Σ J_Kᵀ (∂²φ/∂F²) J_K V_K with φ(F) = B : R(F), where B = Λ S does not change with F. A : B stands
# for Σ_ij A_ij B_ij, S_F for the stretch RᵀF of F, and the matrices E_a, three in 3D, span the
# skew ones: where E_a : A = 0 for each a, A is symmetric.
#
# Rᵀ δR is skew, hence ω_a E_a with some ω. The variation of F = R S_F is A = ω_a E_a S_F + δS_F
# with A = Rᵀ δF. Taken against E_a, to which the symmetric δS_F is nothing,
#
#     T ω = α,    T_ab = E_a : (E_b S_F),    α_a = E_a : A = (R E_a) : δF.
#
# So Ω = ∂ω/∂F is T⁻¹ (R E_a), as a matrix with nine columns.

# %%
spins = hand.skew_basis(3)
S_F = np.swapaxes(R_K, 1, 2) @ F_K
T_K = np.einsum("aij,bik,nkj->nab", spins, spins, S_F)
RE = np.einsum("nik,akj->naij", R_K, spins).reshape(n, 3, 9)
Omega = np.linalg.solve(T_K, RE)
agree("(15) once more", np.swapaxes(RE, 1, 2) @ Omega, dR_9)

# %% [markdown]
# The gradient: with M = Rᵀ B and m_a = E_a : M, δφ = B : (R ω_a E_a) = m · ω. Put ω = T⁻¹ α, T
# being symmetric, and it is q · α with T q = m. So ∂φ/∂F = R Q with the skew matrix Q = q_a E_a.
# By the definition of T, E_a : (Q S_F) is (T q)_a = m_a = E_a : M for every a: Q S_F - M is
# symmetric, equal to its transpose -S_F Q - Mᵀ, that is
#
#     Q S_F + S_F Q = M - Mᵀ.

# %%
B_K = Lam_K @ S_K
M_K = np.swapaxes(R_K, 1, 2) @ B_K
q = np.linalg.solve(T_K, np.einsum("aij,nij->na", spins, M_K)[..., None])[..., 0]
Q = np.einsum("na,aij->nij", q, spins)
assert np.allclose(Q @ S_F + S_F @ Q, M_K - np.swapaxes(M_K, 1, 2))
agree("(18) once more", np.einsum("n,nip,ni->p", V, J, (R_K @ Q - Lam_K).reshape(n, 9)), E_x)

# %% [markdown]
# Now δ₁φ = (R Q) : δ₁F varies in a second direction. With W = ω_a E_a, δ₂R = R W₂ and δ₂M = -W₂ M:
#
#     δ²φ = A₁ : (W₂ Q) + α₁ · δ₂q,    (T δ₂q)_a = -E_a : (W₂ M) - E_a : (Q δ₂S_F).
#
# Put A₁ = W₁ S_F + δ₁S_F and α₁ = T ω₁ into it, and note δS_F : (E_a Q) = -E_a : (Q δS_F):
#
#     δ²φ = ω₁ᵀ N ω₂ - ω₁ · ℓ(δ₂S_F) - ω₂ · ℓ(δ₁S_F),
#     N_ab = (E_a S_F) : (E_b Q) - E_a : (E_b M),    ℓ_a(δS_F) = E_a : (Q δS_F).
#
# In ℓ one may put A for δS_F = A - W S_F: what this adds, ω₁ · ℓ(W₂ S_F) + ω₂ · ℓ(W₁ S_F), is zero,
# E_a : (Q E_b S_F) being skew in a and b.

# %%
N = np.einsum("aij,njk,bil,nlk->nab", spins, S_F, spins, Q)
N -= np.einsum("aij,bik,nkj->nab", spins, spins, M_K)
ell = np.einsum("aiq,nik,npk->napq", spins, Q, R_K).reshape(n, 3, 9)
across = np.einsum("nap,naq->npq", Omega, ell)
second = np.einsum("nap,nab,nbq->npq", Omega, N, Omega) - across - np.swapaxes(across, 1, 2)
E_xx = np.einsum("n,nip,nij,njq->pq", V, J, second, J)
agree("(24) ∂²E/∂x²", M / h**2 - E_xx, array(derivative(dE_dx, u, du), u, u))

# %% [markdown]
# ## The Newton system
#
# With λ for the new multiplier λ^t + δλ a step solves
#
#     | M/h²  Fᵀ  Gᵀ | | δx |   | -g_x |
#     | F     H   Dᵀ | | δs | = | -g_s |        (35)
#     | G     D   0  | | λ  |   |  c   |
#
# The signs are right; H, g_s and c carry volumes as F, G and D do. The matrix is UFL's Hessian of
# (1) but for (24), which the seed drops, and the right-hand side is that of Newton's method once
# the old multiplier has been moved across.

# %%
zero = np.zeros((9 * n, 9 * n))
columns = (M / h**2, F_block, G_block), (F_block.T, H_block, D_block), (G_block.T, D_block.T, zero)
matrix = np.hstack([np.vstack(column) for column in columns])
rhs = np.concatenate([-g_x, -(V[:, None] * g_K).ravel(), (V[:, None] * c_K).ravel()])

M_ufl = array(derivative(derivative(kinetic, u, v), u, du), u, u)
matrix_ufl = np.block([[M_ufl, F_ufl.T, G_ufl.T], [F_ufl, H_ufl, D_ufl.T], [G_ufl, D_ufl, zero]])
old = np.concatenate([np.zeros(X.size + 6 * n), lam_K.ravel()])
agree("(35) matrix", matrix, matrix_ufl)
agree("(35) right-hand side", rhs, matrix_ufl @ old - np.concatenate(gradient_ufl))

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
# Count the rank. Rᵀ c = S - RᵀF is symmetric whatever x is, so that n · c = 0 with n = R times any
# skew matrix. Derived by s that is Dᵀ n = 0, derived by x it is n · ∂c = -∂n · c: where c = 0, at
# every feasible state, n is in the null space of (35) and of (41), three vectors a cell. At others
# the 3 n_e of them push n vertices, but not the four ways that turn no cell, translations and a
# dilation. On any real mesh they are too many for the 3 n - 4 that remain; here, with twelve cells
# and twelve vertices, four null vectors are left. `hand` has all of the above as a class, which we
# use from here on.

# %%
options = {"rho": rho, "h": h, "v": velocity, "f_ext": f_ext}
for kind, expected in (("infeasible", 3 * n - 3 * len(X) + 4), ("feasible", 3 * n)):
    there = make_state(rest_state(body), kind, "seed", stress=0.4 * E)
    printed = hand.SeedSystem(there, material, **options, second_derivatives=False)
    for number, equations in ((35, printed.kkt()), (41, printed.reduced())):
        values = np.linalg.svd(equations[0].toarray(), compute_uv=False)
        nullity = np.count_nonzero(values < 1e-13 * values[0])
        if comm.rank == 0:
            print(f"({number}), {kind}: {len(values)} unknowns, {nullity} null vectors")
        assert nullity == expected

# %% [markdown]
# A direct solver may divide by round-off there and return garbage in the skew part of RᵀΛ. There
# are two exact cures. Either Λ = R Y with Y symmetric, which has six components for six
# constraints. Or the energy gets another term, -(ε/2) |skew(RᵀΛ)|², which holds the useless part
# at zero and changes neither x nor S nor sym(RᵀΛ). Its second derivatives go to three blocks of
# (35), not only to the zero one, which alone would do but makes for more iterations. For this
# material `forms.seed` takes ε = 1/μ.

# %%
cured = hand.SeedSystem(there, material, **options, eps=1.0 / mu)
assert np.linalg.cond(cured.kkt()[0].toarray()) < 1e6

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

system = hand.SeedSystem(at_rest, material, **options, eps=1.0 / mu)
residuals = [np.linalg.norm(system.gradient())]
for _ in range(result.iterations):
    step = hand.solve_reduced(system)
    system = system.moved(step.dx, step.ds, step.lam - system.lam)
    residuals.append(np.linalg.norm(system.gradient()))
assert residuals[-1] < 1e-9 * residuals[0]

if comm.rank == 0:
    print("residual of each iteration:", ", ".join(f"{r:.1e}" for r in residuals))
agree("step: x", system.state.x.ravel(), X.ravel() + assembler.values(u), tolerance=1e-9)
agree("step: s", system.s.ravel(), assembler.values(S), tolerance=1e-9)
agree("step: λ", system.lam, assembler.values(Lam), tolerance=1e-9)

# %% [markdown]
# ## Errata
#
# `mixed-fem compare` repeats this for every equation, material, formulation and kind of state, on
# triangles too; with `--equation 24` it shows one, as in the seed and as it should be, and why.
# What needs a correction:

# %%
wrong = [f"({e.number}) {e.states}" for e in hand.ERRATA if e.verdict == "corrected"]
if comm.rank == 0:
    print(*wrong, sep="\n")
