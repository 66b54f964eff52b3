"""The continuous side: fields, kinematics, materials and Lagrangians in UFL (seed, eq. 1).

Nothing here knows PETSc. A formulation is a short function from fields to an energy density; the
solvers derive the Newton system from its integral.
"""

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)

from forms.account import Account, Balance
from forms.cell_data import (
    CellData,
    CellFunction,
    Intermediate,
    Linearised,
    frozen,
    intermediate,
    refresh,
)
from forms.compilation import CompilationError, watch_ffcx
from forms.damping import Rayleigh
from forms.fields import cell_not_finite, displacement_field, mixed_fields, point_field
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
    taylor_hood,
)
from forms.history import History
from forms.kinematics import deformation_gradient
from forms.loads import (
    LOADS,
    BodyForce,
    Gravity,
    HalfSpace,
    Load,
    PointForce,
    Pressure,
    Traction,
)
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
from forms.model import Energies, EnergyIntegrals, Model
from forms.motions import (
    MOTIONS,
    Bend,
    Fixed,
    Held,
    Motion,
    Prescribed,
    Stretch,
    Timed,
    Translate,
    Twist,
)
from forms.newmark import GeneralisedAlpha, Newmark, Trapezoidal
from forms.points import measure, quadrature_degree, require_measure
from forms.rotation import (
    linearised_stretch,
    polar_rotation,
    quaternion_rotation,
    right_stretch,
)
from forms.schemes import SCHEMES
from forms.start import set_velocity
from forms.stress import (
    biot_stress,
    cauchy_stress,
    first_piola_kirchhoff_stress,
    von_mises_stress,
)
from forms.time import BDF2, BackwardEuler, ImplicitMidpoint, Scheme, Static

watch_ffcx()

__all__ = [
    "BDF2",
    "FORMULATIONS",
    "LOADS",
    "MATERIALS",
    "MOTIONS",
    "SCHEMES",
    "Account",
    "AsRigidAsPossible",
    "BackwardEuler",
    "Balance",
    "Bend",
    "BodyForce",
    "CellData",
    "CellFunction",
    "CompilationError",
    "Corotational",
    "Energies",
    "EnergyIntegrals",
    "Fixed",
    "FixedCorotational",
    "Formulation",
    "Fung",
    "GeneralisedAlpha",
    "Gravity",
    "HalfSpace",
    "Held",
    "Hencky",
    "History",
    "ImplicitMidpoint",
    "Intermediate",
    "Linearised",
    "Load",
    "Material",
    "Model",
    "MooneyRivlin",
    "Motion",
    "NeoHookean",
    "Newmark",
    "Ogden",
    "PointForce",
    "Prescribed",
    "Pressure",
    "Rayleigh",
    "Scheme",
    "SmithNeoHookean",
    "StVenantKirchhoff",
    "StableNeoHookean",
    "Static",
    "Stretch",
    "Timed",
    "Traction",
    "Translate",
    "Trapezoidal",
    "Twist",
    "biot_stress",
    "by_tag",
    "cauchy_stress",
    "cell_not_finite",
    "cell_values",
    "deformation_gradient",
    "displacement",
    "displacement_field",
    "first_piola_kirchhoff_stress",
    "frozen",
    "gauss_newton",
    "hu_washizu",
    "intermediate",
    "lagged_rotation",
    "lame_parameters",
    "linearised_stretch",
    "log_strain",
    "mean_dilatation",
    "measure",
    "mixed_fields",
    "point_field",
    "polar_rotation",
    "quadrature_degree",
    "quaternion_rotation",
    "refresh",
    "require_measure",
    "right_stretch",
    "rotation_field",
    "seed",
    "seed_singular",
    "set_velocity",
    "symmetric",
    "taylor_hood",
    "von_mises_stress",
]
