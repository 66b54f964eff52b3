# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A formulation of one's own
#
# The formulations that come with the package are functions of a few lines in
# `forms/formulations.py`. This page writes one that is not there, runs it with every solver, and
# studies how Newton's method fares with it. Nothing but the energy is written; residuals, Newton
# matrices, elimination of what is local to a cell and scaling follow from it.
#
# The idea: rubber is nearly incompressible, and as Poisson's ratio ν goes to 1/2 the Lamé parameter
# λ goes to infinity. In stable neo-Hookean
#
#     Ψ(S) = μ/2 (|S|² - d) - μ (J - 1) + λ/2 (J - 1)²,    J = det S,
#
# the last term is what stiffens. Its Legendre transform has 1/λ in it, which goes to nothing:
#
#     λ/2 (J - 1)² = max over p of p (J - 1) - p²/(2λ).
#
# The pressure p becomes a fourth unknown, constant on each cell. Pressures have been paired with
# det F since Herrmann (1965); here there is an S to take the determinant of.

# %%
from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl import det, dx, inner, sym

from forms import (
    BackwardEuler,
    StableNeoHookean,
    deformation_gradient,
    displacement,
    displacement_field,
    frozen,
    mixed_fields,
    polar_rotation,
    right_stretch,
    symmetric,
)
from meshes import Where, box
from solvers import SOLVERS, MixedProblem, march

comm = MPI.COMM_WORLD
E, rho, g, h = 1e6, 1000.0, 9.81, 0.1  # [Pa], [kg/m³], [m/s²], [s]
body = box(comm, size=(4.0, 1.0), cells=(16, 4))  # [m]


def say(*words):
    """Print once, on any number of ranks."""
    if comm.rank == 0:
        print(*words)


# %% [markdown]
# ## Ten lines
#
# These are all there is to it. μ and 1/λ are constants of the form, so that another ν compiles
# nothing. `stretch` is S(F), which we shall want to tamper with later.


# %%
def pressure(nu, solver="condensed", stretch=right_stretch):
    """A bar clamped at x = 0 that begins to fall; the problem and its time scheme."""
    mu = fem.Constant(body.mesh, E / (2 * (1 + nu)))
    compliance = fem.Constant(body.mesh, (1 + nu) * (1 - 2 * nu) / (E * nu))  # 1/λ

    u, S, Y = mixed_fields(body.mesh)
    p = fem.Function(fem.functionspace(body.mesh, ("DG", 0)), name="p")
    J = det(S)
    psi = mu / 2 * (inner(S, S) - 2) - mu * (J - 1) + p * (J - 1) - compliance / 2 * p**2
    euler = BackwardEuler(u, h, acceleration=(0.0, -g))
    energy = (psi - inner(Y, S - stretch(deformation_gradient(u))) + euler.kinetic(rho)) * dx
    return MixedProblem(energy, (u, S, Y, p), [clamp(u)], solver=solver), euler


def clamp(u):
    """U = 0 at x = 0."""
    V = u.function_space
    return fem.dirichletbc(np.zeros(2), body.dofs(V, Where(extents=(("x", "min"),))), V)


# %% [markdown]
# ## All solvers
#
# p is local to cells as S and Y are, so that the condensed solver eliminates it too. Whether the
# whole system is factorised or a displacement-sized one, the positions must be the same after some
# steps; and since the transform is exact, they must be those of the classical displacement method
# with the strain energy that we began with.

# %%
nu, steps = 0.45, 3


def by_package(density, fields, nu):
    """The same bar in a formulation of the package."""
    euler = BackwardEuler(fields[0], h, acceleration=(0.0, -g))
    psi = StableNeoHookean(E, nu)
    energy = (density(*fields, psi) + euler.kinetic(rho)) * dx
    return MixedProblem(energy, fields, [clamp(fields[0])]), euler


def moved(problem, euler):
    """Positions after some steps, and the Newton iterations of each."""
    iterations = [result.iterations for result in march(problem, euler, steps)]
    return problem.fields[0].x.array.copy(), iterations


def largest(values):
    """The largest absolute value over all ranks."""
    return comm.allreduce(np.abs(values).max(initial=0.0), op=MPI.MAX)


reference, iterations = moved(*by_package(displacement, (displacement_field(body.mesh),), nu))
say(f"displacement method: {iterations} Newton iterations")
assert largest(reference) > 0.5  # [m], a large motion
for solver in SOLVERS:
    u, iterations = moved(*pressure(nu, solver))
    say(f"with p, {solver}: {iterations}, differs by {largest(u - reference):.0e} m")
    assert largest(u - reference) < 1e-9
    assert max(iterations) <= 5

# %% [markdown]
# ## What it is good for
#
# Now let the material become incompressible. All three have the same solutions: like any method
# with linear displacements on triangles they lock, and the bar hangs less than it should. No choice
# of cell-local unknowns changes that. But the pressure takes the fewest Newton iterations, and no
# more of them as the material becomes stiff against changes of volume. Only ν = 1/2 itself asks too
# much: with 1/λ = 0 the pressure holds positions, and is no longer local to a cell.

# %%
needed = {}
for nu in (0.3, 0.45, 0.49, 0.499, 0.4999):
    bars = {
        "displacement": by_package(displacement, (displacement_field(body.mesh),), nu),
        "symmetric": by_package(symmetric, mixed_fields(body.mesh), nu),
        "with p": pressure(nu),
    }
    needed[nu] = {name: moved(*bar)[1] for name, bar in bars.items()}
    say(f"nu = {nu}:", ", ".join(f"{name} {n}" for name, n in needed[nu].items()))

needed[0.499999] = {"with p": moved(*pressure(0.499999))[1]}
say(f"nu = 0.499999: with p {needed[0.499999]['with p']}")

assert max(needed[0.499999]["with p"]) <= max(needed[0.3]["with p"])
assert max(needed[0.4999]["symmetric"]) > max(needed[0.4999]["with p"])
assert max(needed[0.4999]["displacement"]) > max(needed[0.4999]["with p"])

# %% [markdown]
# ## The rate of Newton's method
#
# UFL differentiates all that we wrote, R included, so that convergence must be quadratic: the
# logarithms of successive residuals double. From far away, a bar whose points were shaken by a
# quarter of a cell, we look at the last three residuals above rounding error.

# %%
nu = 0.45


def residuals(problem):
    """Residuals of a solve from a shaken bar."""
    u = problem.fields[0]
    X = u.function_space.tabulate_dof_coordinates()[:, :2]
    shaken = 0.06 * np.sin(7.0 * X + 11.0 * X[:, ::-1]) * X[:, :1].clip(max=1.0)  # [m]
    u.x.array[:] = shaken.ravel()
    return np.array(problem.solve().residuals)


quick = residuals(pressure(nu)[0])
say("residuals:", ", ".join(f"{value:.0e}" for value in quick))
r = quick[quick > 1e-11 * quick[0]][-3:]
order = np.log(r[2] / r[1]) / np.log(r[1] / r[0])
say(f"order {order:.2f}")
assert order > 1.7

# %% [markdown]
# Such rates are easily lost. Suppose that we do not care to differentiate the rotation: `frozen`
# makes a sub-expression a constant for the derivative, but not for the residual. It is one line.


# %%
def lagged_stretch(F):
    """S(F) = sym(RᵀF), the derivative of R forgotten."""
    return sym(frozen(polar_rotation(F)).T * F)


slow = residuals(pressure(nu, stretch=lagged_stretch)[0])
rates = slow[1:] / slow[:-1]
say("residuals:", ", ".join(f"{value:.0e}" for value in slow))
say("ratios of the last:", ", ".join(f"{rate:.2f}" for rate in rates[-2:]))

# %% [markdown]
# Each iteration now gains about the same factor, where before each gained the square of what the
# one before had. The factor is small as long as the stresses are: what is forgotten is a multiple
# of Y. The solution does not change, for the rotation in the residual is never an old one.

# %%
assert rates[-2:].max() < 3.0 * rates[-2:].min()
assert r[2] / r[1] < 0.1 * r[1] / r[0]
assert len(slow) > len(quick)

exact, lagged = (pressure(nu, stretch=stretch) for stretch in (right_stretch, lagged_stretch))
assert largest(moved(*exact)[0] - moved(*lagged)[0]) < 1e-8
