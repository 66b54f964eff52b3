"""What the letters of the seed stand for: symbols as printed, and their values in a system.

`Letters` evaluates equations with them.
"""

from __future__ import annotations

import numpy as np

from demos.by_hand.basis import Array, skew_basis
from demos.by_hand.errata.formula import Symbols, evaluate, sides
from demos.by_hand.seed import SeedSystem

INDICES = {16: "i", 18: "i", 19: "i", 20: "i", 21: "ij", 22: "ik", 23: "il", 24: "pq"}
"""The equations in index notation, and their free indices."""

IN_EACH_CELL = (11, 29, 30, 31)
"""The equations of a single cell."""

LEFT_AND_RIGHT = (35, 37, 38, 41)
"""The equations with formulas on both sides."""

EVALUATED = (*range(7, 14), *INDICES, *range(26, 42))
"""The equations whose text can be evaluated. The others define or derive by words."""


class Letters:
    """The letters of the seed with their values at a state and an increment.

    Attributes:
        body: Those that no cell has of its own.
        cells: Those with an index K, by cell.

    Args:
        w: The system at x^t, s^t, λ^t, without ∂²E_Λ/∂x².
        dx: δx, flat; so δs and δλ.
        ds: δs.
        dlam: δλ.
    """

    def __init__(self, w: SeedSystem, dx: Array, ds: Array, dlam: Array) -> None:
        self._w = w
        self.body = _body_symbols(w, dx, ds, dlam)
        self.cells = _cell_symbols(w, dx, ds, dlam)

    def read(self, number: int, equation: str) -> list[Array]:
        """What an equation says: the value of each of its formulas, which must agree.

        Those of single cells are stacked; of `LEFT_AND_RIGHT` the value is left less right.

        Args:
            number: One of `EVALUATED`; those in index notation on a body of one cell only.
            equation: Its text, with definitions below it.

        Raises:
            FormulaError: It means nothing.
        """
        left, *formulas = sides(equation)
        body, cells = self.body, self.cells
        if number == 16:  # an equation of two names for one thing: the first is worked out
            formulas = [left]
        if number in INDICES:
            symbols = _index_symbols(self._w)
            return [evaluate(f, symbols, letters=INDICES[number]) for f in formulas]
        if number in LEFT_AND_RIGHT:
            (right,) = formulas
            difference: Array = evaluate(left, body) - evaluate(right, body)
            return [difference]
        if number in IN_EACH_CELL:
            return [
                np.concatenate([evaluate(f, {**body, **cell}, cells) for cell in cells])
                for f in formulas
            ]
        return [evaluate(f, body, cells) for f in formulas]


def _index_symbols(w: SeedSystem) -> Symbols:
    """The letters of (16)-(24), on a body of one cell."""
    return {
        "W": w.W[0],
        "Ŵ": w.W_hat[0],
        "J": w.J.toarray(),
        "I": np.eye(w.d**2),
        "x": w.state.x.ravel(),
        "s": w.s[0],
        "λ": w.lam,
        "F": w.deformation_gradient[0],
        "R": w.polar.R[0],
        "S": w.state.S[0],
        "Λ": w.state.Lam[0],
        "E": skew_basis(w.d),
    }


def _body_symbols(w: SeedSystem, dx: Array, ds: Array, dlam: Array) -> Symbols:
    """The letters of (7)-(13) and (26)-(41) that no cell has of its own."""
    M, H, F, G, D = (block.toarray() for block in (w.M, w.H, w.F, w.G, w.D))
    H_inv = w.H_inv.toarray()
    # By (12) F, G and D are -∂²E_Λ with the rows of s, λ and λ; (22) and (23) have those of x.
    return {
        "h": w.h,
        "M": M,
        "x̃": w.x_tilde.ravel(),
        "ẋ^t": np.broadcast_to(w.v, w.state.x.shape).ravel(),
        "f_ext": np.broadcast_to(w.f_ext, w.state.x.shape).ravel(),
        "x^t": w.state.x.ravel(),
        "s^t": w.s.ravel(),
        "x": w.state.x.ravel() + dx,
        "s": w.s.ravel() + ds,
        "λ": w.lam + dlam,
        "δx": dx,
        "δs": ds,
        "E_M(x^t)": w.E_M(),
        "E_Ψ(s^t)": w.E_Psi(),
        "E_Λ(x^t, s^t, λ^t)": w.E_Lambda(),
        "∂E_M/∂x": w.g_x,
        "∂E_Ψ/∂s": w.g_s,
        "∂c/∂x": -G.T,
        "∂c/∂s": -D.T,
        "∂²E_M/∂x²": M / w.h**2,
        "∂²E_Ψ/∂s²": H,
        "∂/∂x (∂c/∂s λ^t)": -F.T,
        "g_x^t": w.g_x,
        "g_s^t": w.g_s,
        "c(x^t, s^t)": w.c,
        "H": H,
        "H^t": H,
        "F": F,
        "G": G,
        "D": D,
        "J^w": w.J_w.toarray(),
        "M̃": M / w.h**2 - F.T @ H_inv @ F,
        "J̃": G - D @ H_inv @ F,
        "A_ε": w.cure_xx.toarray(),
        "G_ε": w.cure_lx.toarray(),
        "C_ε": w.C.toarray(),
        "r_ε": w.cure_x,
    }


def _cell_symbols(w: SeedSystem, dx: Array, ds: Array, dlam: Array) -> list[Symbols]:
    """The letters of (10)-(13) and (28)-(34) with an index K, in each cell."""
    n, m, d2 = len(w.W), w.s.shape[1], w.d**2
    J = w.J.toarray().reshape(n, d2, -1)
    bend = w.W_hat_s - np.eye(d2)
    by_symbol = {
        "V_K": w.volume,
        "W_K": w.W,
        "W_K^t": w.W,
        "Ŵ_K^t": w.W_hat,
        "J_K": J,
        "J_K^w": w.volume[:, None, None] * J,
        "I": np.broadcast_to(np.eye(d2), (n, d2, d2)),
        "s_K": w.s,
        "s_K^t": w.s,
        "δs_K": ds.reshape(n, m),
        "λ_K^t": w.lam.reshape(n, d2),
        "λ_K": (w.lam + dlam).reshape(n, d2),
        "δλ_K": dlam.reshape(n, d2),
        "Ψ(s_K^t)": w.material.psi(w.s),
        "g_K": w.g_K,
        "g_K^t": w.g_K,
        "g_{s_K}^t": w.g_K,
        "H_K": w.H_K,
        "H_K^t": w.H_K,
        "c_K(x^t, s^t)": w.c_K,
        "∂c_K/∂x": np.swapaxes(J, 1, 2) @ bend,
        "∂c_K/∂s_K": np.swapaxes(w.W, 1, 2),
        "∂c_K/∂s": np.eye(n * m).reshape(n, m, -1).swapaxes(1, 2) @ np.swapaxes(w.W, 1, 2),
        "∂E_Λ^K/∂x": np.einsum("njp,njk,nk->np", J, bend, w.lam.reshape(n, d2)),
        "∂E_Λ^K/∂s_K": np.einsum("nij,ni->nj", w.W, w.lam.reshape(n, d2)),
        "∂E_Λ^K/∂λ_K": w.c_K,
        "∂²E_Λ^K/∂λ_K∂s_K": w.W,
        "∂²E_Λ^K/∂λ_K∂x": np.swapaxes(bend, 1, 2) @ J,
        "∂²E_Λ^K/∂x∂s_K": np.swapaxes(J, 1, 2) @ w.W_hat_lam,
        "∂²E_Λ^K/∂x²": np.swapaxes(J, 1, 2) @ w.E_FF @ J,
        "P_K^s": np.eye(n * m).reshape(n, m, -1),
        "P_K^λ": np.eye(n * d2).reshape(n, d2, -1),
    }
    return [{symbol: values[K] for symbol, values in by_symbol.items()} for K in range(n)]
