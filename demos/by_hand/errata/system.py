"""Equations (26)-(41), sections 3 and 4 of the seed: the model of the energy, Newton's system."""

from __future__ import annotations

from demos.by_hand.errata.record import Erratum, corrected, holds

SYSTEM: tuple[Erratum, ...] = (
    holds(
        26,
        "quadratic model of E without ∂²c/∂x²",
        "Ẽ(x, s, λ) = E_M(x^t) + E_Ψ(s^t) + (x - x^t)ᵀ (∂E_M/∂x) + (s - s^t)ᵀ (∂E_Ψ/∂s) - λᵀ "
        "c(x^t, s^t) - (x - x^t)ᵀ (∂/∂x (∂c/∂s λ^t)) (s - s^t) - (x - x^t)ᵀ (∂c/∂x) (λ) - (s - "
        "s^t)ᵀ (∂c/∂s) (λ) + ½ (s - s^t)ᵀ (∂²E_Ψ/∂s²) (s - s^t) + ½ (x - x^t)ᵀ (∂²E_M/∂x²) (x - "
        "x^t)",
        "as the model that it is said to be: its remainder is of second order in δx, of third with "
        "the -½ δxᵀ (24) δx of the display before it. Of the second derivatives of c only ∂²c/∂x² "
        "is dropped, not ∂²c/∂x∂s",
    ),
    holds(
        27,
        "the same in increments",
        "Ẽ(x, s, λ) = E_M(x^t) + E_Ψ(s^t) + δxᵀ (∂E_M/∂x) + δsᵀ (∂E_Ψ/∂s) - λᵀ c(x^t, s^t) - δxᵀ "
        "(∂/∂x (∂c/∂s λ^t)) δs - (δxᵀ ∂c/∂x + δsᵀ ∂c/∂s) λ + ½ δsᵀ (∂²E_Ψ/∂s²) δs + ½ δxᵀ "
        "(∂²E_M/∂x²) δx = E_M(x^t) + E_Ψ(s^t) + δxᵀ g_x^t + δsᵀ g_s^t - λᵀ c(x^t, s^t) - δxᵀ (∂/∂x "
        "(∂c/∂s λ^t)) δs - (δxᵀ ∂c/∂x + δsᵀ ∂c/∂s) λ + ½ δsᵀ H^t δs + 1/(2h²) δxᵀ M δx",
        "its two forms say what g_x, g_s and H are from here on: ∂E_M/∂x, ∂E_Ψ/∂s and ∂²E_Ψ/∂s², "
        "with the volumes in them. They are not the g_x of (9), g_K and H_K of (10)",
    ),
    holds(
        28,
        "∂Ẽ/∂δx",
        "∂Ẽ/∂δx = 1/h² M δx + g_x^t - Σ_{K∈T} (J_Kᵀ (Ŵ_K^t · λ_K^t) δs_K + J_Kᵀ (Ŵ_K^t · s_K^t - "
        "I) λ_K) V_K",
        "what the line above it omits is ∂/∂x (∂c_K/∂x λ_K^t) δx; λ is missing there",
    ),
    holds(
        29,
        "∂Ẽ^K/∂δs_K",
        "∂Ẽ^K/∂δs_K = g_{s_K}^t + H_K^t δs_K - W_K^tᵀ λ_K - (Ŵ_K^t · λ_K^t)ᵀ J_K δx",
        "per unit volume; (28) is not",
    ),
    corrected(
        30,
        "δs_K from (29)",
        "δs_K = H_K^t⁻¹ (W_K^tᵀ λ_K + (Ŵ_K^t · λ_K^t)ᵀ J_K δx - g_s^t)",
        "δs_K = H_K^t⁻¹ (W_K^tᵀ λ_K + (Ŵ_K^t · λ_K^t)ᵀ J_K δx - g_{s_K}^t)",
        "g_s is bold in print, the vector of all cells, in an equation of one. H_K has to be "
        "regular. That of stable neo-Hookean with ν = 0.3 at S = a I is singular at a = 0.203, "
        "0.793 and 1.297, and indefinite between the first two and beyond the last",
    ),
    corrected(
        31,
        "∂Ẽ^K/∂λ_K",
        "∂Ẽ^K/∂λ_K = -c_K(x^t, s^t) - (δxᵀ ∂c_K/∂x + δsᵀ ∂c_K/∂s) = -c_K(x^t, s^t) - (Ŵ_K^t · "
        "s_K^t - I)ᵀ J_K δx - W_K^t δs",
        "∂Ẽ^K/∂λ_K = -c_K(x^t, s^t) - (δxᵀ ∂c_K/∂x + δs_Kᵀ ∂c_K/∂s_K)ᵀ = -c_K(x^t, s^t) - (Ŵ_K^t · "
        "s_K^t - I)ᵀ J_K δx - W_K^t δs_K",
        "δs is printed without its K, in both lines, and the bracket of the first is a row. Per "
        "unit volume",
    ),
    holds(
        32,
        "F",
        "F = -Σ_{K∈T} P_K^sᵀ ((Ŵ_K^t · λ_K^t)ᵀ J_K^w)",
        "J_K^w = V_K J_K. This F is no deformation gradient",
    ),
    holds(33, "G", "G = J^w - Σ_{K∈T} P_K^λᵀ ((Ŵ_K^t · s_K^t)ᵀ J_K^w)"),
    corrected(
        34,
        "D",
        "D = -Σ_{K∈T} P_K^λᵀ W_K^t P_K^s",
        "D = -Σ_{K∈T} P_K^λᵀ W_K^t P_K^s V_K",
        "F and G carry the volume, and g_s, H and c by (27): D alone lacks it",
    ),
    corrected(
        35,
        "the Newton system",
        "(1/h² M, Fᵀ, Gᵀ; F, H^t, Dᵀ; G, D, 0) (δx; δs; λ) = (-g_x^t; -g_s^t; c(x^t, s^t))",
        "(1/h² M + A_ε, Fᵀ, (G + G_ε)ᵀ; F, H^t, Dᵀ; G + G_ε, D, C_ε) (δx; δs; λ) = (r_ε - g_x^t; "
        "-g_s^t; c(x^t, s^t))",
        "signs and volumes are right, but the matrix is singular.\n"
        "Let n_a = R E_a with E_a skew. Rᵀ c = s - s_F is symmetric, so that n_a · c = 0 for all "
        "x and s. Derived by s that is Dᵀ n_a = 0. Derived by x it is n_a · ∂c = -∂n_a · c, zero "
        "where c = 0: at a feasible state, rest included, the n_a are null vectors, 3 a cell.\n"
        "At other states Gᵀ n_a is not zero. But Gᵀ takes the 3 n_e of the n_a to forces on n "
        "vertices that do no work in a translation or a dilation, which turn no cell. So at "
        "least 3 n_e - 3 n + 4 null vectors remain at every state, and the matrix of any real "
        "mesh of tetrahedra, with n_e > n, is singular always. Where it is regular, on one "
        "tetrahedron for one, these rows demand (tr(S - S_F) I - (S - S_F)) ω = 0: the step "
        "turns no cell.\n"
        "There are two exact cures. One is Λ = R Y with Y symmetric. The other, above, adds to "
        "the energy -(ε/2) |skew(RᵀΛ)|² V_K = -(ε/4) p_a p_a V_K with p_a = n_a : Λ, which holds "
        "skew(RᵀΛ) at zero and changes neither x, S nor sym(RᵀΛ). With ∂ = ∂/∂x its derivatives "
        "are\n"
        "A_ε = -(ε/2) Σ V_K (∂p_aᵀ ∂p_a + p_a ∂²p_a), G_ε = -(ε/2) Σ V_K (n_a ∂p_a + p_a ∂n_a),\n"
        "C_ε = -(ε/2) Σ V_K n_a n_aᵀ, r_ε = -(ε/2) Σ V_K p_a ∂p_aᵀ.\n"
        "The block C_ε alone, without A_ε, G_ε and r_ε, makes the matrix regular too and leads "
        "to the same limit, but slower: Newton's method with it is superlinear, not quadratic",
    ),
    holds(
        36,
        "δs eliminated",
        "δs = H^t⁻¹ (-g_s^t - Dᵀ λ - F δx)",
        "where H is regular, see (30)",
    ),
    holds(
        37,
        "first row with (36)",
        "(1/h² M - Fᵀ H⁻¹ F) δx + (Gᵀ - Fᵀ H⁻¹ Dᵀ) λ = Fᵀ H⁻¹ g_s^t - g_x^t",
        "where H is regular, see (30)",
    ),
    holds(
        38,
        "third row with (36)",
        "(G - D H⁻¹ F) δx - D H⁻¹ Dᵀ λ = c(x^t, s^t) + D H⁻¹ g_s^t",
        "where H is regular, see (30)",
    ),
    holds(39, "M̃", "M̃ = (1/h² M - Fᵀ H⁻¹ F)", "where H is regular, see (30)"),
    holds(40, "J̃", "J̃ = (G - D H⁻¹ F)", "where H is regular, see (30)"),
    corrected(
        41,
        "the reduced Newton system",
        "(M̃, J̃ᵀ; J̃, -D H⁻¹ Dᵀ) (δx; λ) = (Fᵀ H⁻¹ g_s^t - g_x^t; c(x^t, s^t) + D H⁻¹ g_s^t)",
        "(M̃ + A_ε, (J̃ + G_ε)ᵀ; J̃ + G_ε, C_ε - D H⁻¹ Dᵀ) (δx; λ) = (Fᵀ H⁻¹ g_s^t - g_x^t + r_ε; "
        "c(x^t, s^t) + D H⁻¹ g_s^t)",
        "where H is regular, see (30), the elimination is right; but the matrix inherits the null "
        "space of (35), D H⁻¹ Dᵀ having rank 6 of 9 in every cell at every state. The cures are "
        "those of (35); C_ε alone leads to the same limit in more iterations",
    ),
)
"""One record per numbered equation, in order."""
