"""The hand-derived discrete system of the seed, eqs. (2)-(41), in plain NumPy.

Written from the equations and importing nothing of the UFL side, it is an independent witness: the
blocks that UFL derives must equal the blocks here. `errata` says of every numbered equation whether
it holds as printed. `compare`, which the witness does not import, holds it against UFL.
"""

from demos.by_hand.basis import (
    dof_weights,
    skew_basis,
    symmetric_basis,
    symmetric_dofs,
    symmetric_tensor,
)
from demos.by_hand.errata import ERRATA, Erratum, Verdict
from demos.by_hand.materials import (
    MATERIALS,
    AsRigidAsPossible,
    Corotational,
    Material,
    StableNeoHookean,
    lame_parameters,
)
from demos.by_hand.rotation import Polar, signed_svd
from demos.by_hand.seed import SeedSystem
from demos.by_hand.solve import Step, solve_condensed, solve_kkt, solve_printed, solve_reduced
from demos.by_hand.state import State
from demos.by_hand.symmetric import SymmetricSystem
from demos.by_hand.system import DiscreteSystem

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
    "lame_parameters",
    "signed_svd",
    "skew_basis",
    "solve_condensed",
    "solve_kkt",
    "solve_printed",
    "solve_reduced",
    "symmetric_basis",
    "symmetric_dofs",
    "symmetric_tensor",
]
