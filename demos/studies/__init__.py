"""Studies: grids of cases with a table, files and a figure. `mixed-fem study NAME`.

Your own: a Python file with `MINE = Study(...)`, and `mixed-fem study path/to/file.py`.
"""

from mpi4py import MPI  # noqa: F401  (with the PyPI wheel MPI must be imported before DOLFINx)

from demos.studies.benchmark import BENCHMARK
from demos.studies.conservation import CONSERVATION
from demos.studies.cost import COST
from demos.studies.duel import DUEL
from demos.studies.endurance import ENDURANCE
from demos.studies.equivalence import EQUIVALENCE
from demos.studies.few_iterations import FEW_ITERATIONS
from demos.studies.files import StudyError, studies_in
from demos.studies.locking import LOCKING
from demos.studies.newton import NEWTON
from demos.studies.preconditioner import PRECONDITIONER
from demos.studies.records import Record
from demos.studies.refinement import REFINEMENT
from demos.studies.runner import Interrupted, Outcome, run
from demos.studies.scaling import SCALING
from demos.studies.stiffness import STIFFNESS
from demos.studies.study import Study
from demos.studies.timestep import TIMESTEP

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        BENCHMARK,
        CONSERVATION,
        COST,
        DUEL,
        ENDURANCE,
        EQUIVALENCE,
        FEW_ITERATIONS,
        LOCKING,
        NEWTON,
        PRECONDITIONER,
        REFINEMENT,
        SCALING,
        STIFFNESS,
        TIMESTEP,
    )
}
"""Studies by name; one that is put in here can be run by its name."""

__all__ = [
    "STUDIES",
    "Interrupted",
    "Outcome",
    "Record",
    "Study",
    "StudyError",
    "run",
    "studies_in",
]
