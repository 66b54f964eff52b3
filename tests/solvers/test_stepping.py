"""Steps that are cut where a solve fails and grow again, and a body that needs them."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest

from forms import Fixed, Model, NeoHookean, Static, Twist
from meshes import Where, box
from solvers import ConvergenceError, MixedProblem, SolveResult, StepControl, march
from tests.bodies import largest

COMM = MPI.COMM_WORLD
DONE = SolveResult(1, [1], "CONVERGED_FNORM_RELATIVE", [], [], {})


class Hard:
    """A problem without physics whose solve fails for steps that are too long around t = 1."""

    def __init__(self, longest):
        self.fields, self.t, self.ends = (), 0.0, []
        self.h = SimpleNamespace(value=1.0)
        self.longest = longest

    def solve(self):
        if 0.5 < self.t < 1.5 and self.h.value > self.longest:
            raise ConvergenceError(DONE)
        return DONE

    def advance(self):
        self.t += self.h.value
        self.ends.append(self.t)

    def local_error(self):
        return 0.0


def test_cut_and_grown():
    """By halves down to where it works, then doubled; multiples of h are met."""
    hard = Hard(0.3)
    results = list(march(hard, hard, 4, control=StepControl()))
    assert hard.ends == [1.0, 1.25, 1.5, 2.0, 3.0, 4.0]
    assert len(results) == 6
    assert hard.h.value == 1.0


def test_cut_no_further():
    """A failure at the smallest step is one; the step is afterwards as it was."""
    hard = Hard(0.3)
    with pytest.raises(ConvergenceError):
        list(march(hard, hard, 4, control=StepControl(cuts=1)))
    assert (hard.ends, hard.h.value) == ([1.0], 1.0)
    with pytest.raises(ConvergenceError):
        list(march(hard, hard, 4))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"cuts": -1}, "cuts is -1"), ({"tolerance": 0.0}, "tolerance is 0.0; it must be a length")],
)
def test_what_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        StepControl(**wrong)


def test_a_block_bent_in_one_step():
    """By 170 degrees, which 6 iterations do not reach: with cuts it gets where small steps do."""
    ends = [Where(extents=(("x", which),)) for which in ("min", "max")]
    found = []
    for steps, control in ((1, StepControl()), (16, None)):
        motions = [
            Fixed(ends[0]),
            Twist(ends[1], np.deg2rad(170.0) / steps, centre=(3.0, 0.5)),
        ]
        body = box(COMM, (3.0, 1.0), (6, 2))
        model = Model(body, "displacement", NeoHookean(10.0, 0.4), motions=motions)
        scheme = Static(model.u)
        problem = MixedProblem(
            model.energy(scheme), model.fields, model.bcs, options={"snes_max_it": 6}
        )
        made = len(list(march(problem, scheme, steps, model, control)))
        assert scheme.t == pytest.approx(steps)
        assert made > 1
        found.append(model.u.x.array.copy())
    assert largest(found[0] - found[1]) < 1e-8
    assert np.isfinite(found[0]).all()
