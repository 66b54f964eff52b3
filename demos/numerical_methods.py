# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # The various numerical methods
#
# The seed ends in a section of this name, which its authors left as "todo". It is about the many
# ways to solve (35), and about what else one could solve in its place. We go through them on plane
# bars of a few hundred triangles, say what each costs, and find for each the place where it fails.
# Numbers in brackets are the seed's.

# %%
from mpi4py import MPI

import numpy as np

from demos.studies.bar import bar
from solvers import STRATEGIES

comm = MPI.COMM_WORLD


def march(formulation="symmetric", globalisation=None, count=3, most=100, **case):
    """Take steps of at most so many Newton iterations with a bar of 4 m by 1 m."""
    options = {"snes_max_it": most}
    run = bar(comm, formulation, dimension=2, globalisation=globalisation, options=options, **case)
    for _ in range(count):
        run.step()
    title(
        "  {:<34} {} {}".format(
            ", ".join(filter(None, (formulation, globalisation, case.get("solver")))),
            iterations(run),
            run.failure.split(" ")[0],
        )
    )
    return run


def iterations(run):
    """Newton iterations of each step."""
    return [result.iterations for result in run.results]


def apart(a, b):
    """Largest difference of a displacement [m]."""
    difference = np.abs(a.model.u.x.array - b.model.u.x.array).max(initial=0.0)
    return comm.allreduce(difference, op=MPI.MAX)


def title(text):
    """Print on one rank."""
    if comm.rank == 0:
        print(text)


# %% [markdown]
# ## One Newton method, three linear solvers
#
# A Newton step solves (35) for δu, δS and δΛ together. One may factorise it as it is, by LU with
# pivoting, as it is indefinite. Or eliminate δS, which leaves (41), then δΛ: exactly, or as a
# preconditioner (`demos/block_preconditioners.py` has the particulars). Or eliminate both in each
# cell before anything is assembled, which is static condensation, the default. The three make the
# same steps and differ in cost alone: LU sees all unknowns, condensation those of the displacement.

# %%
title("clamped bar, E = 1 MPa, h = 0.1 s")
EASY = {"n": 4, "E": 1e6, "h": 0.1}
condensed, direct, fieldsplit = (
    march(solver=name, **EASY) for name in ("condensed", "direct", "fieldsplit")
)
for other in (direct, fieldsplit):
    assert np.abs(np.subtract(iterations(other), iterations(condensed))).max() <= 1
    assert apart(other, condensed) < 1e-9
unknowns = [run.problem.system.x.getSize() for run in (condensed, direct)]
matrix = condensed.problem.condensed.K.size[0]
title(f"  {unknowns[1]} unknowns, of which the condensed matrix has {matrix}")
assert matrix == condensed.model.u.function_space.dofmap.index_map.size_global * 2

# %% [markdown]
# ## Leaving out a derivative
#
# In (24) the second derivative of R makes the matrix exact. The published method drops it, which is
# a Gauss-Newton method; a lagged rotation drops the first one too. Each iteration then divides the
# error by a factor where Newton's squares it, and the factor is the worse the more the body turns
# in a step.

# %%


def contractions(run):
    """By what each of the last iterations of a step multiplies the residual."""
    r = np.array(run.results[-1].residuals)
    return r[1:][-3:] / r[:-1][-3:]


gauss_newton, lagged = march("gauss-newton", **EASY), march("lagged-rotation", **EASY)
assert contractions(condensed).min() < 1e-4
for linear in (gauss_newton, lagged):
    assert apart(linear, condensed) < 1e-6
    assert 0.02 < contractions(linear).min() < contractions(linear).max() < 0.5
    assert max(iterations(linear)) > max(iterations(condensed)) + 3

# %% [markdown]
# ## No S at all
#
# A displacement method minimises the inertia and Ψ(S(F)) over the displacement alone. On easy steps
# its Newton method with full steps is as good as the mixed one.

# %%
plain = march("displacement", "full-steps", **EASY)
assert apart(plain, condensed) < 1e-9
assert max(iterations(plain)) <= max(iterations(condensed)) + 1

# %% [markdown]
# Where it differs is a stiff body that turns. A Newton step moves points along straight lines, so
# that a turn by an angle stretches the body, and stiffness multiplies that into forces far beyond
# those in the solution. The mixed method has S as an unknown of its own: a step may turn F and
# leave S as it is, as only the linearised constraint ties them. A line search on the energy sees
# those forces and cuts good steps to pieces, whichever tangent it goes with.

# %%
title("bar spinning at 1 rad/s, E = 100 MPa, h = 1 s")
STIFF = {"n": 3, "E": 1e8, "h": 1.0, "support": "rotating"}
mixed, plain, on_demand, projected = (
    march(*method, **STIFF)
    for method in (
        (),
        ("displacement", "full-steps"),
        ("displacement", "project-on-demand"),
        ("displacement", "projected-newton"),
    )
)
assert not mixed.failure and max(iterations(mixed)) <= 6
assert max(iterations(plain)) > 2 * max(iterations(mixed))
assert max(iterations(on_demand)) > 10 * max(iterations(mixed))
assert max(iterations(projected)) > 10 * max(iterations(mixed))

# %% [markdown]
# The same happens where stiff and soft materials meet: the stiff part turns with what the soft part
# does.

# %%
title("clamped bar, 0.1 MPa and 1 GPa in turns, h = 0.5 s")
CONTRAST = {"n": 3, "E": 1e5, "h": 0.5, "contrast": 1e4}
mixed, plain, on_demand = (
    march(*method, **CONTRAST)
    for method in ((), ("displacement", "full-steps"), ("displacement", "project-on-demand"))
)
assert not mixed.failure and max(iterations(mixed)) <= 8
assert plain.failure
assert min(iterations(on_demand)) > 5 * max(iterations(mixed))

# %% [markdown]
# ## Globalisations
#
# Far from a solution the tangent need not be positive definite, and a full step need not lead
# nearer. What is then done has many names. The energy of positions decides where there is one.
#
# - *projected Newton* replaces the tangent of each cell by a positive semi-definite one, clamping
#   negative eigenvalues; *absolute* takes their magnitudes. No step then goes up, but the tangent
#   is too stiff where it was right, and convergence becomes linear.
# - *trust-region filtering* chooses between these two by how well the last step was foretold.
# - *project-on-demand* keeps the exact tangent and projects after negative curvature only;
#   *kinetic Newton* adds inertia instead; *progressively projected Newton* projects the cells with
#   the largest forces, as many as needed.
# - the *watchdog* is ours, for the mixed method too: full steps as long as they get anywhere, a
#   search on the residual, then part by part, and then down the energy.
# - *continuation* lets in what is out of balance at the start of a step part by part.
#
# A very soft body in a long step is where they are needed. Here plain full steps fail, and the
# displacement's projections on demand are at least as good as the mixed method.

# %%
title("clamped bar, E = 1 kPa, h = 1 s, which hangs straight down after a step")
SOFT = {"n": 3, "E": 1e3, "h": 1.0}
mixed = march(**SOFT)
assert not mixed.failure
assert march(globalisation="full-steps", **SOFT).failure
assert march("displacement", "full-steps", **SOFT).failure
for name in STRATEGIES:
    if name in ("watchdog", "full-steps", "residual-search", "local-global"):
        continue
    run = march("displacement", name, **SOFT)
    assert not run.failure and apart(run, mixed) < 1e-4
    if name == "project-on-demand":
        assert max(iterations(run)) <= max(iterations(mixed))
    if name in ("projected-newton", "absolute-newton", "filtered-newton"):
        assert max(iterations(run)) > 15

# %% [markdown]
# ## A constant matrix
#
# Projective dynamics and ADMM for elastic bodies split differently: S and R by cell, then positions
# by a matrix that never changes and is factorised once. An iteration costs little, and its error
# falls by a factor close to 1: the stiffer the body in terms of h, the closer.

# %%
title("clamped bar, h = 0.1 s, a constant matrix")
counts = []
for E in (3e3, 1e4, 3e4):
    run = march("displacement", "local-global", n=2, E=E, h=0.1, count=1, most=2000)
    counts += iterations(run)
assert counts == sorted(counts) and counts[0] > 10 * max(iterations(condensed))

# %% [markdown]
# ## What to take
#
# The default. `mixed-fem study duel` measures all of them on bars of 12 288 tetrahedra over
# stiffness, step and contrast, in seconds as well as in iterations, and says where the mixed method
# loses.
