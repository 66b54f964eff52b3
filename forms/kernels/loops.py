"""Loops over the owned cells, the same in 2D and 3D.

`cell` is a module with the functions of one cell, and `tangent` one with its `set_matrix`. They are
modules since numba would not find a loop in its cache that closes over compiled functions. Rows of
the material are (kind, μ, λ).
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from forms.kernels.compile import Array, Ints, carray, cell_loop, compiled, local_array

Loop = Callable[..., float | None]


@compiled
def add_blocks(A: Array, d: int, places: Any, blocks: Array) -> None:
    """Add the d × d blocks of a cell's matrix to those at its places."""
    for a in range(d + 1):
        for b in range(d + 1):
            place = places[(d + 1) * a + b]
            for i in range(d):
                for j in range(d):
                    blocks[place, d * i + j] += A[d * a + i, d * b + j]


def symmetric_loops(cell: ModuleType, tangent: ModuleType) -> tuple[Loop, ...]:
    """Kinematics, residual, matrix, elimination, recovery and energy, see `SymmetricKernel`."""
    d: int = cell.DIMENSION
    size, entries = d * (d + 1), (d * (d + 1)) ** 2

    @cell_loop
    def kinematics(geometry_dofs: Ints, x: Array, u_dofs: Ints, u: Array, known: Array) -> None:
        """Set what depends on the displacement alone: volume, ∇N, R, S_F and T⁻¹."""
        for k in range(len(known)):
            volume, g, F = cell.cell_deformation(geometry_dofs[k], x, u_dofs[k], u)
            cell.keep(known, k, volume, g, cell.polar(F))

    @cell_loop
    def residual(
        known: Array,
        u_dofs: Ints,
        S_dofs: Ints,
        S: Array,
        Y_dofs: Ints,
        Y: Array,
        material: Array,
        r_u: Array,
        r_S: Array,
        r_Y: Array,
    ) -> None:
        """Add the derivatives of Ψ(S) - Y : S + Y : S_F with respect to u, S and Y."""
        for k in range(len(material)):
            volume, g, (R, s_F, T_inverse) = cell.kept(known, k)
            i, j = S_dofs[k, 0], Y_dofs[k, 0]
            s, y = cell.symmetric_dofs(S, i), cell.symmetric_dofs(Y, j)
            stress, _, _, _, _ = cell.law(material[k, 0], material[k, 1], material[k, 2], s)
            cell.add_stress(
                cell.times(R, cell.pulled(s_F, T_inverse, y)), volume, g, u_dofs[k], r_u
            )
            cell.add_dual(r_S, i, volume, stress, y)
            cell.add_dual(r_Y, j, volume, s_F, s)

    @cell_loop
    def matrix(
        known: Array,
        u_dofs: Ints,
        S_dofs: Ints,
        S: Array,
        Y_dofs: Ints,
        Y: Array,
        material: Array,
        projected: bool,
        places: Ints,
        blocks: Array,
    ) -> None:
        """Add ∂Sᵀ H ∂S + Y : ∂²S."""
        A = carray(local_array(entries), (size, size))
        for k in range(len(material)):
            volume, g, polar = cell.kept(known, k)
            s, y = cell.symmetric_dofs(S, S_dofs[k, 0]), cell.symmetric_dofs(Y, Y_dofs[k, 0])
            parameters = material[k, 0], material[k, 1], material[k, 2]
            tangent.set_matrix(volume, g, polar, s, y, parameters, projected, A)
            add_blocks(A, d, places[k], blocks)

    @cell_loop
    def eliminate(
        known: Array,
        u_dofs: Ints,
        S_dofs: Ints,
        S: Array,
        Y_dofs: Ints,
        material: Array,
        b_S: Array,
        b_Y: Array,
        b_u: Array,
    ) -> None:
        """Add ∂Sᵀ (b_S + H w⁻¹ b_Y) to b_u."""
        for k in range(len(material)):
            _, g, (R, s_F, T_inverse) = cell.kept(known, k)
            i, j = S_dofs[k, 0], Y_dofs[k, 0]
            s = cell.symmetric_dofs(S, i)
            _, h, c, lam, N = cell.law(material[k, 0], material[k, 1], material[k, 2], s)
            p, q = (
                cell.from_dual(b_S, i, 1.0),
                cell.stress_change(s, h, c, lam, N, cell.from_dual(b_Y, j, 1.0)),
            )
            X = cell.combined(p, 1.0, q)
            cell.add_stress(cell.times(R, cell.pulled(s_F, T_inverse, X)), 1.0, g, u_dofs[k], b_u)

    @cell_loop
    def recover(
        known: Array,
        u_dofs: Ints,
        S_dofs: Ints,
        S: Array,
        Y_dofs: Ints,
        material: Array,
        b_S: Array,
        b_Y: Array,
        du: Array,
        dS: Array,
        dY: Array,
    ) -> None:
        """Set δs = ∂S δF - (V w)⁻¹ b_Y and δy = w⁻¹ (H δs - V⁻¹ b_S)."""
        for k in range(len(material)):
            volume, g, (R, s_F, T_inverse) = cell.kept(known, k)
            i, j = S_dofs[k, 0], Y_dofs[k, 0]
            s = cell.symmetric_dofs(S, i)
            _, h, c, lam, N = cell.law(material[k, 0], material[k, 1], material[k, 2], s)
            dF = cell.displacement_gradient(cell.vertex_differences(u_dofs[k], du), g)
            ds, p = cell.stretch_change(R, s_F, T_inverse, dF), cell.from_dual(b_Y, j, 1.0 / volume)
            ds = cell.combined(ds, -1.0, p)
            dy, q = cell.stress_change(s, h, c, lam, N, ds), cell.from_dual(b_S, i, 1.0 / volume)
            for m in range(len(ds)):
                dS[i, m] = ds[m]
                dY[j, m] = dy[m] - q[m]

    @cell_loop
    def energy(geometry_dofs: Ints, x: Array, S_dofs: Ints, S: Array, material: Array) -> float:
        """∫ Ψ(S) over the cells."""
        total = 0.0
        for k in range(len(material)):
            volume, _ = cell.geometry(cell.vertex_differences(geometry_dofs[k], x))
            s = cell.symmetric_dofs(S, S_dofs[k, 0])
            total += volume * cell.density(material[k, 0], material[k, 1], material[k, 2], s)
        return total

    return kinematics, residual, matrix, eliminate, recover, energy


def displacement_loops(cell: ModuleType) -> tuple[Loop, ...]:
    """Residual, matrix and energy, see `DisplacementKernel`."""
    d: int = cell.DIMENSION
    size, entries = d * (d + 1), (d * (d + 1)) ** 2

    @cell_loop
    def residual(
        geometry_dofs: Ints, x: Array, u_dofs: Ints, u: Array, material: Array, r_u: Array
    ) -> None:
        """Add the derivative of ∫ Ψ(S_F)."""
        for k in range(len(material)):
            volume, g, F = cell.cell_deformation(geometry_dofs[k], x, u_dofs[k], u)
            P = cell.stress(material[k, 0], material[k, 1], material[k, 2], F)
            cell.add_stress(P, volume, g, u_dofs[k], r_u)

    @cell_loop
    def matrix(
        geometry_dofs: Ints,
        x: Array,
        u_dofs: Ints,
        u: Array,
        material: Array,
        projected: bool,
        places: Ints,
        blocks: Array,
    ) -> None:
        """Add the second derivative of ∫ Ψ(S_F)."""
        A = carray(local_array(entries), (size, size))
        for k in range(len(material)):
            volume, g, F = cell.cell_deformation(geometry_dofs[k], x, u_dofs[k], u)
            parameters = material[k, 0], material[k, 1], material[k, 2]
            cell.set_matrix(volume, g, F, parameters, projected, A)
            add_blocks(A, d, places[k], blocks)

    @cell_loop
    def energy(geometry_dofs: Ints, x: Array, u_dofs: Ints, u: Array, material: Array) -> float:
        """∫ Ψ(S_F) over the cells."""
        total = 0.0
        for k in range(len(material)):
            volume, _, F = cell.cell_deformation(geometry_dofs[k], x, u_dofs[k], u)
            total += volume * cell.cell_energy(material[k, 0], material[k, 1], material[k, 2], F)
        return total

    return residual, matrix, energy
