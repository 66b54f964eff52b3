"""Per-cell data that depend on the unknowns but that UFL does not differentiate."""

from __future__ import annotations

from abc import abstractmethod

from dolfinx import fem


class CellData(fem.Function):
    """A DG0 coefficient computed cell by cell from other fields.

    UFL treats it as a constant, so an expression that uses it must carry its derivative in another
    way (see `forms.rotation`). A solver finds every `CellData` among the coefficients of an energy
    and calls `refresh` before each evaluation of a residual or a Jacobian.
    """

    @abstractmethod
    def refresh(self) -> None:
        """Recompute the values on all owned and ghost cells of this rank. Not collective."""
