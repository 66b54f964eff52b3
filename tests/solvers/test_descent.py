"""The displacement's Newton as it is practised: descents on the energy to the same state."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from demos.studies.bar import bar
from solvers.options import CONDENSED_CG
from solvers.strategies import STRATEGIES
from solvers.strategies.descent import Descent
from tests.bodies import largest

COMM = MPI.COMM_WORLD
CG = {f"condensed_{key}": value for key, value in CONDENSED_CG.items()}
DESCENTS = [name for name, strategy in STRATEGIES.items() if issubclass(strategy, Descent)]
ON_DEMAND = ("project-on-demand", "kinetic-newton", "progressive-newton")
SOFT = {"n": 3, "E": 1e5, "h": 0.5}
STIFF = {"n": 2, "E": 1e10, "h": 0.1, "support": "rotating"}


def steps(formulation, globalisation=None, options=CG, count=2, **case):
    """A plane bar after a few steps."""
    run = bar(COMM, formulation, dimension=2, globalisation=globalisation, options=options, **case)
    for _ in range(count):
        run.step()
    assert run.failure == ""
    return run


def iterations(run):
    return [result.iterations for result in run.results]


def notes(run):
    return {note for result in run.results for note in result.notes.values()}


@pytest.fixture(scope="module")
def soft():
    """Where the mixed method arrives."""
    return steps("symmetric", **SOFT).model.u.x.array


def recorded(name, energies):
    """A strategy that notes the energy after each step, a list a solve."""

    class Recorded(STRATEGIES[name]):
        def solve(self):
            energies.append([])
            return super().solve()

        def accepted(self, x, y, slope, change):
            energies[-1].append(self.system.energy())
            super().accepted(x, y, slope, change)

    return Recorded()


def check_falling(run, energies):
    """An energy a step, none above that before by more than rounding error."""
    assert iterations(run) == list(map(len, energies))
    for fall in energies:
        assert np.diff(fall).max(initial=0.0) <= 1e-11 * np.abs(fall).max(initial=0.0)


@pytest.mark.parametrize("name", [name for name in DESCENTS if name != "local-global"])
def test_a_descent_arrives_where_the_mixed_method_does(soft, name):
    """Whatever its tangent is; one that is always projected takes many more iterations."""
    energies = []
    run = steps("displacement", recorded(name, energies), **SOFT)
    assert largest(run.model.u.x.array - soft) < 1e-7 * largest(soft)
    check_falling(run, energies)
    on_demand = name in ("project-on-demand", "kinetic-newton", "progressive-newton")
    assert (max if on_demand else min)(iterations(run)) in range(
        *((6, 13) if on_demand else (18, 45))
    )
    assert bool(notes(run)) == on_demand


@pytest.mark.parametrize("name", ON_DEMAND)
def test_factors_tell_negative_curvature_too(soft, name):
    """LDLᵀ instead of conjugate gradients: the same state, as few iterations, the same remark."""
    run = steps("displacement", name, options={}, **SOFT)
    assert largest(run.model.u.x.array - soft) < 1e-7 * largest(soft)
    assert notes(run) == {"negative curvature: projected tangent"} and max(iterations(run)) < 13


def test_a_search_on_the_energy_cuts_good_steps_of_a_stiff_body_that_turns():
    """Full steps need few iterations there, and the mixed method fewer."""
    assert max(iterations(steps("symmetric", **STIFF))) <= 4
    assert max(iterations(steps("displacement", "full-steps", **STIFF))) <= 6
    assert min(iterations(steps("displacement", "project-on-demand", **STIFF))) > 20


def test_a_constant_matrix_takes_hundreds_of_iterations():
    """The matrix is assembled once a step, and the energy falls."""
    energies = []
    case = {"n": 2, "E": 1e4, "h": 0.1}
    run = steps("displacement", recorded("local-global", energies), **case)
    mixed = steps("symmetric", **case)
    assert largest(run.model.u.x.array - mixed.model.u.x.array) < 1e-7
    check_falling(run, energies)
    assert max(iterations(mixed)) < 7 and min(iterations(run)) > 80
    assert run.results[1].timings["jacobian"] < run.results[1].timings["residual"] / 5


def test_trust_region_filtering_learns_from_the_last_step():
    """Absolute eigenvalues at first, clamped ones once the exact model foretells the energy."""
    chosen = []

    class Watched(STRATEGIES["filtered-newton"]):
        def accepted(self, x, y, slope, change):
            chosen.append(self.system.projection)
            super().accepted(x, y, slope, change)

    steps("displacement", Watched(), count=1, n=2, E=1e7, h=0.1)
    assert chosen[0] == 2 and chosen[-1] == 1


def test_a_descent_needs_the_displacement_alone():
    with pytest.raises(ValueError, match="'kinetic-newton' needs the displacement alone"):
        steps("symmetric", "kinetic-newton", **SOFT)
