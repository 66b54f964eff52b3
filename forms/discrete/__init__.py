"""The hand-derived discrete system of the seed, eqs. (2)-(41), in plain NumPy.

Written from the equations and importing nothing of the UFL side, it is an independent witness: the
blocks that UFL derives must equal the blocks here. `ERRATA` states for every numbered equation
whether it holds as printed.
"""

from forms.discrete.basis import (
    dof_weights,
    skew_basis,
    symmetric_basis,
    symmetric_dofs,
    symmetric_tensor,
)
from forms.discrete.errata import ERRATA, Erratum, Verdict
from forms.discrete.materials import (
    MATERIALS,
    AsRigidAsPossible,
    Corotational,
    Material,
    StableNeoHookean,
)
from forms.discrete.rotation import Polar, signed_svd
from forms.discrete.seed import SeedSystem
from forms.discrete.solve import Step, solve_condensed, solve_kkt, solve_reduced
from forms.discrete.state import State
from forms.discrete.symmetric import SymmetricSystem
from forms.discrete.system import DiscreteSystem

__all__ = [
    "ERRATA",
    "MATERIALS",
    "AsRigidAsPossible",
    "Corotational",
    "DiscreteSystem",
    "Erratum",
    "Material",
    "Polar",
    "SeedSystem",
    "StableNeoHookean",
    "State",
    "Step",
    "SymmetricSystem",
    "Verdict",
    "dof_weights",
    "signed_svd",
    "skew_basis",
    "solve_condensed",
    "solve_kkt",
    "solve_reduced",
    "symmetric_basis",
    "symmetric_dofs",
    "symmetric_tensor",
]
