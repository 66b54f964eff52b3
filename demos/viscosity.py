# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A viscous material
#
# A history variable is a field that the energy reads and that changes when a step is accepted. The
# simplest is the stretch of the step before. With it a step makes the energy
#
#     Ψ(S) + η/(2h) |S - S_old|²
#
# stationary, so that the stress is that of a spring and a dashpot side by side (Kelvin and Voigt),
# P = Ψ'(S) + η Ṡ by backward differences. Rigid motions are not damped, as S does not feel them.

# %%
from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl import inner

from forms import AsRigidAsPossible, Fixed, History, Model, Static, Traction, point_field
from meshes import Where, box
from solvers import MixedProblem, march

comm = MPI.COMM_WORLD
body = box(comm, size=(2.0, 1.0), cells=(4, 2))  # [m]
psi = AsRigidAsPossible(E=1e5, nu=0.0)
eta, t = 2e5, 3e4  # [Pa s], [Pa]
left, right, low = (Where(extents=(end,)) for end in (("x", "min"), ("x", "max"), ("y", "min")))


def say(*words):
    """Print once, on any number of ranks."""
    if comm.rank == 0:
        print(*words)


# %% [markdown]
# ## Creep
#
# A block on rollers is pulled at its right side by a constant force, too slowly for inertia to
# matter. `Model` takes the energy as a function of S, and the field with its update.


# %%
def creep(end, steps):
    """The stretch of the block after each step."""
    h = fem.Constant(body.mesh, end / steps)
    S_old = point_field(body.mesh, np.eye(2), symmetric=True, name="S_old")

    def viscous(S):
        return psi(S) + eta / (2 * h) * inner(S - S_old, S - S_old)

    model = Model(
        body,
        "symmetric",
        viscous,
        loads=[Traction((t, 0.0), right)],
        motions=[Fixed(left, components="x"), Fixed(low, components="y")],
        histories=[History(S_old, Model.stretch)],
    )
    scheme = Static(model.u, h)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
    stretches = []
    for _ in march(problem, scheme, steps, model):
        longest = comm.allreduce(model.u.x.array.max(initial=-np.inf), op=MPI.MAX)
        stretches.append(1.0 + longest / 2.0)
    return np.array(stretches)


# %% [markdown]
# ## The check
#
# With Ψ = μ |S - I|² the equation of the block is 2μ (s - 1) + η ṡ = t. It creeps towards
# s = 1 + t/(2μ) like an exponential, and backward differences give a geometric sequence, to
# rounding. By refining h the first is reached with order one.

# %%
end = 2.0  # [s]
errors = []
for steps in (10, 20, 40):
    found = creep(end, steps)
    n = np.arange(1, steps + 1)
    ratio = 1.0 / (1.0 + 2 * psi.mu * (end / steps) / eta)
    assert np.abs(found - (1.0 + t / (2 * psi.mu) * (1.0 - ratio**n))).max() < 1e-9
    exact = 1.0 + t / (2 * psi.mu) * (1.0 - np.exp(-2 * psi.mu * end / eta))
    errors.append(abs(found[-1] - exact))
    say(f"{steps:>3} steps: stretch {found[-1]:.5f}, exact {exact:.5f}")

orders = np.log2(np.array(errors[:-1]) / errors[1:])
say("orders:", ", ".join(f"{order:.2f}" for order in orders))
assert np.abs(orders - 1.0).max() < 0.1
