"""Mixed Lagrangians: short functions from fields to an energy density [J/m³] (seed, eq. 1).

Each leaves out the kinetic term, which a time scheme adds (`forms.time`). Λ is the first
Piola-Kirchhoff stress at a stationary point: ∂L/∂S = 0 reads ∂Ψ/∂S = sym(RᵀΛ). With the same rule
of integration (`forms.points`) all but `mean_dilatation` and `taylor_hood` have the positions of
`displacement`; what differs is the way of Newton's method there, and what an iteration costs.
"""

from forms.formulations.base import Fields, Formulation
from forms.formulations.classical import Displacement
from forms.formulations.full import RotationField, Seed, seed_singular
from forms.formulations.rotated import GaussNewton, LaggedRotation, Symmetric
from forms.formulations.rotation_free import HuWashizu, LogStrain
from forms.formulations.volumetric import MeanDilatation, TaylorHood

FORMULATIONS: dict[str, Formulation] = {
    formulation.name: formulation
    for formulation in (
        Symmetric(),
        Seed(),
        RotationField(),
        LaggedRotation(),
        GaussNewton(),
        HuWashizu(),
        LogStrain(),
        MeanDilatation(),
        TaylorHood(),
        Displacement(),
    )
}
"""Formulations by name. To add one: `FORMULATIONS["mine"] = Mine()`, see `Formulation`."""

# The densities as functions of (*fields, psi), for energies written by hand.
symmetric = FORMULATIONS["symmetric"].density
seed = FORMULATIONS["seed"].density
rotation_field = FORMULATIONS["rotation-field"].density
lagged_rotation = FORMULATIONS["lagged-rotation"].density
gauss_newton = FORMULATIONS["gauss-newton"].density
hu_washizu = FORMULATIONS["hu-washizu"].density
log_strain = FORMULATIONS["log-strain"].density
mean_dilatation = FORMULATIONS["mean-dilatation"].density
taylor_hood = FORMULATIONS["taylor-hood"].density
displacement = FORMULATIONS["displacement"].density

__all__ = [
    "FORMULATIONS",
    "Displacement",
    "Fields",
    "Formulation",
    "GaussNewton",
    "HuWashizu",
    "LaggedRotation",
    "LogStrain",
    "MeanDilatation",
    "RotationField",
    "Seed",
    "Symmetric",
    "TaylorHood",
    "displacement",
    "gauss_newton",
    "hu_washizu",
    "lagged_rotation",
    "log_strain",
    "mean_dilatation",
    "rotation_field",
    "seed",
    "seed_singular",
    "symmetric",
    "taylor_hood",
]
