"""What a formulation is: its unknowns, its energy density, and how to read its fields."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.cell_data import frozen
from forms.materials import StrainEnergy

Fields = tuple[fem.Function, ...]


class Formulation(ABC):
    """A Lagrangian as a named choice.

    A new one is a subclass with the four methods, and an entry in the registry:
    `FORMULATIONS["mine"] = Mine()`. One that holds for some Ψ only looks at Ψ in `density`.

    Attributes:
        name: The name that messages use; of those of the package that of a scene file, too.
        description: One line.
        exact: Whether UFL's Newton matrix is the derivative of the residual. If not, Newton's
            method converges linearly.
        equivalent: Whether its positions are those of `displacement` with the same rule of
            integration.
        sees_inversion: Whether det F < 0 costs what Ψ says. If not, `Model.accept` warns of it.
    """

    name: ClassVar[str]
    description: ClassVar[str] = ""
    exact: ClassVar[bool] = True
    equivalent: ClassVar[bool] = True
    sees_inversion: ClassVar[bool] = True

    @abstractmethod
    def fields(self, msh: mesh.Mesh, degree: int = 1) -> Fields:
        """Return the unknowns at rest, the displacement first.

        Args:
            msh: Triangles or quadrilaterals in 2D, tetrahedra or hexahedra in 3D.
            degree: Of the element, which is that of the displacement where nothing else is said.

        Raises:
            ValueError: Unsupported cells or degree.
        """

    def degree_of_u(self, degree: int) -> int:
        """Return the degree of the displacement for that of the element."""
        return degree

    @abstractmethod
    def density(self, *fields_and_psi: Any, **named: Any) -> Expr:
        """Return the energy density [J/m³] without inertia, of (*fields, psi).

        The displacement may be any expression, such as the mean of two.
        """

    @abstractmethod
    def stretch(self, *fields: Any, **named: Any) -> Expr:
        """Return the right stretch that Ψ is a function of, shape (d, d)."""

    @abstractmethod
    def stress(self, *fields_and_psi: Any, **named: Any) -> Expr:
        """Return the first Piola-Kirchhoff stress [Pa] of (*fields, psi), shape (d, d).

        At a stationary point, with an isotropic Ψ.
        """


def rest_shear_modulus(psi: StrainEnergy, S: fem.Function) -> Expr:
    """¼ ∂²Ψ[D, D] [Pa] at S = I, D the shear D₀₁ = D₁₀ = 1."""
    d = S.ufl_shape[0]
    D = np.zeros((d, d))
    D[0, 1] = D[1, 0] = 1.0
    shear = ufl.variable(fem.Constant(S.function_space.mesh, 0.0))
    along = psi(ufl.Identity(d) + shear * ufl.as_matrix(D.tolist()))
    return frozen(ufl.diff(ufl.diff(along, shear), shear) / 4)
