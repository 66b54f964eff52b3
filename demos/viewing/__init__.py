"""What a run has left, to look at and to compute with: `load`, `mixed-fem view` and `plot`.

Nothing here imports MPI, DOLFINx or PETSc: results can be read where none of them is.
"""

from demos.viewing.colours import FIELDS, Field
from demos.viewing.plot import plot
from demos.viewing.results import Results, ResultsError, load

__all__ = ["FIELDS", "Field", "Results", "ResultsError", "load", "plot"]
