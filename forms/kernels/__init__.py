"""Compiled kernels of the built-in formulations and materials, on P1 displacements (numba).

They give, many times faster, the same numbers as the forms that DOLFINx derives from the energy
densities `forms.symmetric` and `forms.displacement`. Numba is imported when a kernel is made, not
before.
"""

from forms.kernels.cells import MATERIALS
from forms.kernels.displacement import DisplacementKernel
from forms.kernels.symmetric import SymmetricKernel

__all__ = ["MATERIALS", "DisplacementKernel", "SymmetricKernel"]
