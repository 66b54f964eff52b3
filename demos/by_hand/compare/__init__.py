"""The hand-derived system held against what UFL derives, equation by equation.

The one part of `demos.by_hand` that imports `forms` and `solvers`.
"""

from demos.by_hand.compare.report import run

__all__ = ["run"]
