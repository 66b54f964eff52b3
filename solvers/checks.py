"""What is asked of an energy, a work, their fields and conditions before they make a problem."""

from __future__ import annotations

from collections.abc import Sequence

import ufl
from dolfinx import fem
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_arguments

from forms import require_measure
from solvers.layout import is_local


def check_forms(
    energy: ufl.Form, work: ufl.Form | None, fields: Sequence[fem.Function], *, eliminated: bool
) -> None:
    """Insist on a functional of the fields, and on a work on a test function of the displacement.

    Where cell-local fields are eliminated, they must not be coupled with those of the cells beside,
    and the work must not depend on them, so that blocks beside the diagonal are transposes.
    """
    if energy.arguments():
        raise ValueError("the energy has test or trial functions; it must be a functional")
    missing = [f.name for f in fields if f not in energy.coefficients()]
    if missing:
        raise ValueError(f"the energy does not depend on the field {missing[0]}")
    mesh = fields[0].function_space.mesh._cpp_object
    for form in (energy, *([work] if work else [])):
        for f in (*fields, *form.coefficients()):
            if isinstance(f, fem.Function) and f.function_space.mesh._cpp_object is not mesh:
                raise ValueError(f"{f.name} is on another mesh than {fields[0].name}")
    require_measure(energy)
    if work is not None:
        test = ufl.TestFunction(fields[0].function_space)
        if extract_arguments(work) != [test]:
            raise ValueError(f"the work must be linear in a test function of {fields[0].name}")
        require_measure(work)
    if not eliminated:
        return
    local = [f for f in fields if is_local(f)]
    for form in (energy, *([work] if work else [])):
        for integral in form.integrals_by_type("interior_facet"):
            for f in extract_coefficients(integral.integrand()):
                if f in local:
                    raise ValueError(
                        f"{f.name} is in an integral over interior facets (dS), which couples it "
                        "with that of the cells beside, so that it cannot be eliminated cell by "
                        'cell; choose solver="direct"'
                    )
    for f in local:
        if work is not None and f in work.coefficients():
            raise ValueError(f'the work depends on {f.name}; choose solver="direct"')


def check_conditions(bcs: Sequence[fem.DirichletBC], fields: Sequence[fem.Function]) -> None:
    """Insist that Dirichlet conditions are on fields that are not local to cells.

    On the space of such a field, or on a part of it.
    """
    for k, bc in enumerate(bcs):
        of = [f for f in fields if f.function_space._cpp_object.contains(bc.function_space)]
        if of and not is_local(of[0]):
            continue
        u = fields[0]
        on = f"of the cell-local field {of[0].name}" if of else "of no field"
        if bc.function_space.mesh is not u.function_space.mesh._cpp_object:
            on = "of another mesh"
        raise ValueError(
            f"Dirichlet condition {k} is on a function space {on}; make it on "
            f"{u.name}.function_space, where {u.name} is among the fields"
        )
