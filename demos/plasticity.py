# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Plasticity
#
# J2 plasticity with linear hardening, in the logarithmic strain log S (Miehe, Apel, Lambrecht,
# 2002): Hooke's law holds between the Kirchhoff stress and log S - Eᵖ, and the formulas of small
# strains hold for large ones. History variables are the plastic strain Eᵖ and its accumulated
# length α.
#
# The return map has an energy. With the trial stress s = 2μ dev(log S - Eᵖ), its length q = |s| and
# the overstress f = q - √⅔ (σ_Y + H α),
#
#     W = Ψ(log S - Eᵖ) - f²/(2 (2μ + ⅔ H))  where f > 0, else Ψ(log S - Eᵖ).
#
# Its derivative is the stress after the return, its second derivative the consistent tangent, which
# nobody has to derive by hand.
#
# C. Miehe, N. Apel, M. Lambrecht, Anisotropic additive plasticity in the logarithmic strain space,
# Computer Methods in Applied Mechanics and Engineering 191 (2002) 5383-5425.

# %%
from mpi4py import MPI

import numpy as np
from ufl import as_vector, conditional, dev, gt, inner, max_value, sqrt, tr

from forms import Account, Fixed, History, Model, Static, Stretch, lame_parameters, point_field
from forms.spectral import log
from meshes import Where, box
from solvers import MixedProblem, march

comm = MPI.COMM_WORLD
body = box(comm, size=(1.0, 1.0, 1.0), cells=(2, 2, 2))  # [m]
E, nu, sigma_Y, H = 1e9, 0.3, 5e6, 1e8  # [Pa], [-], [Pa], [Pa]
mu, lam = lame_parameters(E, nu)
left, right = (Where(extents=(("x", end),)) for end in ("min", "max"))


def say(*words):
    """Print once, on any number of ranks."""
    if comm.rank == 0:
        print(*words)


# %%
E_p = point_field(body.mesh, np.zeros((3, 3)), symmetric=True, name="E_p")
alpha = point_field(body.mesh, 0.0, name="alpha")


def overstress(S):
    """Elastic trial strain, trial stress s, its length q, and f."""
    strain = log(S) - E_p
    s = 2 * mu * dev(strain)
    q = sqrt(max_value(inner(s, s), 1e-12 * sigma_Y**2))  # no derivative at 0
    return strain, s, q, q - np.sqrt(2 / 3) * (sigma_Y + H * alpha)


def plastic(S):
    """W(S), see above."""
    strain, _, _, f = overstress(S)
    elastic = mu * inner(strain, strain) + lam / 2 * tr(strain) ** 2
    return elastic - conditional(gt(f, 0.0), f**2 / (2 * (2 * mu + 2 * H / 3)), 0.0)


# %% [markdown]
# ## The return map as an update
#
# When a step is accepted, Eᵖ moves along s by f/(2μ + ⅔ H). UFL can say that; we use the other way,
# a function of arrays, as one needs where the flow has to be found by iteration. It takes the
# values of an expression at the points: here S, Eᵖ and α side by side.


# %%
def now(model, scheme):
    """What the return map needs: log S - Eᵖ, and Eᵖ and α before the step."""
    strain = overstress(model.stretch(scheme))[0]
    return as_vector([*_entries(strain), *_entries(E_p), alpha])


def _entries(A):
    return [A[i, j] for i in range(3) for j in range(3)]


def returned(values):
    """Eᵖ and α after the return, from arrays of shape (n, 19)."""
    strain, flow, length = values[:, :9].reshape(-1, 3, 3), values[:, 9:18], values[:, 18]
    s = 2 * mu * (strain - np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3))
    q = np.linalg.norm(s, axis=(1, 2))
    f = np.maximum(q - np.sqrt(2 / 3) * (sigma_Y + H * length), 0.0)
    step = f / (2 * mu + 2 * H / 3)
    direction = s / np.maximum(q, 1e-6 * sigma_Y)[:, None, None]
    new = flow.reshape(-1, 3, 3) + step[:, None, None] * direction
    return new, length + np.sqrt(2 / 3) * step


model = Model(
    body,
    "symmetric",
    plastic,
    motions=[
        Fixed(left, components="x"),
        Stretch(right, components="x", table=[(0.0, 0.0), (1.0, 0.05), (1.5, 0.03), (3.0, 0.10)]),
        Fixed(Where(extents=(("y", "min"),)), components="y"),
        Fixed(Where(extents=(("z", "min"),)), components="z"),
    ],
    histories=[
        History(E_p, now, lambda values: returned(values)[0]),
        History(alpha, now, lambda values: returned(values)[1]),
    ],
)

# %% [markdown]
# ## The check
#
# A bar in tension whose sides are free is in a state of one stress: with the strain ε = log(1 + e),
# e the elongation, the Kirchhoff stress is E ε up to σ_Y, then grows with E H/(E + H); on the way
# back it falls with E. The force on the unit square is τ/(1 + e).

# %%
scheme = Static(model.u, h=0.1)
problem = MixedProblem(model.energy(scheme), model.fields, model.bcs)
account = Account(model, scheme, problem.unbalanced_forces)
times, elongations = [0.0, 1.0, 1.5, 3.0], [0.0, 0.05, 0.03, 0.10]

flow, length, errors, iterations = 0.0, 0.0, [], []
for k, result in enumerate(march(problem, scheme, 30, account), start=1):
    e = np.interp(0.1 * k, times, elongations)
    tau = E * (np.log1p(e) - flow)
    if (over := abs(tau) - (sigma_Y + H * length)) > 0.0:
        flow, length = flow + np.sign(tau) * over / (E + H), length + over / (E + H)
        tau = E * (np.log1p(e) - flow)
    errors.append(account.reactions[1, 0] * (1 + e) / tau - 1)
    iterations.append(result.iterations)
    if k in (10, 15, 30):
        say(f"e = {e:.2f}: Kirchhoff stress {account.reactions[1, 0] * (1 + e):.5e} Pa, {tau:.5e}")

say(f"largest relative error {np.abs(errors).max():.0e}; iterations up to {max(iterations)}")
assert np.abs(errors).max() < 1e-6
assert max(iterations) <= 8
