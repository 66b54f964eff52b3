"""The continuous side: fields, kinematics, materials and Lagrangians in UFL (seed, eq. 1).

Nothing here knows PETSc. A formulation is a short function from fields to an energy density; the
solvers derive the Newton system from its integral.
"""

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)

from forms.cell_data import CellData, frozen, refresh
from forms.fields import displacement_field, mixed_fields
from forms.formulations import (
    FORMULATIONS,
    Formulation,
    displacement,
    gauss_newton,
    hu_washizu,
    lagged_rotation,
    log_strain,
    mean_dilatation,
    rotation_field,
    seed,
    seed_singular,
    symmetric,
)
from forms.kinematics import deformation_gradient
from forms.materials import (
    MATERIALS,
    AsRigidAsPossible,
    Corotational,
    FixedCorotational,
    Fung,
    Hencky,
    Material,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    SmithNeoHookean,
    StableNeoHookean,
    StVenantKirchhoff,
    by_tag,
    cell_values,
    lame_parameters,
)
from forms.points import measure, quadrature_degree, require_measure
from forms.rotation import (
    linearised_stretch,
    polar_rotation,
    quaternion_rotation,
    right_stretch,
)
from forms.stress import (
    biot_stress,
    cauchy_stress,
    first_piola_kirchhoff_stress,
    von_mises_stress,
)
from forms.time import BackwardEuler

__all__ = [
    "FORMULATIONS",
    "MATERIALS",
    "AsRigidAsPossible",
    "BackwardEuler",
    "CellData",
    "Corotational",
    "FixedCorotational",
    "Formulation",
    "Fung",
    "Hencky",
    "Material",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "SmithNeoHookean",
    "StVenantKirchhoff",
    "StableNeoHookean",
    "biot_stress",
    "by_tag",
    "cauchy_stress",
    "cell_values",
    "deformation_gradient",
    "displacement",
    "displacement_field",
    "first_piola_kirchhoff_stress",
    "frozen",
    "gauss_newton",
    "hu_washizu",
    "lagged_rotation",
    "lame_parameters",
    "linearised_stretch",
    "log_strain",
    "mean_dilatation",
    "measure",
    "mixed_fields",
    "polar_rotation",
    "quadrature_degree",
    "quaternion_rotation",
    "refresh",
    "require_measure",
    "right_stretch",
    "rotation_field",
    "seed",
    "seed_singular",
    "symmetric",
    "von_mises_stress",
]
