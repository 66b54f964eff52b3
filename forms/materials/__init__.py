"""Strain energy densities Ψ(S) of the right stretch S, isotropic, zero and stress-free at S = I.

A material is any function `psi(S) -> ufl.Expr` [J/m³]; the classes here add parameters in SI units,
range checks and a formula. In 2D all of them mean plane strain.
"""

from forms.materials.base import Material, StrainEnergy, lame_parameters
from forms.materials.corotational import AsRigidAsPossible, Corotational, FixedCorotational
from forms.materials.isotropy import require_isotropic
from forms.materials.neo_hookean import NeoHookean, SmithNeoHookean, StableNeoHookean
from forms.materials.regions import by_tag, cell_values
from forms.materials.rubber import MooneyRivlin, Ogden
from forms.materials.strain import Fung, Hencky, StVenantKirchhoff

MATERIALS: dict[str, type[Material]] = {
    "as-rigid-as-possible": AsRigidAsPossible,
    "corotational": Corotational,
    "fixed-corotational": FixedCorotational,
    "stable-neo-hookean": StableNeoHookean,
    "smith-neo-hookean": SmithNeoHookean,
    "neo-hookean": NeoHookean,
    "st-venant-kirchhoff": StVenantKirchhoff,
    "mooney-rivlin": MooneyRivlin,
    "ogden": Ogden,
    "hencky": Hencky,
    "fung": Fung,
}
"""Materials by the name that a scene file uses. To add one: `MATERIALS["mine"] = Mine`."""

__all__ = [
    "MATERIALS",
    "AsRigidAsPossible",
    "Corotational",
    "FixedCorotational",
    "Fung",
    "Hencky",
    "Material",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "SmithNeoHookean",
    "StVenantKirchhoff",
    "StableNeoHookean",
    "StrainEnergy",
    "by_tag",
    "cell_values",
    "lame_parameters",
    "require_isotropic",
]
