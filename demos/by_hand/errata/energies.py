"""Equations (1)-(25), sections 1 and 2 of the seed: energies and their derivatives."""

from __future__ import annotations

from demos.by_hand.errata.record import Erratum, corrected, holds

ENERGIES: tuple[Erratum, ...] = (
    Erratum(
        1,
        "continuous Lagrangian",
        "not comparable",
        "L(x, S, Λ) = ∫_Ω ρ/(2h²) ‖x - x̃‖₂² + Ψ(S) - Λ : (R(x) S - F(x)) dV",
        "the definition that UFL starts from; its discretisation (2) is compared. f_ext in x̃ is "
        "an acceleration [m/s²]",
    ),
    corrected(
        2,
        "the step minimises the discrete energy",
        "x^{t+1}, s^{t+1}, λ^{t+1} = arg min_{x,s,λ} 1/(2h²) ‖x - x̃‖²_M + Σ_{K∈T} (Ψ(s_K) - λ_K · "
        "(W_K s_K - J_K x)) V_K",
        "x^{t+1}, s^{t+1}, λ^{t+1} make it stationary: a saddle point",
        "E is linear in λ and falls without bound along λ = t c wherever c ≠ 0",
    ),
    holds(3, "definition of W_K", "W_K s_K = vec(R_K S_K)", "vec goes row by row here"),
    holds(4, "definition of J_K", "J_K x = vec(F_K(x))"),
    holds(
        5,
        "discrete energy in increments",
        "E(x^{t+1}, s^{t+1}, λ^{t+1}) = 1/(2h²) ‖x^t + δx - x̃‖²_M + Σ_{K∈T} Ψ(s_K^t + δs_K) V_K - "
        "Σ_{K∈T} (λ_K^t + δλ_K) · (W_K (s_K^t + δs_K) - J_K (x^t + δx)) V_K",
        "with W_K at x^t + δx, as the seed says. The superscript t means two things from the "
        "second Newton iteration on: in x̃ the start of the time step, elsewhere the last iterate",
    ),
    holds(6, "splitting of the energy", "E(x, s, λ) = E_M(x) + E_Ψ(s) - E_Λ(x, s, λ)"),
    holds(7, "kinetic energy", "E_M(x) = 1/(2h²) ‖x^t + δx - x̃‖²_M"),
    corrected(
        8,
        "kinetic energy with x̃ inserted",
        "E_M(x) = 1/(2h²) ‖δx - h ẋ^t - h² f_ext‖²_M",
        "E_M(x) = 1/(2h²) ‖δx + x^t - x̃‖²_M",
        "it holds in the first Newton iteration of a step only, where the iterate is the start of "
        "the step; later x^t - x̃ stays as in (7)",
    ),
    corrected(
        9,
        "gradient of E_M, g_x",
        "∂E_M/∂δx = 1/h² M (δx - h ẋ^t - h² f_ext) = 1/h² M (δx - g_x^t)",
        "∂E_M/∂δx = 1/h² M δx + g_x^t\ng_x^t = 1/h² M (x^t - x̃)",
        "the first form is (8) derived, for the first iteration only. The second makes g_x a "
        "displacement, while (27)-(41) use g_x for the gradient at δx = 0, with M/h² and the "
        "opposite sign",
    ),
    holds(
        10,
        "quadratic model of E_Ψ",
        "E_Ψ(s) ≈ Ẽ_Ψ(s) = Σ_{K∈T} (Ψ(s_K^t) + δs_Kᵀ g_K + ½ δs_Kᵀ H_K δs_K) V_K",
        "the remainder is of third order. g_K is the g_{s_K}^t and H_K the H_K^t of the line below",
    ),
    corrected(
        11,
        "its derivative",
        "∂Ẽ_Ψ/∂δs_K = Σ_{K∈T} (g_K^t + H_K^t δs_K) V_K",
        "∂Ẽ_Ψ/∂δs_K = (g_K^t + H_K^t δs_K) V_K",
        "δs_K appears in one term of the sum only",
    ),
    holds(
        12,
        "constraint energy",
        "E_Λ(x, s, λ) = Σ_{K∈T} (λ_K · (W_K s_K - J_K x)) V_K",
    ),
    holds(
        13,
        "quadratic model of E_Λ",
        "Ẽ_Λ(x, s, λ) = E_Λ(x^t, s^t, λ^t) + Σ_{K∈T} (δxᵀ ∂E_Λ^K/∂x + δs_Kᵀ ∂E_Λ^K/∂s_K + δλ_Kᵀ "
        "∂E_Λ^K/∂λ_K + δλ_Kᵀ ∂²E_Λ^K/∂λ_K∂s_K δs_K + δλ_Kᵀ ∂²E_Λ^K/∂λ_K∂x δx + δxᵀ ∂²E_Λ^K/∂x∂s_K "
        "δs_K + ½ δxᵀ ∂²E_Λ^K/∂x² δx) V_K",
        "the remainder is of third order. E_Λ is linear in s and in λ, so that no other term "
        "exists",
    ),
    corrected(
        14,
        "rotation by singular values",
        "R(x) = U_K(x) V_K(x)ᵀ where F_K(x) = U_K Σ_K V_Kᵀ",
        "R(x) = U_K(x) V_K(x)ᵀ where F_K(x) = U_K Σ_K V_Kᵀ and U_K, V_K are in SO(3), the last "
        "singular value having the sign of det F_K(x)",
        "with the usual singular values, none negative, R is a reflection in inverted cells, det F "
        "< 0. V_K is a matrix here and a volume elsewhere; F_K is not a part of the F of (32)",
    ),
    holds(
        15,
        "derivative of R by ∂U and ∂V",
        "∂R_K/∂F_ij = ∂U_K/∂F_ij V_Kᵀ + U_K ∂V_Kᵀ/∂F_ij",
        "for distinct singular values: where two agree, at rest for one, ∂U and ∂V do not exist. "
        "∂R does; the factor σ_i - σ_j of each cancels in the sum, which is, with P = Uᵀ δF V, (Uᵀ "
        "δR V)_ij = (P_ij - P_ji)/(σ_i + σ_j). Only where some σ_i + σ_j = 0 has R no derivative. "
        "This is what is implemented",
    ),
    holds(16, "W_K in indices", "W_ij^K s_j^K = vec(R_kl^K S_lm^K)"),
    corrected(
        17,
        "definition of Ŵ_K",
        "Ŵ_ijk^K s_k^K = ∂vec(R_lm^K S_mn^K)/∂F_(kl)",
        "Ŵ_jkl^K s_l^K = ∂vec(R^K S^K)_k/∂vec(F^K)_j, S^K fixed",
        "k and l stand for two things each. The text builds Ŵ from ∂R_ij/∂F_kl. 'Flattening the "
        "first two indices' counts the entries of a matrix by one index; 'modifying the last two' "
        "puts R S for R, with the six dofs of S as the new last index: Ŵ_jkl is the change of "
        "entry k of R S, for S = B_l, with entry j of F. So it is F's indices that are flattened "
        "and R's that are modified, and in ∂R_ij/∂F_kl they have to trade places first. In the "
        "order that the text prints, Ŵ contradicts (18), (22), (23) and (28)-(33)",
    ),
    corrected(
        18,
        "∂E_Λ^K/∂x",
        "∂E_Λ^K/∂x_i = J_ij (Ŵ_jkl^K s_l^K - I_jk) λ_k^K",
        "∂E_Λ^K/∂x_i = J_ji^K (Ŵ_jkl^K s_l^K - I_jk) λ_k^K",
        "J_K has 9 rows (4): its transpose is wanted, as in (28)",
    ),
    corrected(
        19,
        "∂E_Λ^K/∂s_K",
        "∂E_Λ^K/∂s_i^K = W_ij^K λ_j^K",
        "∂E_Λ^K/∂s_i^K = W_ji^K λ_j^K",
        "W_K is 9×6: its transpose is wanted, as in (29)",
    ),
    holds(20, "∂E_Λ^K/∂λ_K", "∂E_Λ^K/∂λ_i^K = W_ij^K s_j^K - J_ij^K x_j"),
    holds(21, "∂²E_Λ^K/∂λ_K∂s_K", "∂²E_Λ^K/∂λ_i^K∂s_j^K = W_ij^K"),
    corrected(
        22,
        "∂²E_Λ^K/∂x∂λ_K",
        "∂²E_Λ^K/∂x_i∂λ_k^K = J_ij (Ŵ_jkl^K s_l^K - I_jk)",
        "∂²E_Λ^K/∂x_i∂λ_k^K = J_ji^K (Ŵ_jkl^K s_l^K - I_jk)",
        "as (18)",
    ),
    corrected(
        23,
        "∂²E_Λ^K/∂x∂s_K",
        "∂²E_Λ^K/∂x_i∂s_l^K = J_ij Ŵ_jkl^K λ_k^K",
        "∂²E_Λ^K/∂x_i∂s_l^K = J_ji^K Ŵ_jkl^K λ_k^K",
        "as (18)",
    ),
    corrected(
        24,
        "∂²E_Λ^K/∂x²",
        "∂²E_Λ^K/∂x_i² = i'll get around to it",
        "∂²E_Λ^K/∂x_p∂x_q = J_(ij)p (Ω_aij N_ab Ω_bkl - Ω_aij L_akl - L_aij Ω_akl) J_(kl)q\n"
        "(S_F)_ij = R_ki F_kj\n"
        "T_ab = E_aij E_bik (S_F)_kj\n"
        "Ω_aij = (T⁻¹)_ab R_ik E_bkj\n"
        "M_ij = R_ki Λ_kl S_lj\n"
        "Q_ij = (T⁻¹)_ab E_akl M_kl E_bij\n"
        "N_ab = E_aij (S_F)_jk E_bil Q_lk - E_aij E_bik M_kj\n"
        "L_aij = E_akj Q_kl R_il",
        "the seed leaves it open and then drops it, which makes Newton's method linear. E_a are "
        "the generators of rotations, Ω_a : δF is the rotation ω_a that δF makes, L_a : δF is E_a "
        ": (Q Rᵀ δF); demos/by_hand/rotation.py derives it",
    ),
    Erratum(25, "nothing", "not comparable", "", "a number without an equation"),
)
"""One record per numbered equation, in order."""
