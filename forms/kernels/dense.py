"""Small symmetric matrices: Cholesky factors, and eigenvalues by Jacobi's method.

G. H. Golub, C. F. Van Loan, Matrix Computations, 4th edition, sections 4.2 and 8.5.
"""

from __future__ import annotations

import math

from forms.kernels.compile import Array, compiled


@compiled
def is_positive(A: Array, L: Array) -> bool:
    """Whether a symmetric A is positive definite; its Cholesky factor goes to L."""
    n = A.shape[0]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot > 0.0:
            return False
        L[j, j] = math.sqrt(pivot)
        inverse = 1.0 / L[j, j]
        for i in range(j + 1, n):
            value = A[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value * inverse
    return True


@compiled
def diagonalise(A: Array, V: Array) -> None:
    """Leave the eigenvalues of a symmetric A on its diagonal, eigenvectors in the columns of V.

    Accurate to round-off for equal eigenvalues too. Entries that are not finite end the sweeps.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(20):
        off, scale = 0.0, 0.0
        for i in range(n):
            scale += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > 1e-32 * scale:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                a = A[p, q]
                if a == 0.0:
                    continue
                gap = 0.5 * (A[q, q] - A[p, p])
                t = a / (gap + math.copysign(math.sqrt(gap * gap + a * a), gap))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                A[p, p] -= t * a
                A[q, q] += t * a
                A[p, q] = A[q, p] = 0.0
                for k in range(n):
                    if k != p and k != q:
                        x, y = A[k, p], A[k, q]
                        A[k, p] = A[p, k] = c * x - s * y
                        A[k, q] = A[q, k] = s * x + c * y
                    x, y = V[k, p], V[k, q]
                    V[k, p], V[k, q] = c * x - s * y, s * x + c * y


@compiled
def clamp(A: Array, work: Array, V: Array) -> None:
    """Raise the negative eigenvalues of a symmetric A to zero: the nearest such matrix in |·|."""
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            work[i, j] = A[i, j]
    diagonalise(work, V)
    for k in range(n):
        if work[k, k] < 0.0:
            for i in range(n):
                for j in range(n):
                    A[i, j] -= work[k, k] * V[i, k] * V[j, k]
