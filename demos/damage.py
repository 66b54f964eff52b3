# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A material that takes damage
#
# Filled rubber that has been stretched is softer the next time, up to the stretch that it has seen
# (Mullins). In the model of Simo (1987) the stress is (1 - D(α)) Ψ₀'(S), where α is the largest
# √(2Ψ₀) up to now and D = D∞ (1 - exp(-α/β)).
#
# Is there an energy of a step? α grows with Ψ₀ as long as that is above its former largest value,
# so the stress is the derivative of the integral of 1 - D over Ψ₀: with a = √(2Ψ₀), dΨ₀ = a da,
#
#     W = (1 - D(α)) Ψ₀                                  below,
#     W = (1 - D(α)) α²/2 + ∫ from α to a of (1 - D) a da  above.
#
# α is a history variable, a number at each point. UFL does the rest, and since damage that grows is
# differentiated with it, Newton's method stays quadratic.
#
# J. C. Simo, On a fully three-dimensional finite-strain viscoelastic damage model, Computer Methods
# in Applied Mechanics and Engineering 60 (1987) 153-173.

# %%
from mpi4py import MPI

import numpy as np
from ufl import conditional, exp, gt, max_value, sqrt

from forms import (
    Account,
    AsRigidAsPossible,
    Fixed,
    History,
    Model,
    Static,
    Stretch,
    point_field,
)
from meshes import Where, box
from solvers import MixedProblem, march

comm = MPI.COMM_WORLD
body = box(comm, size=(1.0, 1.0, 1.0), cells=(2, 2, 2))  # [m]
psi_0 = AsRigidAsPossible(E=1e5, nu=0.0)  # μ |S - I|²
D_most, beta = 0.6, 100.0  # [-], [√Pa]
left, right = (Where(extents=(("x", end),)) for end in ("min", "max"))


def say(*words):
    """Print once, on any number of ranks."""
    if comm.rank == 0:
        print(*words)


# %%
alpha = point_field(body.mesh, 0.0, name="alpha")


def softness(a):
    """∫ (1 - D) a da."""
    return (1 - D_most) * a**2 / 2 - D_most * beta * (a + beta) * exp(-a / beta)


def damaged(S):
    """W(S), see above."""
    energy = psi_0(S)
    known = max_value(alpha**2, 1e-12)  # a square root has no derivative at 0
    a = sqrt(max_value(2 * energy, known))
    below = (1 - D_most * (1 - exp(-alpha / beta))) * energy
    at_alpha = (1 - D_most * (1 - exp(-alpha / beta))) * alpha**2 / 2
    above = at_alpha + softness(a) - softness(alpha)
    return conditional(gt(2 * energy, known), above, below)


def largest_yet(model, scheme):
    """The new α."""
    return max_value(alpha, sqrt(2 * psi_0(model.stretch(scheme))))


# %% [markdown]
# ## To and fro
#
# A cube is stretched by 20 %, let go, and stretched by 40 %, twice. `Account` gives the force that
# the right side takes. The history is a number, so that all we have to check is one curve: along
# the axis the stress of Ψ₀ is 2μ (s - 1), and 1 - D is known from the largest stretch up to then.

# %%
times = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
strains = [0.0, 0.2, 0.0, 0.4, 0.0, 0.4]
model = Model(
    body,
    "symmetric",
    damaged,
    motions=[
        Fixed(left, components="x"),
        Stretch(right, components="x", table=list(zip(times, strains, strict=True))),
        Fixed(Where(extents=(("y", "min"),)), components="y"),
        Fixed(Where(extents=(("z", "min"),)), components="z"),
    ],
    histories=[History(alpha, largest_yet)],
)
scheme = Static(model.u, h=0.1)
problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
account = Account(model, scheme, problem.unbalanced_forces)

forces, needed = [], []
for result in march(problem, scheme, 50, account):
    forces.append(account.reactions[1, 0])
    needed.append(result.iterations)

strain = np.interp(0.1 * np.arange(1, 51), times, strains)
largest = np.sqrt(2 * psi_0.mu) * np.maximum.accumulate(strain)
exact = (1 - D_most * (1 - np.exp(-largest / beta))) * 2 * psi_0.mu * strain
error = np.abs(np.array(forces) - exact).max()
say(f"forces within {error:.0e} N of up to {exact.max():.0f} N; at most {max(needed)} iterations")
assert error < 1e-6 * exact.max()
assert max(needed) <= 8

# %% [markdown]
# The work that did not come back is the area between the curves; the cube is unstretched at t = 4.
# Of damage that grows from α to a it takes Ψ₀ dD: by parts the integral of 1 - D over Ψ₀, less
# (1 - D) Ψ₀ at its end. The account has the work, by sums over steps, hence to their size.

# %%
first, second, third = (np.array(forces)[k : k + 10] for k in (0, 20, 40))
assert first[4] < 0.9 * 2 * psi_0.mu * strain[4]  # virgin, it softens on its way
assert abs(second[4] - forces[9]) < 1e-6 * forces[9]  # what it has seen it follows back
assert third[4] < 0.8 * second[6]  # after 40 % it is softer

a = largest[29]
lost = float(softness(a)) - float(softness(0.0))  # ∫ (1 - D) dΨ₀ up to 40 %
lost -= (1 - D_most * (1 - np.exp(-a / beta))) * a**2 / 2  # and back, at the last D
loaded = np.concatenate([[0.0], forces[:40]])
moved = np.diff(np.concatenate([[0.0], strain[:40]]))
by_sides = float(np.sum((loaded[1:] + loaded[:-1]) / 2 * moved))
say(f"work lost: {by_sides:.0f} J, by the formula {lost:.0f} J")
assert abs(by_sides - lost) < 0.02 * lost
