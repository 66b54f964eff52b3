"""Steps of cell-local fields that end where the energy has a value."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from petsc4py import PETSc

import numpy as np
import numpy.typing as npt

from solvers.layout import is_local
from solvers.options import ON_THE_WAY
from solvers.systems import System


class Domain:
    """Keeps cell-local fields where the energy has a value: a logarithm of something positive.

    From the first time that a step has led to where there is none, each step is looked at: in cells
    where it would, those fields go half, a quarter, ... of their way.

    Attributes:
        left: Whether a step has led out.
    """

    def __init__(
        self, system: System, vector: Callable[[], PETSc.Vec], note: Callable[[str], None]
    ) -> None:
        """Watch the steps of Newton's method.

        Args:
            system: What it solves.
            vector: Makes a work vector.
            note: Takes a remark on the present iteration.
        """
        self._system, self._vector, self._note = system, vector, note
        self._vectors: tuple[PETSc.Vec, ...] = ()
        self._stepped = False
        self.left = False

    def begin(self) -> None:
        """Begin a pass, before its first step."""
        self._stepped = False

    def watch(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Look at the step from scaled unknowns x to x - y. Collective.

        Returns:
            Whether it has been cut.
        """
        if len(self._system.fields) == 1:
            return False
        if not self._vectors:
            self._vectors = self._vector(), self._vector(), self._vector()
        if self.left:
            return self._cut(x, y)
        self._stepped = True  # PETSc does not say what it keeps of a step that fails
        for vector, kept in zip((x, y), self._vectors, strict=False):
            vector.copy(kept)
        return False

    def amend(self) -> bool:
        """Cut the last step, which has led out; the unknowns are then at its end. Collective.

        Returns:
            Whether that was possible.
        """
        if self.left or not self._stepped:
            return False
        x, y, _ = self._vectors
        self.left = self._cut(x, y)
        self._system.x.waxpy(-1.0, y, x)
        return self.left

    def _cut(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        unknowns, end = self._system.unknowns, self._vectors[2]
        unknowns.write(x)
        before = [f.x.array.copy() for f in self._system.fields]
        end.waxpy(-1.0, y, x)
        unknowns.write(end)
        cells = self._system.hold(before)
        if cells:
            unknowns.read(end)
            y.waxpy(-1.0, end, x)
            self._note(f"steps of {cells} cell{'s' * (cells > 1)} cut: no energy there")
        return cells > 0


def relaxed_on_the_way(system: System, before: Sequence[npt.NDArray[np.float64]]) -> bool:
    """Relax in steps from former values of the fields to the present positions. Collective.

    Returns:
        Whether that has succeeded, in steps of some length.
    """
    shared = [(f, b) for f, b in zip(system.fields, before, strict=True) if not is_local(f)]
    ends = [f.x.array.copy() for f, _ in shared]
    for steps in ON_THE_WAY:
        for f, values in zip(system.fields, before, strict=True):
            f.x.array[:] = values
        for k in range(1, steps + 1):
            for (f, begin), end in zip(shared, ends, strict=True):
                f.x.array[:] = begin + k / steps * (end - begin)
            if not system.relax():
                break
        else:
            return True
    return False
