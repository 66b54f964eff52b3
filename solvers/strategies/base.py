"""What a strategy of Newton's method is asked for."""

from __future__ import annotations

from petsc4py import PETSc

from solvers.newton import Newton
from solvers.options import NEWTON, Options


class Strategy:
    """A strategy that keeps Newton's method from diverging: this one takes full steps.

    `solve` takes Newton's method from the beginning of a solve to its end, in one pass or several.
    Within a pass SNES makes the iterations, and asks the strategy before each, and before each
    step. Its line search is "basic" then, which goes from x to x - y.

    Attributes:
        newton: What it is attached to.
        options: PETSc's, of Newton's method; the user's override them.
        exact: Whether steps are such that forces which rounding error hides still move the body.
    """

    exact = True
    options: Options = NEWTON
    newton: Newton

    def attach(self, newton: Newton) -> None:
        """Prepare Newton's method, once; SNES has its options.

        Raises:
            ValueError: The strategy does not go with the system.
        """
        self.newton = newton
        newton.steer(self)

    def solve(self) -> bool:
        """Iterate from the beginning of a solve to its end; whether it converged. Collective."""
        return self.newton.iterate()

    def before_iteration(self, snes: PETSc.SNES, iteration: int) -> None:
        """Choose the tangent of the coming iteration of a pass. Collective; called by PETSc."""

    def before_step(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Change the step from scaled unknowns x to x - y, in place. Collective; called by PETSc.

        Returns:
            Whether it has changed.
        """
        return False
