"""Kinematics in UFL."""

from __future__ import annotations

import ufl
from ufl.core.expr import Expr


def deformation_gradient(u: Expr) -> Expr:
    """Return the deformation gradient F = ∂x/∂X = I + ∂u/∂X, shape (d, d)."""
    return ufl.Identity(len(u)) + ufl.grad(u)
