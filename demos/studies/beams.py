"""Reference solutions of cantilever beams, and the plane bodies that are held against them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from dolfinx import fem

from forms import BackwardEuler, Fixed, Model, Scheme, Static, Traction
from forms.materials import StrainEnergy
from meshes import Body, Where
from solvers import MixedProblem

MATTIASSON = {
    1.0: (0.05643, 0.30172),
    2.0: (0.16064, 0.49346),
    5.0: (0.38763, 0.71379),
    10.0: (0.55500, 0.81061),
}
"""Tips (u/L, w/L) of the elastica by P L²/(E I): u towards the clamp, w along the load.

K. Mattiasson, Numerical results from large deflection beam and frame problems analysed by means of
elliptic integrals, Int. J. Numer. Meth. Engng 17 (1981) 145-153.
"""


def elastica(load: float) -> tuple[float, float]:
    """Tip displacement of an inextensible cantilever under a dead force P across its end.

    By elliptic integrals: K. E. Bisshopp, D. C. Drucker, Large deflection of cantilever beams,
    Quart. Appl. Math. 3 (1945) 272-275.

    Args:
        load: P L²/(E I) [-], positive.

    Returns:
        (u/L, w/L), u towards the clamp, w along the load.
    """
    special = scipy.special

    def excess(m: float) -> float:
        return float(
            (special.ellipk(m) - special.ellipkinc(np.arcsin(1 / np.sqrt(2 * m)), m)) ** 2 - load
        )

    # The parameter m = (1 + sin φ) / 2 of the slope φ at the tip.
    m = scipy.optimize.brentq(excess, 0.5 * (1 + 1e-12), 1 - 1e-15, xtol=1e-15)
    root = np.sqrt(load)
    w = 1 - 2 * (special.ellipe(m) - special.ellipeinc(np.arcsin(1 / np.sqrt(2 * m)), m)) / root
    return float(1 - np.sqrt(2 * (2 * m - 1)) / root), float(w)


CLAMPED_FREE = 1.8751040687
"""β L of the first mode: the least root of 1 + cos x cosh x = 0."""


def timoshenko_frequency(slenderness: float) -> float:
    """First natural frequency of a cantilever with shear and rotatory inertia, ν = 0.

    In units of √(E I / (ρ A)) / L², where Bernoulli's beam has 1.8751² = 3.5160. The shear
    coefficient of the rectangle is 5/6.

    T. C. Huang, The effect of rotatory inertia and of shear deformation on the frequency and normal
    mode equations of uniform beams with simple end conditions, J. Appl. Mech. 28 (1961) 579-584.

    Args:
        slenderness: L / t [-].
    """
    r2 = 1 / (12 * slenderness**2)  # I / (A L²)
    s2 = r2 * 2 / (5 / 6)  # E I / (κ G A L²)

    def determinant(omega: float) -> float:
        # Of (w, φ, M, Q) along the beam; M and Q vanish at its free end, w and φ at the other.
        A = np.zeros((4, 4))
        A[0, 1], A[0, 3], A[1, 2] = 1.0, s2, 1.0
        A[2, 3], A[2, 1], A[3, 0] = -1.0, -r2 * omega**2, -(omega**2)
        return float(np.linalg.det(scipy.linalg.expm(A)[2:, 2:]))

    return float(
        scipy.optimize.brentq(determinant, 0.5 * CLAMPED_FREE**2, CLAMPED_FREE**2 * (1 + 1e-9))
    )


@dataclass
class Cantilever:
    """A plane body held where X₁ is least, with a dead force on the face where it is largest.

    Attributes:
        fields: The unknowns.
        scheme: The time scheme.
        problem: The Newton system.
        traction: Force by area of the face at rest [Pa], a constant of shape (2,).
    """

    fields: tuple[fem.Function[Any], ...]
    scheme: Scheme
    problem: MixedProblem
    traction: fem.Constant
    _mean: list[Any]

    def mean_tip(self) -> tuple[float, float]:
        """Mean displacement of the loaded face [m]. Collective."""
        comm = self.fields[0].function_space.mesh.comm
        area, *moments = (comm.allreduce(fem.assemble_scalar(form)) for form in self._mean)
        first, second = (float(moment / area) for moment in moments)
        return first, second


def cantilever(
    body: Body,
    formulation: str,
    psi: StrainEnergy,
    *,
    degree: int = 1,
    rho: float = 0.0,
    h: float = 0.0,
    options: Mapping[str, Any] | None = None,
) -> Cantilever:
    """Build a body at rest. Collective.

    Args:
        body: A plane body.
        formulation: A name in `forms.FORMULATIONS`.
        psi: Strain energy density, in plane strain.
        degree: Of the element.
        rho: Density [kg/m³]; statics by default.
        h: Time step [s], with a density.
        options: PETSc options.
    """
    held, loaded = (Where(extents=(("x", end),)) for end in ("min", "max"))
    traction = fem.Constant(body.mesh, np.zeros(2))
    model = Model(
        body,
        formulation,
        psi,
        rho=rho or None,
        loads=[Traction(traction, loaded)],
        motions=[Fixed(held)],
        degree=degree,
    )
    scheme = BackwardEuler(model.u, h) if rho else Static(model.u)
    problem = MixedProblem(model.energy(scheme), model.fields, model.bcs, options=options)
    one = fem.Constant(body.mesh, 1.0)
    mean = [fem.form(e * body.ds(loaded)) for e in (one, *model.u)]
    return Cantilever(model.fields, scheme, problem, traction, mean)
