# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Elimination by options
#
# A Newton step of the mixed method solves a system in three fields, the seed's (35),
#
#     | M/h²  Fᵀ  Gᵀ | | δx |
#     | F     H   Dᵀ | | δs |
#     | G     D   0  | | δλ |
#
# of which s and λ live on single tetrahedra. On paper one eliminates δs, which leaves (41), then
# δλ, which leaves a matrix of the displacement alone. PETSc's field splits do the same, and this
# demo shows which option performs which step. Each matrix on the way is held against the Schur
# complement that NumPy computes from the assembled system. Numbers in brackets are the seed's.

# %%
from mpi4py import MPI

import numpy as np
from dolfinx import fem, mesh
from ufl import dx

from forms import BackwardEuler, StableNeoHookean, mixed_fields, seed
from solvers import PRECONDITIONERS, MixedProblem

# %% [markdown]
# The body is a bar of 36 tetrahedra, clamped at one end, that starts to fall. The energy is (1)
# with the seed's full Λ, and with the term that holds skew(RᵀΛ) at zero, without which (35) is
# singular. That term adds to the zero block, and the other blocks are exact second derivatives,
# (24) included. Nothing below knows the energy.

# %%
comm = MPI.COMM_WORLD
rho, h = 1000.0, 0.1  # [kg/m³], [s]
gravity = (0.0, -9.81, 0.0)  # [m/s²]
psi = StableNeoHookean(E=1e6, nu=0.45)  # [Pa], [-]


def falling_bar(cells, **options):
    """A clamped bar about to fall, 4 m by 1 m by 1 m, and its time scheme."""
    msh = mesh.create_box(comm, [(0.0, 0.0, 0.0), (4.0, 1.0, 1.0)], cells)
    u, S, Lam = mixed_fields(msh, multiplier="full")
    euler = BackwardEuler(u, h, gravity)
    V = u.function_space
    end = fem.locate_dofs_geometrical(V, lambda X: np.isclose(X[0], 0.0))
    clamped = fem.dirichletbc(np.zeros(3), end, V)
    energy = seed(u, S, Lam, psi) * dx + euler.kinetic(rho) * dx
    fields = (u, S, Lam)
    return MixedProblem(energy, fields, [clamped], solver="fieldsplit", **options), euler


def say(*text):
    """Print on one rank."""
    if comm.rank == 0:
        print(*text)


# %% [markdown]
# We take one time step, so that R, S and Λ are no longer those of the rest state, and then a single
# Newton step of the next one. What is in memory then is (35) at a point of no special kind. The
# fields have been scaled, each by a unit of its own, which changes nothing in the algebra.

# %%
problem, euler = falling_bar((6, 1, 1))
first = problem.solve()
euler.advance()
problem.newton_step()

# %% [markdown]
# The system is a nest of blocks. To compare, we need each matrix as an array of numbers, which is
# found column by column.


# %%
def array(matrix):
    """Any PETSc matrix as an array, on every rank."""
    x, y = matrix.createVecs()
    first, last = x.getOwnershipRange()
    columns = []
    for k in range(matrix.size[1]):
        x.array_w[:] = np.arange(first, last) == k
        matrix.mult(x, y)
        columns.append(np.concatenate(comm.allgather(y.array_r.copy())))
    return np.array(columns).T


def indices(index_set):
    """An index set, on every rank."""
    return np.concatenate(comm.allgather(index_set.getIndices().copy()))


def schur_complement(matrix, eliminated, kept):
    """What is left of a matrix on `kept`."""
    to, out = matrix[np.ix_(eliminated, kept)], matrix[np.ix_(kept, eliminated)]
    inner = np.linalg.solve(matrix[np.ix_(eliminated, eliminated)], to)
    return matrix[np.ix_(kept, kept)] - out @ inner


def agree(what, found, expected, tolerance=1e-10):
    """Print the relative difference, and insist that it is small."""
    difference = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    say(f"{what:<48} {difference:.1e}")
    assert difference < tolerance, what


system = array(problem.problem.A)
agree("(35) is symmetric", system, system.T)

# %% [markdown]
# ## From (35) to (41)
#
# The options that split S from the other two fields and eliminate it by a full block factorisation
# are the first of those that the solver put in, under the prefix of the problem:

# %%
blocks, options = problem.fieldsplit.blocks, problem.fieldsplit.options


def show(prefix):
    """The options under a prefix that say what is done, without those of deeper splits."""
    for key, value in options.items():
        name = key.removeprefix(prefix)
        if key.startswith(prefix) and name.startswith(("ksp_type", "pc_")):
            say(f"    -{key} {value}")


show("")
show("fieldsplit_S_")
assert options["pc_fieldsplit_schur_fact_type"] == "full"
assert options["fieldsplit_S_pc_type"] == "vpbjacobi"

# %% [markdown]
# "full" stands for
#
#     | 1         0 | | H  0  | | 1  H⁻¹ (F Dᵀ) |
#     | (..)ᵀ H⁻¹ 1 | | 0  S₁ | | 0  1          |
#
# and H⁻¹ is point-block Jacobi, one 6×6 inverse for each tetrahedron, hence exact. S₁ has to be
# preconditioned. "user" says by which matrix: the one the solver has assembled for it cell by cell,
# with M̃ (39), J̃ (40) and -D H⁻¹ Dᵀ as its blocks.

# %%
is_S, is_rest = map(indices, blocks.splits[0])
H = system[np.ix_(is_S, is_S)]
cell = np.arange(len(H)) // 6
assert np.all(H[cell[:, None] != cell] == 0.0)
reduced = array(blocks.systems[1])
agree("(41) against the Schur complement of (35)", reduced, schur_complement(system, is_S, is_rest))

# %% [markdown]
# That PETSc eliminates with these very blocks can be seen from its operator for the Schur
# complement, which it applies as J_rr - J_rS H⁻¹ J_Sr without assembling anything.

# %%
split = problem.problem.solver.getKSP().getPC()
solve_S, solve_41 = split.getFieldSplitSubKSP()
agree("(41) against PETSc's operator", reduced, array(solve_41.getOperators()[0]))

# %% [markdown]
# ## From (41) to the displacement
#
# The rest is split again, and Λ eliminated the same way. Its block is -D H⁻¹ Dᵀ, 9×9 on each
# tetrahedron, and it is here that the null space of the seed's multiplier would show as a
# singular block.

# %%
show("fieldsplit_u_Lam_")
show("fieldsplit_u_Lam_fieldsplit_Lam_")
is_Lam, is_u = map(indices, blocks.splits[1])
condensed = array(blocks.K)
agree(
    "condensed against the Schur complement of (41)",
    condensed,
    schur_complement(reduced, is_Lam, is_u),
)
everything_else = np.setdiff1d(np.arange(len(system)), indices(blocks.splits[0][1])[is_u])
agree(
    "condensed against that of (35), both at once",
    condensed,
    schur_complement(system, everything_else, indices(blocks.splits[0][1])[is_u]),
)

# %% [markdown]
# The condensed matrix has the size and sparsity of a displacement method's. It is the only one that
# anything has to be invented for: a factorisation by MUMPS on small meshes; on large ones
# algebraic multigrid, with the translations and rotations of a rigid body as near-nullspace.

# %%
show("fieldsplit_u_Lam_fieldsplit_u_")

# %% [markdown]
# With exact inverses throughout, the preconditioner is the inverse of (35), and Krylov's method has
# nothing left to do.

# %%
say("Krylov iterations of each Newton iteration:", first.krylov)
assert set(first.krylov) == {1}

# %% [markdown]
# ## Leaving parts out
#
# Half of the factorisation, "upper", makes the preconditioned matrix unit lower triangular: with
# three blocks GMRES ends after three iterations. The diagonal alone, with the absolute values of
# the local blocks, is what MINRES can use. And in place of the exact solve with the condensed
# matrix there may be a cycle of multigrid, or a few iterations. All of them have names, and all of
# them arrive at the same displacement.

# %%
bars = {name: falling_bar((8, 2, 2), preconditioner=name)[0] for name in PRECONDITIONERS}
for name, bar in bars.items():
    result = bar.solve()
    say(f"{name:<24} Newton {result.iterations}, Krylov {result.krylov}, on u {result.inner}")
    expected = bars["schur-full-mumps"].fields[0].x.array
    error = comm.allreduce(np.sum((bar.fields[0].x.array - expected) ** 2))
    assert error <= 1e-18 * comm.allreduce(np.sum(expected**2)), name

# %% [markdown]
# ## A plan for a cluster
#
# What is distributed? The mesh, by cells, with a layer of ghost cells as DOLFINx makes it. A rank
# owns S, Λ and every row of theirs on its cells, and the displacements of its vertices.
#
# What is communicated? H⁻¹, (D H⁻¹ Dᵀ)⁻¹ and their products never leave a rank: the couplings among
# S and Λ have no entry of another rank's cell. Products with F, G and J̃ read the displacements of
# ghost vertices, their transposes add to them. Assembling M̃ and K sends the entries of rows that a
# neighbour owns. All this is between neighbours, and of the size of the surface of a part. What
# involves all ranks are Krylov's inner products, the coarse levels of multigrid, and with MUMPS the
# factorisation, which is the reason not to use it there.

# %%
for f, g in ((1, 1), (1, 2), (2, 1)):
    block = problem.problem.A.getNestSubMatrix(f, g)
    first_column, last_column = block.getOwnershipRangeColumn()
    columns = block.getValuesCSR()[1]
    assert np.all((first_column <= columns) & (columns < last_column))

# %% [markdown]
# How much memory does a rank need? Every matrix has so many entries on a tetrahedron, at 12 bytes
# each, and K and its like a few more. Elimination holds dense blocks of a cell's 15 local unknowns
# and 12 displacements, and PETSc 8 bytes for each entry that it is to assemble again. FGMRES keeps
# two vectors an iteration. GAMG adds about half of K, little beside the rest.

# %%
bar = bars["schur-full-gmres"]
u, S, Lam = bar.fields
A, made = bar.problem.A, bar.fieldsplit.blocks
cells = u.function_space.mesh.topology.index_map(3).size_global


def entries(matrix):
    """Stored entries of a matrix or of a nest, for each tetrahedron."""
    if matrix.getType() == "nest":
        rows, columns = matrix.getNestSize()
        blocks = (matrix.getNestSubMatrix(i, j) for i in range(rows) for j in range(columns))
        return sum(entries(block) for block in blocks if block)
    return matrix.getInfo(matrix.InfoType.GLOBAL_SUM)["nz_used"] / cells


local = 2 * (6 + 9) * 12 + (6 + 9) ** 2
assert np.isclose(entries(A) - entries(A.getNestSubMatrix(0, 0)), local)
iterations = 5  # outer ones, with GMRES and GAMG inside
bytes_each = {
    "blocks of (35)": 12 * entries(A),
    "(41) and condensed": 12 * (entries(made.systems[1]) + entries(made.K)),
    "to assemble those": 8 * ((12 + 9) ** 2 + 12**2),
    "elimination": 8 * (2 * 15**2 + 2 * 15 * 12 + 2 * 12**2 + 6**2 + 9**2),
    "FGMRES": 8 * 2 * iterations * bar.problem.x.size / cells,
}
total = sum(bytes_each.values())
for what, number in bytes_each.items():
    say(f"{what:<24} {number / 1e3:6.1f} kB a tetrahedron")
say(f"{'together':<24} {total / 1e3:6.1f} kB a tetrahedron")

# %% [markdown]
# On this coarse mesh a tetrahedron has more vertices to itself than on a fine one, so that this is
# an upper bound. With 4 GB for each rank there is room for:

# %%
for ranks in (1, 16, 256, 4096):
    say(f"{ranks:5d} ranks: {ranks * 4e9 / total / 1e6:8.1f} million tetrahedra")

# %% [markdown]
# `mixed-fem study preconditioner` and `scaling` measure the peak. For the symmetric formulation
# with its six multipliers it is 26 to 28 kB a tetrahedron on one rank and 29 on two with 12 000
# each, the difference being ghosts; 4 to 5 kB with condensation by compiled kernels, which assemble
# no block but K. Interpreter and libraries come on top, 0.2 GB a rank.
#
# How much is sent? A rank with n tetrahedra has n/6 vertices and some 2 n^(2/3) of others as
# ghosts, 1700 for n = 25 000, each with 24 bytes:
#
# - an evaluation of the residual or the Jacobian: u of the ghosts once, and their rows of the
#   assembled vector, or of M̃ and K, back;
# - an iteration of FGMRES: the same for each product with the whole matrix and with a Schur
#   complement, and two reductions; GMRES on K inside it, two more an iteration;
# - a multigrid cycle: an exchange for each smoothing step on each level, and on the coarse levels,
#   where there are more ranks than work, little else than waiting.
#
# Which options would change on a cluster? This is a plan: two cores have not tested it. The names
# stay; under the prefix of the condensed matrix, followed by `ksp_` with "schur-full-gmres":
#
# - `pc_gamg_process_eq_limit 200`: levels with fewer equations a rank move to fewer ranks, as all
#   of their time is latency. PETSc's default is 50.
# - `pc_gamg_repartition true`: the levels that moved are partitioned anew.
# - `mg_coarse_pc_type telescope`, `mg_coarse_telescope_pc_type lu`: the coarsest level is
#   factorised on one rank, and the others wait.
# - MUMPS for K up to 30 000 displacement dofs only, as "schur-full" chooses: its factors grow with
#   n^(4/3) in 3D, and their share of a rank with them.
# - Fewer ranks on a node than cores, if memory does not keep up: a product with a matrix takes two
#   operations for each 12 bytes of it.
#
# Some 10 000 tetrahedra a rank are few: for two vertices of its own there is one ghost. On 1, 2, 3
# and 4 ranks the tests find the same iterations with exact blocks, and positions that agree to
# 1e-10.
