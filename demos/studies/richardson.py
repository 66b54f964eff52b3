"""Grid convergence: observed order, Richardson's extrapolation and the grid convergence index.

P. J. Roache, Perspective: a method for uniform reporting of grid refinement studies, Journal of
Fluids Engineering 116 (1994) 405-413; L. Eça, M. Hoekstra, A procedure for the estimation of the
numerical uncertainty of CFD calculations, Journal of Computational Physics 262 (2014) 104-130.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import scipy

SAFETY, DOUBTFUL = 1.25, 3.0  # factors of the index, where the series is asymptotic, and else
LEAST, MOST = 0.2, 10.0  # orders that are looked for
SAME = 0.25  # how much the orders of the last two triples of levels may differ, relative
ROUND_OFF = 1e-10


@dataclass(frozen=True)
class Convergence:
    """What a series of values on finer and finer levels says.

    Attributes:
        order: Observed order of the last three; nan if they do not converge by a power.
        limit: Richardson's extrapolation; nan likewise.
        index: Grid convergence index of the finest value: its likely error, a length of the value's
            own unit, with a factor of safety; nan likewise.
        remark: Why the series is not, or may not be, asymptotic; empty if nothing speaks against.
    """

    order: float
    limit: float
    index: float
    remark: str


def convergence(sizes: Sequence[float], values: Sequence[float]) -> Convergence:
    """Judge a series of values.

    Args:
        sizes: Of cells or steps, at least three, from coarse to fine.
        values: One each.
    """
    nothing = (math.nan, math.nan, math.nan)
    if len(sizes) < 3:
        return Convergence(*nothing, "needs three levels or more")
    scale = max(map(abs, values))
    changes = [b - a for a, b in zip(values[-3:], values[-2:], strict=False)]
    if max(map(abs, changes)) <= ROUND_OFF * scale:
        return Convergence(math.nan, values[-1], 0.0, "the same on all levels")
    if changes[0] * changes[1] <= 0.0:
        return Convergence(*nothing, "not asymptotic: it goes to and fro")
    order = _order(sizes[-3:], changes)
    if math.isnan(order):
        return Convergence(*nothing, "not asymptotic: it does not settle")
    ratio = (sizes[-2] / sizes[-1]) ** order
    correction = changes[1] / (ratio - 1.0)
    limit, doubtful = values[-1] + correction, DOUBTFUL * abs(correction)
    if len(sizes) == 3:
        return Convergence(order, limit, doubtful, "one order only, of three levels")
    earlier = [b - a for a, b in zip(values[-4:-1], values[-3:-1], strict=False)]
    before = _order(sizes[-4:-1], earlier) if earlier[0] * earlier[1] > 0.0 else math.nan
    if math.isnan(before) or abs(before - order) > SAME * order:
        told = "none" if math.isnan(before) else f"{before:.2f}"
        return Convergence(
            order, limit, doubtful, f"not yet asymptotic: the order of the levels before is {told}"
        )
    return Convergence(order, limit, SAFETY * abs(correction), "")


def _order(sizes: Sequence[float], changes: Sequence[float]) -> float:
    """The p of f + c hᵖ through three values, given their two differences; nan if there is none."""
    wanted = changes[0] / changes[1]

    def excess(p: float) -> float:
        coarse, middle, fine = (size**p for size in sizes)
        return math.log((coarse - middle) / (middle - fine)) - math.log(wanted)

    if excess(LEAST) * excess(MOST) > 0.0:
        return math.nan
    return float(scipy.optimize.brentq(excess, LEAST, MOST))
