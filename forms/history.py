"""History variables: fields that stay as they are during a step and change when it is accepted."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from ufl.core.expr import Expr

from forms.cell_data import refresh
from forms.fields import components

if TYPE_CHECKING:
    from forms.model import Model
    from forms.time import Scheme

Array = npt.NDArray[np.float64]


class History:
    """A field with an update, such as the stretch of the step before in a viscous energy.

        S_old = point_field(body.mesh, np.eye(3), symmetric=True, name="S_old")
        viscous = lambda S: psi(S) + eta / (2 * h) * inner(S - S_old, S - S_old)
        model = Model(body, "symmetric", viscous, histories=[History(S_old, Model.stretch)])

    The field is a coefficient of the energy like any other.

    Attributes:
        field: The field.
    """

    def __init__(
        self,
        field: fem.Function,
        update: Expr | Callable[[Model, Scheme], Expr],
        compute: Callable[[Array], Array] | None = None,
    ) -> None:
        """Tell how a field changes.

        Args:
            field: Piecewise constant, at quadrature points (`forms.point_field`), or Lagrange.
            update: Its value after a step, an expression of the fields at the end of the step; or a
                function of model and scheme that returns it, since these come after the field.
            compute: For what UFL cannot say, such as a return map: function from the values of
                `update` at the points of the field, shape (n, *shape of update), to those of the
                field, shape (n, *shape of field). By default the values are taken as they are.
        """
        self.field = field
        self._update = update
        self._compute = compute
        self._compiled: tuple[Expr, fem.Expression] | None = None

    def after_step(self, model: Model, scheme: Scheme) -> Array:
        """Return the local degrees of freedom, ghosts included, that the field is to have.

        Collective the first time, when the expression is compiled.
        """
        V = self.field.function_space
        if self._compiled is None:
            update = self._update
            expression = update if isinstance(update, Expr) else update(model, scheme)
            points = V.element.interpolation_points
            self._compiled = expression, fem.Expression(expression, points)
        expression, compiled = self._compiled
        refresh([expression])
        index_map = V.mesh.topology.index_map(V.mesh.topology.dim)
        cells = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
        values = np.asarray(compiled.eval(V.mesh, cells), dtype=np.float64)
        values = values.reshape(-1, *expression.ufl_shape)
        if self._compute is not None:
            values = self._compute(values)
        dofs, size = V.dofmap.list, V.dofmap.bs
        result: Array = self.field.x.array.copy()
        result.reshape(-1, size)[dofs] = components(values, size).reshape(*dofs.shape, size)
        return result
