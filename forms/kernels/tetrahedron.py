r"""Per-cell kernels on linear tetrahedra with one point of integration, compiled by numba.

Matrices are tuples: 9 entries row by row, or the 6 dofs 00, 10, 11, 20, 21, 22 of a symmetric
matrix. A *dual* of a symmetric X is (B_k : X)_k with the basis B_k of these dofs, so that its
off-diagonal entries count twice. In what follows [ω]ₓ y = ω × y and S_F = RᵀF.

**Rotation.** f = tr S_F is the largest root of

    P(f) = f⁴ - 2 I₁ f² - 8 J f + 2 tr C² - I₁²,   C = FᵀF, I₁ = tr C, J = det F,

and R = (f² F + 2 f cof F - 2 F C + I₁ F) / (f³ - I₁ f - 2 J). Newton's method from √(3 I₁) ≥ f
falls monotonically to it, since all four roots are real. The coefficients of P cancel in a
stretched cell, so one step on the rotation itself takes away what they lose: orthogonality by
Newton-Schulz, then the spin ω of (1) below that makes RᵀF symmetric.

**First derivatives.** With A = RᵀδF, T = (tr S_F) I - S_F and δR = R [ω]ₓ,

    T ω = a = axial(A - Aᵀ),   δS = sym A - sym([ω]ₓ S_F).                                    (1)

The gradient of X : S_F for a symmetric X is R D, D = X + [c]ₓ with T c = axial(S_F X - X S_F).

**Second derivative.** Let Z S_F + S_F Z = Y. From Y : ∂²S[δF, δF] = 2 Z : (δFᵀδF - δS δS) and
A = δS + [ω]ₓ S_F,

    Y : ∂²S[δF, δF] = 2 δS : sym([ω]ₓ D) + ω · ((tr M) I - M) ω,   M = sym(D S_F),           (2)

D = Y + [c]ₓ as above, for 2 S_F Z = D: unlike Z, D exists when a singular value vanishes. So all
of the condensed tangent ∂Sᵀ H ∂S + Y : ∂²S is one quadratic form of (δS, ω). With the dofs e of
sym A, δs = e - Q ω, and (2) written 2 δs · B ω + ω · M' ω, its blocks in (e, a) are

    H,   X = (B - H Q) T⁻¹,   T⁻¹ (M' - QᵀB - BᵀQ + QᵀH Q) T⁻¹.                             (3)

**Projection.** The form (3) is the sum of H on e + H⁻¹X a and of the 3×3 matrix N - XᵀH⁻¹X, its
last block less what belongs to H, on the spin a. It is positive semi-definite where both are. So

    [H⁺, X⁺; X⁺ᵀ, P + (N - P)⁺],   P = X⁺ᵀ (H⁺)⁻¹ X⁺,                                        (4)

is, and equals (3) where that is. ( )⁺ raises negative eigenvalues to zero. Those of H are known in
the eigenvectors of S: three shears and the 3×3 matrix ∂²Ψ/∂σ². X⁺ leaves out eigenvectors of H⁺
that are too soft to divide by. At Y = Ψ'(S), S = S_F, X vanishes: (4) is the projected tangent of
Ψ(S_F) (B. Smith, F. de Goes, T. Kim, Analytic Eigensystems for Isotropic Distortion Energies, ACM
Trans. Graph. 38, 2019), and the nearest such matrix.
"""

from __future__ import annotations

import math

from forms.kernels.cells import AS_RIGID_AS_POSSIBLE, COROTATIONAL, STABLE_NEO_HOOKEAN
from forms.kernels.compile import Array, Ints, carray, compiled, local_array
from forms.kernels.dense import clamp, diagonalise, is_positive

Tuple = tuple[float, ...]

DIMENSION = 3
KEPT = 31
"""Numbers that `keep` keeps of a cell."""

SOFT = 0.01
"""Eigenvalues of H below this part of h keep no coupling to the spin when projected."""
ROOT = math.sqrt(2.0)


# Matrices


@compiled
def times(A: Tuple, B: Tuple) -> Tuple:
    """A B."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@compiled
def combined(s: Tuple, factor: float, t: Tuple) -> Tuple:
    """The dofs s + factor t."""
    return (
        s[0] + factor * t[0],
        s[1] + factor * t[1],
        s[2] + factor * t[2],
        s[3] + factor * t[3],
        s[4] + factor * t[4],
        s[5] + factor * t[5],
    )


@compiled
def scaled(factor: float, s: Tuple) -> Tuple:
    """The dofs factor s."""
    return (
        factor * s[0],
        factor * s[1],
        factor * s[2],
        factor * s[3],
        factor * s[4],
        factor * s[5],
    )


@compiled
def transpose(A: Tuple) -> Tuple:
    """Aᵀ."""
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


@compiled
def sym(A: Tuple) -> Tuple:
    """The dofs of (A + Aᵀ) / 2."""
    return (
        A[0],
        0.5 * (A[1] + A[3]),
        A[4],
        0.5 * (A[2] + A[6]),
        0.5 * (A[5] + A[7]),
        A[8],
    )


@compiled
def full(s: Tuple) -> Tuple:
    """The symmetric matrix with dofs s."""
    return (s[0], s[1], s[3], s[1], s[2], s[4], s[3], s[4], s[5])


@compiled
def apply(s: Tuple, v: Tuple) -> Tuple:
    """The symmetric matrix with dofs s times a vector."""
    return (
        s[0] * v[0] + s[1] * v[1] + s[3] * v[2],
        s[1] * v[0] + s[2] * v[1] + s[4] * v[2],
        s[3] * v[0] + s[4] * v[1] + s[5] * v[2],
    )


@compiled
def cofactor(A: Tuple) -> Tuple:
    """The cofactor matrix, the derivative of det A."""
    return (
        A[4] * A[8] - A[5] * A[7],
        A[5] * A[6] - A[3] * A[8],
        A[3] * A[7] - A[4] * A[6],
        A[2] * A[7] - A[1] * A[8],
        A[0] * A[8] - A[2] * A[6],
        A[1] * A[6] - A[0] * A[7],
        A[1] * A[5] - A[2] * A[4],
        A[2] * A[3] - A[0] * A[5],
        A[0] * A[4] - A[1] * A[3],
    )


@compiled
def axial(A: Tuple) -> Tuple:
    """The vector w with [w]ₓ = A - Aᵀ."""
    return (A[7] - A[5], A[2] - A[6], A[3] - A[1])


@compiled
def cross(v: Tuple, w: Tuple) -> Tuple:
    """The product v × w."""
    return (v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0])


@compiled
def row(A: Tuple, i: int) -> Tuple:
    """Row i."""
    return (A[3 * i], A[3 * i + 1], A[3 * i + 2])


# Kinematics


@compiled
def differences(x: Array, i: int, j: int, k: int, m: int) -> Tuple:
    """Rows x_j - x_i, x_k - x_i, x_m - x_i of vectors at the vertices."""
    return (
        x[j, 0] - x[i, 0],
        x[j, 1] - x[i, 1],
        x[j, 2] - x[i, 2],
        x[k, 0] - x[i, 0],
        x[k, 1] - x[i, 1],
        x[k, 2] - x[i, 2],
        x[m, 0] - x[i, 0],
        x[m, 1] - x[i, 1],
        x[m, 2] - x[i, 2],
    )


@compiled
def geometry(edges: Tuple) -> tuple[float, Tuple]:
    """The volume, and the gradients of the last three hat functions as rows."""
    cof = cofactor(edges)
    det = edges[0] * cof[0] + edges[1] * cof[1] + edges[2] * cof[2]
    inverse = 1.0 / det
    g = (
        cof[0] * inverse,
        cof[1] * inverse,
        cof[2] * inverse,
        cof[3] * inverse,
        cof[4] * inverse,
        cof[5] * inverse,
        cof[6] * inverse,
        cof[7] * inverse,
        cof[8] * inverse,
    )
    return abs(det) / 6.0, g


@compiled
def displacement_gradient(du: Tuple, g: Tuple) -> Tuple:
    """∂u/∂X from differences of displacements."""
    return times(transpose(du), g)


@compiled
def plus_identity(A: Tuple) -> Tuple:
    """A + I."""
    return (A[0] + 1.0, A[1], A[2], A[3], A[4] + 1.0, A[5], A[6], A[7], A[8] + 1.0)


@compiled
def spin_inverse(s: Tuple) -> Tuple:
    """The dofs of T⁻¹, T = (tr S) I - S."""
    t0, t2, t5 = s[2] + s[5], s[0] + s[5], s[0] + s[2]
    t1, t3, t4 = -s[1], -s[3], -s[4]
    c0, c1, c3 = t2 * t5 - t4 * t4, t4 * t3 - t1 * t5, t1 * t4 - t2 * t3
    inverse = 1.0 / (t0 * c0 + t1 * c1 + t3 * c3)
    return (
        c0 * inverse,
        c1 * inverse,
        (t0 * t5 - t3 * t3) * inverse,
        c3 * inverse,
        (t1 * t3 - t0 * t4) * inverse,
        (t0 * t2 - t1 * t1) * inverse,
    )


@compiled
def orthogonalised(R: Tuple) -> Tuple:
    """A step of Newton-Schulz, R (3 I - RᵀR) / 2."""
    X = times(transpose(R), R)
    return times(
        R,
        (
            1.5 - 0.5 * X[0],
            -0.5 * X[1],
            -0.5 * X[2],
            -0.5 * X[3],
            1.5 - 0.5 * X[4],
            -0.5 * X[5],
            -0.5 * X[6],
            -0.5 * X[7],
            1.5 - 0.5 * X[8],
        ),
    )


@compiled
def rotation(F: Tuple) -> Tuple:
    """R in SO(3) with RᵀF symmetric; not finite where σ₂ + σ₃ = 0."""
    C = times(transpose(F), F)
    cof = cofactor(F)
    J = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    I1 = C[0] + C[4] + C[8]
    squares = C[0] ** 2 + C[4] ** 2 + C[8] ** 2 + 2.0 * (C[1] ** 2 + C[2] ** 2 + C[5] ** 2)
    constant = 2.0 * squares - I1 * I1
    f = math.sqrt(3.0 * I1)
    for _ in range(60):
        value = ((f * f - 2.0 * I1) * f - 8.0 * J) * f + constant
        step = value / (4.0 * ((f * f - I1) * f - 2.0 * J))
        f -= step
        if not step > 1e-9 * f:  # also where round-off has turned the step round, or for NaN
            break
    a, b, c = f * f + I1, 2.0 * f, 1.0 / ((f * f - I1) * f - 2.0 * J)
    G = times(F, C)
    R = (
        (a * F[0] + b * cof[0] - 2.0 * G[0]) * c,
        (a * F[1] + b * cof[1] - 2.0 * G[1]) * c,
        (a * F[2] + b * cof[2] - 2.0 * G[2]) * c,
        (a * F[3] + b * cof[3] - 2.0 * G[3]) * c,
        (a * F[4] + b * cof[4] - 2.0 * G[4]) * c,
        (a * F[5] + b * cof[5] - 2.0 * G[5]) * c,
        (a * F[6] + b * cof[6] - 2.0 * G[6]) * c,
        (a * F[7] + b * cof[7] - 2.0 * G[7]) * c,
        (a * F[8] + b * cof[8] - 2.0 * G[8]) * c,
    )
    Q = orthogonalised(R)
    A = times(transpose(Q), F)
    # F = R (I + [ω]ₓ) S: turn by the spin ω, to second order, and make orthogonal again.
    w0, w1, w2 = apply(spin_inverse(sym(A)), axial(A))
    w00, w11, w22 = 0.5 * w0 * w0, 0.5 * w1 * w1, 0.5 * w2 * w2
    w01, w02, w12 = 0.5 * w0 * w1, 0.5 * w0 * w2, 0.5 * w1 * w2
    turn = (
        1.0 - w11 - w22,
        w01 - w2,
        w02 + w1,
        w01 + w2,
        1.0 - w00 - w22,
        w12 - w0,
        w02 - w1,
        w12 + w0,
        1.0 - w00 - w11,
    )
    return orthogonalised(times(Q, turn))


@compiled
def polar(F: Tuple) -> tuple[Tuple, Tuple, Tuple]:
    """R, the dofs of S_F = RᵀF and those of T⁻¹."""
    R = rotation(F)
    s = sym(times(transpose(R), F))
    return R, s, spin_inverse(s)


@compiled
def pulled(s: Tuple, T_inverse: Tuple, X: Tuple) -> Tuple:
    """D = X + [c]ₓ, with R D the gradient of X : S_F; X in dofs."""
    # S X - X S = S X - (S X)ᵀ
    c = apply(T_inverse, axial(times(full(s), full(X))))
    return (
        X[0],
        X[1] - c[2],
        X[3] + c[1],
        X[1] + c[2],
        X[2],
        X[4] - c[0],
        X[3] - c[1],
        X[4] + c[0],
        X[5],
    )


@compiled
def stretch_change(R: Tuple, s: Tuple, T_inverse: Tuple, dF: Tuple) -> Tuple:
    """The dofs of δS (1)."""
    A = times(transpose(R), dF)
    w = apply(T_inverse, axial(A))
    spin = (0.0, -w[2], w[1], w[2], 0.0, -w[0], -w[1], w[0], 0.0)
    return combined(sym(A), -1.0, sym(times(spin, full(s))))


# Materials. All three have ∂²Ψ/∂S² = h 𝕀 + c ∂(cof S)/∂S + λ' N ⊗ N.


@compiled
def density(kind: float, mu: float, lam: float, s: Tuple) -> float:
    """Ψ(S) [J/m³]."""
    trace = s[0] + s[2] + s[5]
    squares = s[0] ** 2 + s[2] ** 2 + s[5] ** 2 + 2.0 * (s[1] ** 2 + s[3] ** 2 + s[4] ** 2)
    if kind == STABLE_NEO_HOOKEAN:
        J = (
            s[0] * (s[2] * s[5] - s[4] ** 2)
            + s[1] * (s[4] * s[3] - s[1] * s[5])
            + s[3] * (s[1] * s[4] - s[2] * s[3])
        )
        return mu * (1.0 - J) + 0.5 * lam * (J - 1.0) ** 2 + 0.5 * mu * (squares - 3.0)
    energy = mu * (squares - 2.0 * trace + 3.0)
    if kind == COROTATIONAL:
        energy += 0.5 * lam * (trace - 3.0) ** 2
    return energy


@compiled
def law(kind: float, mu: float, lam: float, s: Tuple) -> tuple[Tuple, float, float, float, Tuple]:
    """The dofs of ∂Ψ/∂S, then h, c, λ' and the dofs of N."""
    if kind == STABLE_NEO_HOOKEAN:
        N = (
            s[2] * s[5] - s[4] * s[4],
            s[4] * s[3] - s[1] * s[5],
            s[0] * s[5] - s[3] * s[3],
            s[1] * s[4] - s[2] * s[3],
            s[1] * s[3] - s[0] * s[4],
            s[0] * s[2] - s[1] * s[1],
        )
        c = lam * (s[0] * N[0] + s[1] * N[1] + s[3] * N[3] - 1.0) - mu
        stress = (
            mu * s[0] + c * N[0],
            mu * s[1] + c * N[1],
            mu * s[2] + c * N[2],
            mu * s[3] + c * N[3],
            mu * s[4] + c * N[4],
            mu * s[5] + c * N[5],
        )
        return stress, mu, c, lam, N
    if kind == AS_RIGID_AS_POSSIBLE:
        lam = 0.0
    pressure = lam * (s[0] + s[2] + s[5] - 3.0)
    stress = (
        2.0 * mu * (s[0] - 1.0) + pressure,
        2.0 * mu * s[1],
        2.0 * mu * (s[2] - 1.0) + pressure,
        2.0 * mu * s[3],
        2.0 * mu * s[4],
        2.0 * mu * (s[5] - 1.0) + pressure,
    )
    return stress, 2.0 * mu, 0.0, lam, (1.0, 0.0, 1.0, 0.0, 0.0, 1.0)


@compiled
def stress_change(s: Tuple, h: float, c: float, lam: float, N: Tuple, ds: Tuple) -> Tuple:
    """The dofs of ∂²Ψ/∂S² δS."""
    inner = lam * (
        N[0] * ds[0]
        + N[2] * ds[2]
        + N[5] * ds[5]
        + 2.0 * (N[1] * ds[1] + N[3] * ds[3] + N[4] * ds[4])
    )
    return (
        h * ds[0] + inner * N[0] + c * (s[5] * ds[2] + s[2] * ds[5] - 2.0 * s[4] * ds[4]),
        h * ds[1] + inner * N[1] + c * (s[4] * ds[3] + s[3] * ds[4] - s[5] * ds[1] - s[1] * ds[5]),
        h * ds[2] + inner * N[2] + c * (s[5] * ds[0] + s[0] * ds[5] - 2.0 * s[3] * ds[3]),
        h * ds[3] + inner * N[3] + c * (s[4] * ds[1] + s[1] * ds[4] - s[2] * ds[3] - s[3] * ds[2]),
        h * ds[4] + inner * N[4] + c * (s[3] * ds[1] + s[1] * ds[3] - s[0] * ds[4] - s[4] * ds[0]),
        h * ds[5] + inner * N[5] + c * (s[0] * ds[2] + s[2] * ds[0] - 2.0 * s[1] * ds[1]),
    )


@compiled
def couple(H: Array, i: int, j: int, value: float) -> None:
    """Add to an entry off the diagonal and to its mirror image."""
    H[i, j] += value
    H[j, i] += value


@compiled
def fill_hessian(s: Tuple, h: float, c: float, lam: float, N: Tuple, H: Array) -> None:
    """The dual Hessian ∂²Ψ/∂s² into H[:6, :6]."""
    n = (N[0], 2.0 * N[1], N[2], 2.0 * N[3], 2.0 * N[4], N[5])
    for i in range(6):
        for j in range(6):
            H[i, j] = lam * n[i] * n[j]
    # h times B_i : B_j, and c times the second derivative of det S
    H[0, 0] += h
    H[2, 2] += h
    H[5, 5] += h
    H[1, 1] += 2.0 * (h - c * s[5])
    H[3, 3] += 2.0 * (h - c * s[2])
    H[4, 4] += 2.0 * (h - c * s[0])
    couple(H, 0, 2, c * s[5])
    couple(H, 0, 5, c * s[2])
    couple(H, 2, 5, c * s[0])
    couple(H, 0, 4, -2.0 * c * s[4])
    couple(H, 2, 3, -2.0 * c * s[3])
    couple(H, 1, 5, -2.0 * c * s[1])
    couple(H, 1, 4, 2.0 * c * s[3])
    couple(H, 1, 3, 2.0 * c * s[4])
    couple(H, 3, 4, 2.0 * c * s[1])


# Tangents


@compiled
def fill_spin_stretch(D: Tuple, Q: Array) -> None:
    """The dofs of sym([ω]ₓ D) into Q[:6, :3], a column for each component of ω."""
    Q[0, 0], Q[1, 0], Q[2, 0] = 0.0, -0.5 * D[6], -D[7]
    Q[3, 0], Q[4, 0], Q[5, 0] = 0.5 * D[3], 0.5 * (D[4] - D[8]), D[5]
    Q[0, 1], Q[1, 1], Q[2, 1] = D[6], 0.5 * D[7], 0.0
    Q[3, 1], Q[4, 1], Q[5, 1] = 0.5 * (D[8] - D[0]), -0.5 * D[1], -D[2]
    Q[0, 2], Q[1, 2], Q[2, 2] = -D[3], 0.5 * (D[0] - D[4]), D[1]
    Q[3, 2], Q[4, 2], Q[5, 2] = -0.5 * D[5], 0.5 * D[2], 0.0


@compiled
def fill_blocks(
    s_F: Tuple,
    T_inverse: Tuple,
    Y: Tuple,
    s: Tuple,
    modulus: tuple[float, float, float, Tuple],
    C: Array,
) -> None:
    """∂Sᵀ H ∂S + Y : ∂²S as a symmetric matrix on (e, a) (3) into C[:9, :9]."""
    Q = carray(local_array(18), (6, 3))
    B = carray(local_array(18), (6, 3))
    X = carray(local_array(18), (6, 3))
    N = carray(local_array(9), (3, 3))
    h, c, lam, normal = modulus
    fill_hessian(s, h, c, lam, normal, C)
    fill_spin_stretch(full(s_F), Q)
    D = pulled(s_F, T_inverse, Y)
    fill_spin_stretch(D, B)
    for j in range(3):
        B[1, j] *= 2.0
        B[3, j] *= 2.0
        B[4, j] *= 2.0
    m = sym(times(D, full(s_F)))
    N[0, 0], N[1, 1], N[2, 2] = m[2] + m[5], m[0] + m[5], m[0] + m[2]
    N[1, 0], N[2, 0], N[2, 1] = -m[1], -m[3], -m[4]
    for i in range(6):
        for j in range(3):
            value = B[i, j]
            for k in range(6):
                value -= C[i, k] * Q[k, j]
            X[i, j] = value
    # N - QᵀB - (B - H Q)ᵀ Q
    for i in range(3):
        for j in range(i + 1):
            for k in range(6):
                N[i, j] -= Q[k, i] * B[k, j] + X[k, i] * Q[k, j]
            N[j, i] = N[i, j]
    for i in range(6):
        v = apply(T_inverse, (X[i, 0], X[i, 1], X[i, 2]))
        C[i, 6], C[i, 7], C[i, 8] = v
        C[6, i], C[7, i], C[8, i] = v
    for j in range(3):
        N[0, j], N[1, j], N[2, j] = apply(T_inverse, (N[0, j], N[1, j], N[2, j]))
    for i in range(3):
        C[6 + i, 6], C[6 + i, 7], C[6 + i, 8] = apply(T_inverse, (N[i, 0], N[i, 1], N[i, 2]))


@compiled
def fill_stretch_moduli(h: float, c: float, lam: float, n: Tuple, sigma: Tuple, A: Array) -> None:
    """∂²Ψ/∂σ² at principal stretches σ into A[:3, :3], with the principal values n of N."""
    for i in range(3):
        for j in range(3):
            A[i, j] = lam * n[i] * n[j]
        A[i, i] += h
    couple(A, 0, 1, c * sigma[2])
    couple(A, 0, 2, c * sigma[1])
    couple(A, 1, 2, c * sigma[0])


@compiled
def dyad(V: Array, i: int, j: int) -> Tuple:
    """The dofs of sym(v_i v_jᵀ), v_i column i of V."""
    return (
        V[0, i] * V[0, j],
        0.5 * (V[0, i] * V[1, j] + V[1, i] * V[0, j]),
        V[1, i] * V[1, j],
        0.5 * (V[0, i] * V[2, j] + V[2, i] * V[0, j]),
        0.5 * (V[1, i] * V[2, j] + V[2, i] * V[1, j]),
        V[2, i] * V[2, j],
    )


@compiled
def add_mode(eta: float, floor: float, e: Tuple, X: Array, C: Array, P: Array) -> None:
    """Put a unit eigenvector e of H back, without its coupling X to the spin below the floor."""
    if not eta > 0.0:
        return
    n = (e[0], 2.0 * e[1], e[2], 2.0 * e[3], 2.0 * e[4], e[5])
    for i in range(6):
        for j in range(6):
            C[i, j] += eta * n[i] * n[j]
    if eta > floor:
        x0, x1, x2 = 0.0, 0.0, 0.0
        for k in range(6):
            x0 += e[k] * X[k, 0]
            x1 += e[k] * X[k, 1]
            x2 += e[k] * X[k, 2]
        for k in range(6):
            C[k, 6] += n[k] * x0
            C[k, 7] += n[k] * x1
            C[k, 8] += n[k] * x2
        x = (x0, x1, x2)
        for i in range(3):
            for j in range(3):
                P[i, j] += x[i] * x[j] / eta


@compiled
def project(s: Tuple, h: float, c: float, lam: float, normal: Tuple, C: Array) -> None:
    """Make the tangent on (e, a) positive semi-definite, see (4)."""
    X = carray(local_array(18), (6, 3))
    P = carray(local_array(9), (3, 3))
    N = carray(local_array(9), (3, 3))
    L = carray(local_array(36), (6, 6))
    for i in range(6):
        for j in range(3):
            X[i, j] = C[i, 6 + j]
    regular = is_positive(C[:6, :6], L)
    if regular:
        for j in range(3):
            for i in range(6):
                for k in range(i):
                    X[i, j] -= L[i, k] * X[k, j]
                X[i, j] /= L[i, i]
        for i in range(3):
            for j in range(3):
                P[i, j] = 0.0
                for k in range(6):
                    P[i, j] += X[k, i] * X[k, j]
                N[i, j] = C[6 + i, 6 + j] - P[i, j]
        if is_positive(N, L):
            return
    if c != 0.0 or not regular:
        soften(s, h, c, lam, normal, C, P)
    for i in range(3):
        for j in range(3):
            N[i, j] = C[6 + i, 6 + j] - P[i, j]
    work = carray(local_array(9), (3, 3))
    V = carray(local_array(9), (3, 3))
    clamp(N, work, V)
    for i in range(3):
        for j in range(3):
            C[6 + i, 6 + j] = N[i, j] + P[i, j]


@compiled
def soften(s: Tuple, h: float, c: float, lam: float, normal: Tuple, C: Array, P: Array) -> None:
    """Replace H and X in C by H⁺ and X⁺ (4), and set P = X⁺ᵀ H⁺⁻¹ X⁺."""
    S = carray(local_array(9), (3, 3))
    V = carray(local_array(9), (3, 3))
    A = carray(local_array(9), (3, 3))
    W = carray(local_array(9), (3, 3))
    X = carray(local_array(18), (6, 3))
    fs, N = full(s), full(normal)
    for i in range(3):
        for j in range(3):
            S[i, j] = fs[3 * i + j]
            P[i, j] = 0.0
    diagonalise(S, V)
    n0, n1, n2 = 0.0, 0.0, 0.0
    for i in range(3):
        for j in range(3):
            n0 += V[i, 0] * N[3 * i + j] * V[j, 0]
            n1 += V[i, 1] * N[3 * i + j] * V[j, 1]
            n2 += V[i, 2] * N[3 * i + j] * V[j, 2]
    fill_stretch_moduli(h, c, lam, (n0, n1, n2), (S[0, 0], S[1, 1], S[2, 2]), A)
    diagonalise(A, W)
    for i in range(6):
        for j in range(6):
            C[i, j] = 0.0
        for j in range(3):
            X[i, j] = C[i, 6 + j]
            C[i, 6 + j] = 0.0
    floor = SOFT * h
    p, q, r = dyad(V, 0, 0), dyad(V, 1, 1), dyad(V, 2, 2)
    for k in range(3):
        e = combined(combined(scaled(W[0, k], p), W[1, k], q), W[2, k], r)
        add_mode(A[k, k], floor, e, X, C, P)
    # sym(v_i v_jᵀ) has the square 1/2.
    add_mode(h - c * S[2, 2], floor, scaled(ROOT, dyad(V, 0, 1)), X, C, P)
    add_mode(h - c * S[1, 1], floor, scaled(ROOT, dyad(V, 0, 2)), X, C, P)
    add_mode(h - c * S[0, 0], floor, scaled(ROOT, dyad(V, 1, 2)), X, C, P)
    for i in range(6):
        for j in range(3):
            C[6 + j, i] = C[i, 6 + j]


@compiled
def blocks_to_matrix(C: Array) -> None:
    """From (e, a) to vec A, columns and then rows."""
    for i in range(9):
        v = to_matrix(
            (C[i, 0], C[i, 1], C[i, 2], C[i, 3], C[i, 4], C[i, 5]), (C[i, 6], C[i, 7], C[i, 8])
        )
        for j in range(9):
            C[i, j] = v[j]
    for j in range(9):
        v = to_matrix(
            (C[0, j], C[1, j], C[2, j], C[3, j], C[4, j], C[5, j]), (C[6, j], C[7, j], C[8, j])
        )
        for i in range(9):
            C[i, j] = v[i]


@compiled
def to_matrix(e: Tuple, a: Tuple) -> Tuple:
    """The gradient with respect to A of a function of (e, a) from its gradient there."""
    e1, e3, e4 = 0.5 * e[1], 0.5 * e[3], 0.5 * e[4]
    return (e[0], e1 - a[2], e3 + a[1], e1 + a[2], e[2], e4 - a[0], e3 - a[1], e4 + a[0], e[5])


@compiled
def set_pulled_back(C: Array, R: Tuple, volume: float, g: Tuple, A: Array) -> None:
    """V ∂Aᵀ C ∂A as the matrix of the cell's 12 displacement dofs, A = RᵀδF."""
    W = carray(local_array(27), (9, 3))
    Rt = transpose(R)
    for b in range(3):
        for p in range(9):
            for j in range(3):
                W[p, j] = volume * (
                    C[p, 3 * j] * g[3 * b]
                    + C[p, 3 * j + 1] * g[3 * b + 1]
                    + C[p, 3 * j + 2] * g[3 * b + 2]
                )
        for a in range(b + 1):
            g0, g1, g2 = g[3 * a], g[3 * a + 1], g[3 * a + 2]
            K = (
                W[0, 0] * g0 + W[1, 0] * g1 + W[2, 0] * g2,
                W[0, 1] * g0 + W[1, 1] * g1 + W[2, 1] * g2,
                W[0, 2] * g0 + W[1, 2] * g1 + W[2, 2] * g2,
                W[3, 0] * g0 + W[4, 0] * g1 + W[5, 0] * g2,
                W[3, 1] * g0 + W[4, 1] * g1 + W[5, 1] * g2,
                W[3, 2] * g0 + W[4, 2] * g1 + W[5, 2] * g2,
                W[6, 0] * g0 + W[7, 0] * g1 + W[8, 0] * g2,
                W[6, 1] * g0 + W[7, 1] * g1 + W[8, 1] * g2,
                W[6, 2] * g0 + W[7, 2] * g1 + W[8, 2] * g2,
            )
            set_block(times(R, times(K, Rt)), a, b, A)
    set_first_vertex(A)


@compiled
def set_block(K: Tuple, a: int, b: int, A: Array) -> None:
    """The block of the vertices a + 1 and b + 1, and its transpose."""
    for i in range(3):
        for j in range(3):
            A[3 * a + 3 + i, 3 * b + 3 + j] = K[3 * i + j]
            A[3 * b + 3 + j, 3 * a + 3 + i] = K[3 * i + j]


@compiled
def set_first_vertex(A: Array) -> None:
    """The blocks of the first vertex: hat functions add up to one, so block rows to zero."""
    for j in range(3, 12):
        for i in range(3):
            value = -(A[3 + i, j] + A[6 + i, j] + A[9 + i, j])
            A[i, j] = value
            A[j, i] = value
    for i in range(3):
        for j in range(3):
            A[i, j] = -(A[i, 3 + j] + A[i, 6 + j] + A[i, 9 + j])


# Cells


@compiled
def vertex_differences(dofs: Ints, x: Array) -> Tuple:
    """Differences of vectors at a cell's vertices to that at the first."""
    return differences(x, dofs[0], dofs[1], dofs[2], dofs[3])


@compiled
def cell_deformation(
    geometry_dofs: Ints, x: Array, u_dofs: Ints, u: Array
) -> tuple[float, Tuple, Tuple]:
    """The volume, the gradients of the last three hat functions and F."""
    volume, g = geometry(vertex_differences(geometry_dofs, x))
    return volume, g, plus_identity(displacement_gradient(vertex_differences(u_dofs, u), g))


@compiled
def keep(known: Array, k: int, volume: float, g: Tuple, polar: tuple[Tuple, Tuple, Tuple]) -> None:
    """Put a cell's kinematics into row k."""
    R, s, T_inverse = polar
    known[k, 0] = volume
    for i in range(9):
        known[k, 1 + i], known[k, 10 + i] = g[i], R[i]
    for i in range(6):
        known[k, 19 + i], known[k, 25 + i] = s[i], T_inverse[i]


@compiled
def kept(known: Array, k: int) -> tuple[float, Tuple, tuple[Tuple, Tuple, Tuple]]:
    """The volume, the gradients of hat functions and the polar decomposition in row k."""
    v = known[k]
    g = (v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9])
    R = (v[10], v[11], v[12], v[13], v[14], v[15], v[16], v[17], v[18])
    s = (v[19], v[20], v[21], v[22], v[23], v[24])
    return v[0], g, (R, s, (v[25], v[26], v[27], v[28], v[29], v[30]))


@compiled
def add_stress(P: Tuple, volume: float, g: Tuple, dofs: Ints, r: Array) -> None:
    """Add ∫ P : ∂δu/∂X to the displacement dofs."""
    first = dofs[0]
    for a in range(3):
        v = volume * g[3 * a], volume * g[3 * a + 1], volume * g[3 * a + 2]
        for i in range(3):
            force = P[3 * i] * v[0] + P[3 * i + 1] * v[1] + P[3 * i + 2] * v[2]
            r[dofs[a + 1], i] += force
            r[first, i] -= force


@compiled
def add_dual(r: Array, i: int, volume: float, X: Tuple, Z: Tuple) -> None:
    """Add V B_k : (X - Z) to row i."""
    r[i, 0] += volume * (X[0] - Z[0])
    r[i, 1] += 2.0 * volume * (X[1] - Z[1])
    r[i, 2] += volume * (X[2] - Z[2])
    r[i, 3] += 2.0 * volume * (X[3] - Z[3])
    r[i, 4] += 2.0 * volume * (X[4] - Z[4])
    r[i, 5] += volume * (X[5] - Z[5])


@compiled
def from_dual(b: Array, i: int, scale: float) -> Tuple:
    """The dofs of the symmetric matrix whose dual is row i, times scale."""
    half = 0.5 * scale
    return (
        scale * b[i, 0],
        half * b[i, 1],
        scale * b[i, 2],
        half * b[i, 3],
        half * b[i, 4],
        scale * b[i, 5],
    )


@compiled
def symmetric_dofs(values: Array, i: int) -> Tuple:
    """The dofs of a symmetric tensor at row i."""
    return (
        values[i, 0],
        values[i, 1],
        values[i, 2],
        values[i, 3],
        values[i, 4],
        values[i, 5],
    )
