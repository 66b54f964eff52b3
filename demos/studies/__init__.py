"""Studies: grids of cases with a table, files and a figure. `mixed-fem study NAME`."""

from demos.studies.benchmark import BENCHMARK
from demos.studies.cost import COST
from demos.studies.equivalence import EQUIVALENCE
from demos.studies.few_iterations import FEW_ITERATIONS
from demos.studies.locking import LOCKING
from demos.studies.newton import NEWTON
from demos.studies.preconditioner import PRECONDITIONER
from demos.studies.refinement import REFINEMENT
from demos.studies.scaling import SCALING
from demos.studies.stiffness import STIFFNESS
from demos.studies.study import Interrupted, Outcome, Record, Study, run
from demos.studies.timestep import TIMESTEP

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        BENCHMARK,
        COST,
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
"""Studies by name."""

__all__ = ["STUDIES", "Interrupted", "Outcome", "Record", "Study", "run"]
