r"""Loops of `forms.kernels.displacement` on tetrahedra.

With N = cof F for the stable neo-Hookean material, a function of F itself, and N = R otherwise,

    ∂²Ψ = h 𝕀 + c ∂(cof F) + λ' N ⊗ N + t ∂²f,   ∂²f[δF, δF] = a · T⁻¹ a,

f = tr S_F and a, T as in `forms.kernels.tetrahedron`. The projection uses the eigensystem of Smith,
de Goes and Kim (2019) in F = U Σ Vᵀ: for each pair of directions a twist with the eigenvalue
(ψ_i + ψ_j)/(σ_i + σ_j) and a flip with (ψ_i - ψ_j)/(σ_i - σ_j) = h - c σ_k, ψ_i = ∂Ψ/∂σ_i, and
∂²Ψ/∂σ² on the diagonal. Σ is that of S_F, so that U and V are rotations in inverted cells too.
"""

from __future__ import annotations

import sys

from forms.kernels.cells import AS_RIGID_AS_POSSIBLE, STABLE_NEO_HOOKEAN
from forms.kernels.compile import Array, carray, compiled, local_array
from forms.kernels.dense import clamp, diagonalise
from forms.kernels.loops import displacement_loops
from forms.kernels.tetrahedron import DIMENSION as DIMENSION
from forms.kernels.tetrahedron import (
    Tuple,
    cofactor,
    cross,
    density,
    fill_stretch_moduli,
    full,
    law,
    polar,
    rotation,
    row,
    set_block,
    set_first_vertex,
    sym,
    times,
    transpose,
)
from forms.kernels.tetrahedron import (
    add_stress as add_stress,
)
from forms.kernels.tetrahedron import (
    cell_deformation as cell_deformation,
)


@compiled
def stress(kind: float, mu: float, lam: float, F: Tuple) -> Tuple:
    """The first Piola-Kirchhoff stress ∂Ψ(S_F)/∂F."""
    if kind == STABLE_NEO_HOOKEAN:
        N = cofactor(F)
        c = lam * (F[0] * N[0] + F[1] * N[1] + F[2] * N[2] - 1.0) - mu
        return (
            mu * F[0] + c * N[0],
            mu * F[1] + c * N[1],
            mu * F[2] + c * N[2],
            mu * F[3] + c * N[3],
            mu * F[4] + c * N[4],
            mu * F[5] + c * N[5],
            mu * F[6] + c * N[6],
            mu * F[7] + c * N[7],
            mu * F[8] + c * N[8],
        )
    R = rotation(F)
    tau, _, _, _, _ = law(kind, mu, lam, sym(times(transpose(R), F)))
    return times(R, full(tau))


@compiled
def cell_energy(kind: float, mu: float, lam: float, F: Tuple) -> float:
    """Ψ(S_F) [J/m³]."""
    if kind == STABLE_NEO_HOOKEAN:
        N = cofactor(F)
        J = F[0] * N[0] + F[1] * N[1] + F[2] * N[2]
        squares = 0.0
        for k in range(9):
            squares += F[k] * F[k]
        return mu * (1.0 - J) + 0.5 * lam * (J - 1.0) ** 2 + 0.5 * mu * (squares - 3.0)
    R = rotation(F)
    return density(kind, mu, lam, sym(times(transpose(R), F)))


@compiled
def set_neo_hookean(mu: float, lam: float, F: Tuple, volume: float, g: Tuple, A: Array) -> None:
    """The exact matrix without a rotation: ∂J/∂u = cof F ∇N, ∂²J/∂u∂u' = -[F (∇N × ∇N')]ₓ."""
    N = cofactor(F)
    c = volume * (lam * (F[0] * N[0] + F[1] * N[1] + F[2] * N[2] - 1.0) - mu)
    n = times(g, transpose(N))  # rows N ∇N_a
    for b in range(3):
        for a in range(b + 1):
            p, q = row(g, a), row(g, b)
            h = volume * mu * (p[0] * q[0] + p[1] * q[1] + p[2] * q[2])
            v = cross(p, q)
            y0 = c * (F[0] * v[0] + F[1] * v[1] + F[2] * v[2])
            y1 = c * (F[3] * v[0] + F[4] * v[1] + F[5] * v[2])
            y2 = c * (F[6] * v[0] + F[7] * v[1] + F[8] * v[2])
            m = volume * lam * n[3 * a], volume * lam * n[3 * a + 1], volume * lam * n[3 * a + 2]
            k = row(n, b)
            K = (
                h + m[0] * k[0],
                m[0] * k[1] + y2,
                m[0] * k[2] - y1,
                m[1] * k[0] - y2,
                h + m[1] * k[1],
                m[1] * k[2] + y0,
                m[2] * k[0] + y1,
                m[2] * k[1] - y0,
                h + m[2] * k[2],
            )
            set_block(K, a, b, A)
    set_first_vertex(A)


@compiled
def set_rotated(
    kind: float, mu: float, lam: float, F: Tuple, volume: float, g: Tuple, A: Array
) -> None:
    """The exact matrix of h 𝕀 + λ' R ⊗ R + t ∂²f, block by block in the rotated frame."""
    R, s, T_inverse = polar(F)
    if kind == AS_RIGID_AS_POSSIBLE:
        lam = 0.0
    t = volume * (lam * (s[0] + s[2] + s[5] - 3.0) - 2.0 * mu)
    Rt, T = transpose(R), full(T_inverse)
    for b in range(3):
        q = row(g, b)
        spin = (0.0, -t * q[2], t * q[1], t * q[2], 0.0, -t * q[0], -t * q[1], t * q[0], 0.0)
        G = times(T, spin)
        for a in range(b + 1):
            p = row(g, a)
            h = volume * 2.0 * mu * (p[0] * q[0] + p[1] * q[1] + p[2] * q[2])
            m = volume * lam * p[0], volume * lam * p[1], volume * lam * p[2]
            K = times((0.0, p[2], -p[1], -p[2], 0.0, p[0], p[1], -p[0], 0.0), G)
            K = (
                K[0] + m[0] * q[0],
                K[1] + m[0] * q[1],
                K[2] + m[0] * q[2],
                K[3] + m[1] * q[0],
                K[4] + m[1] * q[1],
                K[5] + m[1] * q[2],
                K[6] + m[2] * q[0],
                K[7] + m[2] * q[1],
                K[8] + m[2] * q[2],
            )
            K = times(R, times(K, Rt))
            set_block((K[0] + h, K[1], K[2], K[3], K[4] + h, K[5], K[6], K[7], K[8] + h), a, b, A)
    set_first_vertex(A)


@compiled
def half_sum_difference(twist: float, flip: float) -> tuple[float, float]:
    """The moduli of δF_ij² and of δF_ij δF_ji from the eigenvalues, negative ones as zero."""
    # Written so that a NaN stays one.
    twist = 0.0 if twist < 0.0 else twist
    flip = 0.0 if flip < 0.0 else flip
    return 0.5 * (flip + twist), 0.5 * (flip - twist)


@compiled
def set_projected(
    kind: float, mu: float, lam: float, F: Tuple, volume: float, g: Tuple, A: Array
) -> None:
    """The matrix of the tangent with its negative eigenvalues raised to zero."""
    S = carray(local_array(9), (3, 3))
    V = carray(local_array(9), (3, 3))
    M = carray(local_array(9), (3, 3))
    W = carray(local_array(9), (3, 3))
    work = carray(local_array(9), (3, 3))
    R = rotation(F)
    sF = full(sym(times(transpose(R), F)))
    for i in range(3):
        for j in range(3):
            S[i, j] = sF[3 * i + j]
    diagonalise(S, V)
    s0, s1, s2 = S[0, 0], S[1, 1], S[2, 2]
    tau, h, c, lam, N = law(kind, mu, lam, (s0, 0.0, s1, 0.0, 0.0, s2))
    fill_stretch_moduli(h, c, lam, (N[0], N[2], N[5]), (s0, s1, s2), M)
    clamp(M, work, W)
    d01, o01 = half_sum_difference((tau[0] + tau[2]) / (s0 + s1), h - c * s2)
    d02, o02 = half_sum_difference((tau[0] + tau[5]) / (s0 + s2), h - c * s1)
    d12, o12 = half_sum_difference((tau[2] + tau[5]) / (s1 + s2), h - c * s0)
    v = (V[0, 0], V[0, 1], V[0, 2], V[1, 0], V[1, 1], V[1, 2], V[2, 0], V[2, 1], V[2, 2])
    U, gv = times(R, v), times(g, v)
    Ut = transpose(U)
    for b in range(3):
        q = row(gv, b)
        for a in range(b + 1):
            p = row(gv, a)
            p = volume * p[0], volume * p[1], volume * p[2]
            K = (
                M[0, 0] * p[0] * q[0] + d01 * p[1] * q[1] + d02 * p[2] * q[2],
                M[0, 1] * p[0] * q[1] + o01 * p[1] * q[0],
                M[0, 2] * p[0] * q[2] + o02 * p[2] * q[0],
                M[0, 1] * p[1] * q[0] + o01 * p[0] * q[1],
                M[1, 1] * p[1] * q[1] + d01 * p[0] * q[0] + d12 * p[2] * q[2],
                M[1, 2] * p[1] * q[2] + o12 * p[2] * q[1],
                M[0, 2] * p[2] * q[0] + o02 * p[0] * q[2],
                M[1, 2] * p[2] * q[1] + o12 * p[1] * q[2],
                M[2, 2] * p[2] * q[2] + d02 * p[0] * q[0] + d12 * p[1] * q[1],
            )
            set_block(times(U, times(K, Ut)), a, b, A)
    set_first_vertex(A)


@compiled
def set_matrix(
    volume: float,
    g: Tuple,
    F: Tuple,
    material: tuple[float, float, float],
    projected: bool,
    A: Array,
) -> None:
    """A cell's tangent matrix."""
    kind, mu, lam = material
    if projected:
        set_projected(kind, mu, lam, F, volume, g, A)
    elif kind == STABLE_NEO_HOOKEAN:
        set_neo_hookean(mu, lam, F, volume, g, A)
    else:
        set_rotated(kind, mu, lam, F, volume, g, A)


residual, matrix, energy = displacement_loops(sys.modules[__name__])
