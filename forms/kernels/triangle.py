r"""Per-cell kernels on linear triangles, as `forms.kernels.tetrahedron` in 2D.

Matrices are tuples: 4 entries row by row, or the dofs 00, 10, 11 of a symmetric matrix. A skew
matrix is a multiple of E = (0 -1; 1 0), so that the equations of the tetrahedron hold with [ω]ₓ =
ω E, T = tr S_F and numbers in place of vectors: with δR = ω R E, A = RᵀδF and D = Y + c E,

    T ω = a = A₁₀ - A₀₁,   δS = sym A - ω sym(E S_F),   T c = (S_F Y - Y S_F)₁₀,
    Y : ∂²S[δF, δF] = 2 ω δS : sym(E D) + ω² tr(D S_F).
"""

from __future__ import annotations

import math

from forms.kernels.cells import AS_RIGID_AS_POSSIBLE, COROTATIONAL, STABLE_NEO_HOOKEAN
from forms.kernels.compile import Array, Ints, carray, compiled, local_array
from forms.kernels.dense import diagonalise, is_positive
from forms.kernels.tetrahedron import ROOT, SOFT

Tuple = tuple[float, ...]

DIMENSION = 2
KEPT = 13
"""Numbers that `keep` keeps of a cell."""


# Matrices


@compiled
def times(A: Tuple, B: Tuple) -> Tuple:
    """A B."""
    return (
        A[0] * B[0] + A[1] * B[2],
        A[0] * B[1] + A[1] * B[3],
        A[2] * B[0] + A[3] * B[2],
        A[2] * B[1] + A[3] * B[3],
    )


@compiled
def combined(s: Tuple, factor: float, t: Tuple) -> Tuple:
    """The dofs s + factor t."""
    return (s[0] + factor * t[0], s[1] + factor * t[1], s[2] + factor * t[2])


@compiled
def scaled(factor: float, s: Tuple) -> Tuple:
    """The dofs factor s."""
    return (factor * s[0], factor * s[1], factor * s[2])


@compiled
def transpose(A: Tuple) -> Tuple:
    """Aᵀ."""
    return (A[0], A[2], A[1], A[3])


@compiled
def sym(A: Tuple) -> Tuple:
    """The dofs of (A + Aᵀ) / 2."""
    return (A[0], 0.5 * (A[1] + A[2]), A[3])


@compiled
def full(s: Tuple) -> Tuple:
    """The symmetric matrix with dofs s."""
    return (s[0], s[1], s[1], s[2])


# Cells


@compiled
def differences(x: Array, i: int, j: int, k: int) -> Tuple:
    """Rows x_j - x_i, x_k - x_i of vectors at the vertices."""
    return (x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[k, 0] - x[i, 0], x[k, 1] - x[i, 1])


@compiled
def vertex_differences(dofs: Ints, x: Array) -> Tuple:
    """Differences of vectors at a cell's vertices to that at the first."""
    return differences(x, dofs[0], dofs[1], dofs[2])


@compiled
def geometry(edges: Tuple) -> tuple[float, Tuple]:
    """The area, and the gradients of the last two hat functions as rows."""
    det = edges[0] * edges[3] - edges[1] * edges[2]
    g = (edges[3] / det, -edges[2] / det, -edges[1] / det, edges[0] / det)
    return 0.5 * abs(det), g


@compiled
def displacement_gradient(du: Tuple, g: Tuple) -> Tuple:
    """∂u/∂X from differences of displacements."""
    return times(transpose(du), g)


@compiled
def plus_identity(A: Tuple) -> Tuple:
    """A + I."""
    return (A[0] + 1.0, A[1], A[2], A[3] + 1.0)


@compiled
def cell_deformation(
    geometry_dofs: Ints, x: Array, u_dofs: Ints, u: Array
) -> tuple[float, Tuple, Tuple]:
    """The area, the gradients of the last two hat functions and F."""
    volume, g = geometry(vertex_differences(geometry_dofs, x))
    return volume, g, plus_identity(displacement_gradient(vertex_differences(u_dofs, u), g))


@compiled
def polar(F: Tuple) -> tuple[Tuple, Tuple, float]:
    """R, the dofs of S_F = RᵀF and 1/T; not finite where σ₁ + σ₂ = 0."""
    c, s = F[0] + F[3], F[2] - F[1]
    inverse = 1.0 / math.sqrt(c * c + s * s)  # the root is tr S_F
    R = (c * inverse, -s * inverse, s * inverse, c * inverse)
    return R, sym(times(transpose(R), F)), inverse


@compiled
def keep(known: Array, k: int, volume: float, g: Tuple, polar: tuple[Tuple, Tuple, float]) -> None:
    """Put a cell's kinematics into row k."""
    R, s, T_inverse = polar
    known[k, 0], known[k, 1] = volume, T_inverse
    for i in range(4):
        known[k, 2 + i], known[k, 6 + i] = g[i], R[i]
    for i in range(3):
        known[k, 10 + i] = s[i]


@compiled
def kept(known: Array, k: int) -> tuple[float, Tuple, tuple[Tuple, Tuple, float]]:
    """The area, the gradients of hat functions and the polar decomposition in row k."""
    v = known[k]
    g, R = (v[2], v[3], v[4], v[5]), (v[6], v[7], v[8], v[9])
    return v[0], g, (R, (v[10], v[11], v[12]), v[1])


@compiled
def pulled(s: Tuple, T_inverse: float, X: Tuple) -> Tuple:
    """D = X + c E, with R D the gradient of X : S_F; X in dofs."""
    M = times(full(s), full(X))
    c = (M[2] - M[1]) * T_inverse
    return (X[0], X[1] - c, X[1] + c, X[2])


@compiled
def spin_stretch(D: Tuple) -> Tuple:
    """The dofs of sym(E D)."""
    return (-D[2], 0.5 * (D[0] - D[3]), D[1])


@compiled
def stretch_change(R: Tuple, s: Tuple, T_inverse: float, dF: Tuple) -> Tuple:
    """The dofs of δS."""
    A = times(transpose(R), dF)
    return combined(sym(A), (A[1] - A[2]) * T_inverse, spin_stretch(full(s)))


@compiled
def add_stress(P: Tuple, volume: float, g: Tuple, dofs: Ints, r: Array) -> None:
    """Add ∫ P : ∂δu/∂X to the displacement dofs."""
    first = dofs[0]
    for a in range(2):
        for i in range(2):
            force = volume * (P[2 * i] * g[2 * a] + P[2 * i + 1] * g[2 * a + 1])
            r[dofs[a + 1], i] += force
            r[first, i] -= force


@compiled
def add_dual(r: Array, i: int, volume: float, X: Tuple, Z: Tuple) -> None:
    """Add V B_k : (X - Z) to row i."""
    r[i, 0] += volume * (X[0] - Z[0])
    r[i, 1] += 2.0 * volume * (X[1] - Z[1])
    r[i, 2] += volume * (X[2] - Z[2])


@compiled
def from_dual(b: Array, i: int, scale: float) -> Tuple:
    """The dofs of the symmetric matrix whose dual is row i, times scale."""
    return (scale * b[i, 0], 0.5 * scale * b[i, 1], scale * b[i, 2])


@compiled
def symmetric_dofs(values: Array, i: int) -> Tuple:
    """The dofs of a symmetric tensor at row i."""
    return (values[i, 0], values[i, 1], values[i, 2])


# Materials. All three have ∂²Ψ/∂S² = h 𝕀 + c ∂(cof S)/∂S + λ' N ⊗ N.


@compiled
def density(kind: float, mu: float, lam: float, s: Tuple) -> float:
    """Ψ(S) [J/m³]."""
    trace = s[0] + s[2]
    squares = s[0] ** 2 + s[2] ** 2 + 2.0 * s[1] ** 2
    if kind == STABLE_NEO_HOOKEAN:
        J = s[0] * s[2] - s[1] ** 2
        return mu * (1.0 - J) + 0.5 * lam * (J - 1.0) ** 2 + 0.5 * mu * (squares - 2.0)
    energy = mu * (squares - 2.0 * trace + 2.0)
    if kind == COROTATIONAL:
        energy += 0.5 * lam * (trace - 2.0) ** 2
    return energy


@compiled
def law(kind: float, mu: float, lam: float, s: Tuple) -> tuple[Tuple, float, float, float, Tuple]:
    """The dofs of ∂Ψ/∂S, then h, c, λ' and the dofs of N."""
    if kind == STABLE_NEO_HOOKEAN:
        N = (s[2], -s[1], s[0])
        c = lam * (s[0] * s[2] - s[1] * s[1] - 1.0) - mu
        return (mu * s[0] + c * N[0], mu * s[1] + c * N[1], mu * s[2] + c * N[2]), mu, c, lam, N
    if kind == AS_RIGID_AS_POSSIBLE:
        lam = 0.0
    pressure = lam * (s[0] + s[2] - 2.0)
    stress = (
        2.0 * mu * (s[0] - 1.0) + pressure,
        2.0 * mu * s[1],
        2.0 * mu * (s[2] - 1.0) + pressure,
    )
    return stress, 2.0 * mu, 0.0, lam, (1.0, 0.0, 1.0)


@compiled
def stress_change(s: Tuple, h: float, c: float, lam: float, N: Tuple, ds: Tuple) -> Tuple:
    """The dofs of ∂²Ψ/∂S² δS."""
    inner = lam * (N[0] * ds[0] + N[2] * ds[2] + 2.0 * N[1] * ds[1])
    return (
        h * ds[0] + inner * N[0] + c * ds[2],
        h * ds[1] + inner * N[1] - c * ds[1],
        h * ds[2] + inner * N[2] + c * ds[0],
    )


# Tangents


@compiled
def fill_hessian(h: float, c: float, lam: float, N: Tuple, H: Array) -> None:
    """The dual Hessian ∂²Ψ/∂s² into H[:3, :3]."""
    n = (N[0], 2.0 * N[1], N[2])
    for i in range(3):
        for j in range(3):
            H[i, j] = lam * n[i] * n[j]
    H[0, 0] += h
    H[1, 1] += 2.0 * (h - c)
    H[2, 2] += h
    H[0, 2] += c
    H[2, 0] += c


@compiled
def fill_blocks(
    s_F: Tuple,
    T_inverse: float,
    Y: Tuple,
    h: float,
    c: float,
    lam: float,
    normal: Tuple,
    C: Array,
) -> None:
    """∂Sᵀ H ∂S + Y : ∂²S as a symmetric matrix on the dofs of sym A and a, into C[:4, :4]."""
    fill_hessian(h, c, lam, normal, C)
    D = pulled(s_F, T_inverse, Y)
    q, b = spin_stretch(full(s_F)), spin_stretch(D)
    b = (b[0], 2.0 * b[1], b[2])
    M = times(D, full(s_F))
    n = M[0] + M[3]
    for i in range(3):
        x = b[i] - C[i, 0] * q[0] - C[i, 1] * q[1] - C[i, 2] * q[2]
        n -= q[i] * (b[i] + x)
        C[i, 3] = C[3, i] = x * T_inverse
    C[3, 3] = n * T_inverse * T_inverse


@compiled
def fill_stretch_moduli(h: float, c: float, lam: float, n: Tuple, A: Array) -> None:
    """∂²Ψ/∂σ² at principal stretches into A[:2, :2], with the principal values n of N."""
    A[0, 0], A[1, 1] = h + lam * n[0] * n[0], h + lam * n[1] * n[1]
    A[0, 1] = A[1, 0] = c + lam * n[0] * n[1]


@compiled
def add_mode(eta: float, floor: float, e: Tuple, x: Tuple, C: Array) -> float:
    """Put a unit eigenvector e of H back; x·e couples it to the spin unless below the floor.

    Returns:
        What its coupling adds to P.
    """
    if not eta > 0.0:
        return 0.0
    n = (e[0], 2.0 * e[1], e[2])
    for i in range(3):
        for j in range(3):
            C[i, j] += eta * n[i] * n[j]
    if not eta > floor:
        return 0.0
    coupling = e[0] * x[0] + e[1] * x[1] + e[2] * x[2]
    for i in range(3):
        C[i, 3] += coupling * n[i]
        C[3, i] += coupling * n[i]
    return coupling * coupling / eta


@compiled
def project(s: Tuple, h: float, c: float, lam: float, normal: Tuple, C: Array) -> None:
    """Make the tangent positive semi-definite, eq. (4) of `forms.kernels.tetrahedron`."""
    L = carray(local_array(16), (4, 4))
    if is_positive(C, L):
        return
    S = carray(local_array(4), (2, 2))
    V = carray(local_array(4), (2, 2))
    A = carray(local_array(4), (2, 2))
    W = carray(local_array(4), (2, 2))
    S[0, 0], S[0, 1], S[1, 0], S[1, 1] = full(s)
    diagonalise(S, V)
    N = full(normal)
    n0 = V[0, 0] ** 2 * N[0] + 2.0 * V[0, 0] * V[1, 0] * N[1] + V[1, 0] ** 2 * N[3]
    n1 = V[0, 1] ** 2 * N[0] + 2.0 * V[0, 1] * V[1, 1] * N[1] + V[1, 1] ** 2 * N[3]
    fill_stretch_moduli(h, c, lam, (n0, n1), A)
    diagonalise(A, W)
    x = (C[0, 3], C[1, 3], C[2, 3])
    for i in range(3):
        for j in range(4):
            C[i, j] = C[j, i] = 0.0
    P, floor = 0.0, SOFT * h
    p, q, r = dyad(V, 0, 0), dyad(V, 1, 1), dyad(V, 0, 1)
    for k in range(2):
        e = combined(scaled(W[0, k], p), W[1, k], q)
        P += add_mode(A[k, k], floor, e, x, C)
    # sym(v_i v_jᵀ) has the square 1/2.
    P += add_mode(h - c, floor, scaled(ROOT, r), x, C)
    if C[3, 3] < P:
        C[3, 3] = P


@compiled
def dyad(V: Array, i: int, j: int) -> Tuple:
    """The dofs of sym(v_i v_jᵀ), v_i column i of V."""
    return (
        V[0, i] * V[0, j],
        0.5 * (V[0, i] * V[1, j] + V[1, i] * V[0, j]),
        V[1, i] * V[1, j],
    )


@compiled
def blocks_to_matrix(C: Array) -> None:
    """From the dofs of sym A and a to vec A, columns and then rows."""
    for i in range(4):
        C[i, 0], C[i, 1], C[i, 2], C[i, 3] = to_matrix(C[i, 0], C[i, 1], C[i, 2], C[i, 3])
    for j in range(4):
        C[0, j], C[1, j], C[2, j], C[3, j] = to_matrix(C[0, j], C[1, j], C[2, j], C[3, j])


@compiled
def to_matrix(e0: float, e1: float, e2: float, a: float) -> Tuple:
    """The gradient with respect to A of a function of (e, a) from its gradient there."""
    return (e0, 0.5 * e1 - a, 0.5 * e1 + a, e2)


@compiled
def set_pulled_back(C: Array, R: Tuple, volume: float, g: Tuple, A: Array) -> None:
    """V ∂Aᵀ C ∂A as the matrix of the cell's 6 displacement dofs, A = RᵀδF."""
    Rt = transpose(R)
    for b in range(2):
        for a in range(2):
            p0, p1 = volume * g[2 * a], volume * g[2 * a + 1]
            q0, q1 = g[2 * b], g[2 * b + 1]
            rotated = (
                p0 * (C[0, 0] * q0 + C[0, 1] * q1) + p1 * (C[1, 0] * q0 + C[1, 1] * q1),
                p0 * (C[0, 2] * q0 + C[0, 3] * q1) + p1 * (C[1, 2] * q0 + C[1, 3] * q1),
                p0 * (C[2, 0] * q0 + C[2, 1] * q1) + p1 * (C[3, 0] * q0 + C[3, 1] * q1),
                p0 * (C[2, 2] * q0 + C[2, 3] * q1) + p1 * (C[3, 2] * q0 + C[3, 3] * q1),
            )
            K = times(R, times(rotated, Rt))
            for i in range(2):
                for j in range(2):
                    A[2 * a + 2 + i, 2 * b + 2 + j] = K[2 * i + j]
    # Hat functions add up to one, so block rows to zero.
    for j in range(2, 6):
        for i in range(2):
            A[i, j] = A[j, i] = -(A[2 + i, j] + A[4 + i, j])
    for i in range(2):
        for j in range(2):
            A[i, j] = -(A[i, 2 + j] + A[i, 4 + j])
