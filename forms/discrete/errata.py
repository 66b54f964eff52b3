"""Which numbered equations of the seed hold as printed.

Throughout: λ in (26)-(41) is the new multiplier λ^t + δλ; the bold c of section 3 on is ∂E_Λ/∂λ,
that is V_K c_K stacked, as the display before (26) says; Ŵ has the index order (entry of F, entry
of R S, dof of S), the only one for which (18)-(33) make sense; E_Λ^K = λ_K · c_K carries no volume.
The system (35) is that of (26), without ∂²E_Λ/∂x², as the seed announces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["holds as printed", "corrected", "not comparable"]


@dataclass(frozen=True)
class Erratum:
    """The verdict on one numbered equation.

    Attributes:
        number: Number in the seed.
        states: What the equation says, in words.
        verdict: Whether it holds; "not comparable" where there is nothing to evaluate.
        printed: The printed form, abridged.
        reason: Why, and under which reading.
        corrected: What holds instead; empty if it holds as printed.
    """

    number: int
    states: str
    verdict: Verdict
    printed: str
    reason: str
    corrected: str = ""


def _holds(number: int, states: str, printed: str, reason: str = "") -> Erratum:
    return Erratum(number, states, "holds as printed", printed, reason)


def _corrected(number: int, states: str, printed: str, corrected: str, reason: str) -> Erratum:
    return Erratum(number, states, "corrected", printed, reason, corrected)


ERRATA: tuple[Erratum, ...] = (
    Erratum(
        1,
        "continuous Lagrangian",
        "not comparable",
        "∫ ρ/(2h²)|x - x̃|² + Ψ(S) - Λ : (R S - F)",
        "the definition that UFL starts from; its discretisation (2) is compared. f_ext in x̃ is an "
        "acceleration",
    ),
    _corrected(
        2,
        "the step minimises the discrete energy",
        "x, s, λ = argmin E",
        "x, s, λ is a stationary (saddle) point of E",
        "E is linear in λ and falls without bound along λ = t c wherever c ≠ 0",
    ),
    _holds(3, "definition of W_K", "W_K s_K = vec(R_K S_K)", "vec is row-major here"),
    _holds(4, "definition of J_K", "J_K x = vec(F_K(x))"),
    _holds(
        5,
        "discrete energy in increments",
        "E(x^t + δx, s^t + δs, λ^t + δλ)",
        "W_K at x^t + δx; x̃ keeps the x^t of the start of the step",
    ),
    _holds(6, "splitting of the energy", "E = E_M + E_Ψ - E_Λ"),
    _holds(7, "kinetic energy", "E_M = |x^t + δx - x̃|²_M / (2h²)"),
    _holds(
        8,
        "kinetic energy with x̃ inserted",
        "E_M = |δx - h ẋ^t - h² f_ext|²_M / (2h²)",
        "in the first Newton iteration of a step, where the iterate is the start of the step; "
        "later x^t - x̃ stays as in (7)",
    ),
    _corrected(
        9,
        "gradient of E_M, g_x",
        "∂E_M/∂δx = M (δx - g_x)/h², hence g_x = h ẋ^t + h² f_ext",
        "∂E_M/∂δx = M δx/h² + g_x, g_x = M (x^t - x̃)/h²",
        "the first line holds; the second makes g_x a displacement, while (27)-(41) use g_x as the "
        "gradient at δx = 0, with M/h² and the opposite sign",
    ),
    _holds(
        10,
        "quadratic model of E_Ψ",
        "Σ (Ψ + δsᵀ g_K + ½ δsᵀ H_K δs) V_K",
        "remainder of third order; g_K and g_{s_K} are the same",
    ),
    _corrected(
        11,
        "its derivative",
        "∂Ẽ_Ψ/∂δs_K = Σ_K (g_K + H_K δs_K) V_K",
        "∂Ẽ_Ψ/∂δs_K = (g_K + H_K δs_K) V_K",
        "δs_K appears in one term of the sum only",
    ),
    _holds(12, "constraint energy", "E_Λ = Σ λ_K · (W_K s_K - J_K x) V_K"),
    _holds(
        13,
        "quadratic model of E_Λ",
        "E_Λ + Σ (first and second derivatives of E_Λ^K) V_K",
        "remainder of third order; E_Λ is linear in s and in λ, so no other term exists",
    ),
    _holds(
        14,
        "rotation by singular values",
        "R = U Vᵀ, F = U Σ Vᵀ",
        "with U and V in SO(3) and a signed σ; with the usual σ ≥ 0 det R = -1 in inverted cells",
    ),
    _corrected(
        15,
        "derivative of R by ∂U and ∂V",
        "∂R = ∂U Vᵀ + U ∂Vᵀ",
        "Uᵀ δR V = (P_ij - P_ji)/(σ_i + σ_j), P = Uᵀ δF V",
        "holds for distinct σ, but ∂U and ∂V do not exist where two σ agree, at rest for one; the "
        "factor σ_i - σ_j cancels in the sum, which exists",
    ),
    _holds(16, "W_K in indices", "W_ij s_j = vec(R_kl S_lm)"),
    _corrected(
        17,
        "definition of Ŵ_K",
        "Ŵ_ijk s_k = ∂vec(R_lm S_mn)/∂F_(kl)",
        "Ŵ_jkl s_l = ∂vec(R S)_k/∂vec(F)_j, S fixed",
        "k and l stand for two things each. Read with the numerator's index first, as in "
        "∂R_ij/∂F_kl, it contradicts (18), (22), (23) and (28)-(33), which need F's index first",
    ),
    _corrected(
        18,
        "∂E_Λ^K/∂x",
        "J_ij (Ŵ_jkl s_l - I_jk) λ_k",
        "J_ji (Ŵ_jkl s_l - I_jk) λ_k",
        "J_K is 9×dn (4): its transpose is needed, as in (28)",
    ),
    _corrected(
        19,
        "∂E_Λ^K/∂s_K",
        "W_ij λ_j",
        "W_ji λ_j",
        "W_K is 9×6: its transpose is needed, as in (29)",
    ),
    _holds(20, "∂E_Λ^K/∂λ_K", "W_ij s_j - J_ij x_j"),
    _holds(21, "∂²E_Λ^K/∂λ_K∂s_K", "W_ij"),
    _corrected(
        22,
        "∂²E_Λ^K/∂x∂λ_K",
        "J_ij (Ŵ_jkl s_l - I_jk)",
        "J_ji (Ŵ_jkl s_l - I_jk)",
        "as (18)",
    ),
    _corrected(
        23,
        "∂²E_Λ^K/∂x∂s_K",
        "J_ij Ŵ_jkl λ_k",
        "J_ji Ŵ_jkl λ_k",
        "as (18)",
    ),
    _corrected(
        24,
        "∂²E_Λ^K/∂x²",
        "left open",
        "J_Kᵀ (Ωᵀ N Ω - Ωᵀ L - Lᵀ Ω) J_K, see forms.discrete.rotation",
        "the seed leaves it open and then drops it; Newton's method needs it",
    ),
    Erratum(25, "nothing", "not comparable", "", "a number without an equation"),
    _holds(
        26,
        "quadratic model of E without ∂²c/∂x²",
        "E_M + E_Ψ + … - λᵀ c - …",
        "as the model that it is said to be: its remainder is of second order in δx, of third with "
        "-½ δxᵀ (24) δx; ∂²c/∂x∂s is not dropped",
    ),
    _holds(
        27,
        "the same in increments",
        "… + δxᵀ g_x + δsᵀ g_s - λᵀ c - … + δxᵀ M δx/(2h²)",
        "with g_x = ∂E_M/∂x, as its first line says, not the g_x of (9)",
    ),
    _holds(
        28,
        "∂Ẽ/∂δx",
        "M δx/h² + g_x - Σ (J_Kᵀ (Ŵ_K·λ_K) δs_K + J_Kᵀ (Ŵ_K·s_K - I) λ_K) V_K",
        "with the g_x of (27)",
    ),
    _holds(
        29,
        "∂Ẽ^K/∂δs_K",
        "g_K + H_K δs_K - W_Kᵀ λ_K - (Ŵ_K·λ_K)ᵀ J_K δx",
        "per unit volume; (28) is not",
    ),
    _holds(30, "δs_K from (29)", "δs_K = H_K⁻¹ (W_Kᵀ λ_K + (Ŵ_K·λ_K)ᵀ J_K δx - g_K)"),
    _holds(
        31,
        "∂Ẽ^K/∂λ_K",
        "-c_K - (Ŵ_K·s_K - I)ᵀ J_K δx - W_K δs_K",
        "per unit volume; the first line writes the same as a row",
    ),
    _holds(32, "F", "F = -Σ P_sᵀ (Ŵ_K·λ_K)ᵀ J_K^w", "J_K^w = V_K J_K"),
    _holds(33, "G", "G = J^w - Σ P_λᵀ (Ŵ_K·s_K)ᵀ J_K^w"),
    _corrected(
        34,
        "D",
        "D = -Σ P_λᵀ W_K P_s",
        "D = -Σ P_λᵀ W_K P_s V_K",
        "F and G carry the volume, so must D; and with it H, g_s and c",
    ),
    _corrected(
        35,
        "the Newton system",
        "[M/h² Fᵀ Gᵀ; F H Dᵀ; G D 0] (δx, δs, λ) = (-g_x, -g_s, c)",
        "H = diag V_K H_K, g_s = V_K g_K, c = V_K c_K, and either the block -(ε/2) V_K (R E_a)⊗"
        "(R E_a) in place of 0 or Λ = R Y with Y symmetric",
        "signs are right. Volumes are not printed with H, g_s and c. Rᵀc is symmetric, so that at "
        "every feasible state R skew(.) is a null space, 3 vectors a cell; at an infeasible state "
        "these rows force δR = 0 where tr(S - S_F) I - (S - S_F) is regular",
    ),
    _holds(36, "δs eliminated", "δs = H⁻¹ (-g_s - Dᵀ λ - F δx)"),
    _holds(37, "first row with (36)", "(M/h² - FᵀH⁻¹F) δx + (Gᵀ - FᵀH⁻¹Dᵀ) λ = FᵀH⁻¹g_s - g_x"),
    _holds(38, "third row with (36)", "(G - DH⁻¹F) δx - DH⁻¹Dᵀ λ = c + DH⁻¹g_s"),
    _holds(39, "M̃", "M̃ = M/h² - FᵀH⁻¹F"),
    _holds(40, "J̃", "J̃ = G - DH⁻¹F"),
    _corrected(
        41,
        "the reduced Newton system",
        "[M̃ J̃ᵀ; J̃ -DH⁻¹Dᵀ] (δx, λ) = (FᵀH⁻¹g_s - g_x, c + DH⁻¹g_s)",
        "-(ε/2) V_K (R E_a)⊗(R E_a) added to -DH⁻¹Dᵀ, or Λ = R Y with Y symmetric",
        "the elimination is right; the matrix inherits the null space of (35), D H⁻¹ Dᵀ having "
        "rank 6 of 9 in every cell at every state",
    ),
)
"""One record per numbered equation, in order."""
