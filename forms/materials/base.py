"""What the materials share: parameters in SI units, range checks, a formula."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

if TYPE_CHECKING:
    from forms.history import History

StrainEnergy = Callable[[Expr], Expr]


def lame_parameters(E: float, nu: float) -> tuple[float, float]:
    """Return the Lamé parameters (μ, λ) [Pa] of Young's modulus E [Pa] and Poisson's ratio ν.

    Plane strain in 2D.

    Raises:
        ValueError: E is not positive and finite, or ν is outside (-1, 0.5).
    """
    if not (math.isfinite(E) and E > 0.0):
        raise ValueError(f"E is {E}; Young's modulus [Pa] must be positive and finite")
    if not -1.0 < nu < 0.5:
        raise ValueError(f"nu is {nu}; Poisson's ratio must lie between -1 and 0.5, both excluded")
    return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Material(ABC):
    """An isotropic material given by Young's modulus and Poisson's ratio.

    Parameters enter forms as `fem.Constant`, so that a change of value compiles nothing anew.

    Attributes:
        E: Young's modulus [Pa].
        nu: Poisson's ratio [-].

    Raises:
        ValueError: E or nu out of range, see `lame_parameters`.
    """

    E: float
    nu: float

    formula: ClassVar[str] = ""
    description: ClassVar[str] = ""

    def __post_init__(self) -> None:
        lame_parameters(self.E, self.nu)

    @property
    def mu(self) -> float:
        """First Lamé parameter μ, the shear modulus [Pa]."""
        return lame_parameters(self.E, self.nu)[0]

    @property
    def lam(self) -> float:
        """Second Lamé parameter λ [Pa]."""
        return lame_parameters(self.E, self.nu)[1]

    def __call__(self, S: Expr) -> Expr:
        """Return Ψ(S) [J/m³] for a symmetric S of shape (d, d)."""
        return self.strain_energy(S, constant(S, self.mu), constant(S, self.lam))

    @abstractmethod
    def strain_energy(self, S: Expr, mu: Expr, lam: Expr) -> Expr:
        """Return Ψ(S) [J/m³] with Lamé parameters [Pa] given as UFL expressions."""

    def with_histories(
        self, msh: mesh.Mesh, degree: int, h: fem.Constant
    ) -> tuple[StrainEnergy, Sequence[History]]:
        """Return Ψ on a mesh, and the history variables in it; here there are none.

        A material that remembers makes its fields here (`forms.point_field`). In 2D its Ψ should
        take stretches of shape (3, 3), too, as `forms.von_mises_stress` asks for. Collective.

        Args:
            msh: The mesh.
            degree: Of the displacement.
            h: Time step [s].
        """
        return self, ()

    @property
    def rest(self) -> tuple[float, float]:
        """Lamé parameters (μ, λ) [Pa] of the Hooke's law that holds for small strains S - I."""
        return self.mu, self.lam

    def __str__(self) -> str:
        return self.formula


def constant(S: Expr, value: float) -> Expr:
    """A number as a constant on the mesh of S, so that its value is not compiled in."""
    return fem.Constant(ufl.domain.extract_unique_domain(S), float(value))


def plane_strain(S: Expr) -> int:
    """Number of principal stretches that are 1 besides those of S: one in 2D, none in 3D."""
    return 3 - int(S.ufl_shape[0])
