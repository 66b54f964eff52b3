"""Answers to the remarks left in the seed, in bold, and to some questions beside them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Remark:
    """A question that the seed leaves open, and its answer.

    Attributes:
        topic: What it is about.
        equations: Numbers of the equations that it concerns.
        quote: The words of the seed.
        answer: A paragraph.
    """

    topic: str
    equations: tuple[int, ...]
    quote: str
    answer: str


REMARKS: tuple[Remark, ...] = (
    Remark(
        "time before space",
        (1, 2),
        "this is a funny semi-discretization - we've discretized in time so far – using Backwards "
        "Euler but not space - notice a lot of FE papers do the opposite to get an ODE first by "
        "discretizing in space first. No reason we need to start with this vs the other - right?",
        "Right: on a mesh that stays as it is the two commute. Finite elements replace x(X) by Σ_a "
        "x_a N_a(X) and integrate over the body; backward Euler replaces derivatives by time with "
        "differences of the same coefficients. Either order gives (2), with the M that integrates "
        "ρ N_a N_b. Time first has the better formula: each step is the stationary point of one "
        "functional, which any element may discretise, and which UFL takes as it stands.",
    ),
    Remark(
        "a fully continuous start",
        (1,),
        "Also we could propose the setup in the fully continuous setting first too - right?",
        "Yes. Make the action ∫∫ ρ/2 |ẋ|² + ρ f_ext · x - Ψ(S) + Λ : (R(x) S - F(x)) dV dt "
        "stationary. By x this is ρ ẍ = ρ f_ext + div P, where P = Λ - ∂(Λ : R(F) S)/∂F with S "
        "held fixed, by S it is ∂Ψ/∂S = sym(RᵀΛ), by Λ it is F = R S. Where skew(RᵀΛ) = 0 and S "
        "commutes with RᵀΛ, as for isotropic Ψ, P is Λ. Put ẍ ≈ (x - x̃)/h² + f_ext: what is "
        "stationary then is (1).",
    ),
    Remark(
        "R as a projection",
        (14,),
        "Where specifically we have R(F(x)) to indicate R is a projection of the deformation "
        "gradient onto SO(3).",
        "It is the rotation nearest to F, so tr(Rᵀ F) is the largest there is. In inverted cells "
        "that is not the orthogonal factor of the usual polar decomposition, a reflection: (14) "
        "needs the signed singular values. The projection is unique unless σ₂ + σ₃ = 0, the last "
        "with its sign.",
    ),
    Remark(
        "notation: indices and volumes",
        (2, 14, 15),
        "can we use lower case for indexing? [...] V_K is just a scalar - right? If so can we make "
        "it lower case?",
        "Both would be better. V_K is the volume of cell K, a number, and a matrix in (14) and "
        "(15). F is the deformation gradient up to (17) and a block from (32) on, λ a multiplier, "
        "old or new, and in materials a Lamé parameter, g_x a displacement in (9) and a force in "
        "(27). A lower-case cell e with volume v_e, and other letters for the blocks, would end "
        "that. The errata keep the seed's letters, so that each line can be found in it.",
    ),
    Remark(
        "notation: dependencies",
        (3, 5, 28),
        "More messy looking but I'd prefer to write those dependencies out explicitly in our "
        "energies to avoid bugs and misunderstanding downstream.",
        "The fear was justified. W_K means W_K(F_K(x^t + δx)) in (5) and W_K(F_K(x^t)) from (18) "
        "on. S_K, the unknown, does not depend on x, while S(F_K), the stretch of F_K, does: in "
        "(17) S is held fixed, and what changes with F is R alone. Code keeps them apart by where "
        "it reads them from: R and S_F from the positions, s_K from the unknowns.",
    ),
    Remark(
        "linear or quadratic",
        (6, 13, 26),
        "Last two sentences are a bit contradictory I think? Newton process is no more/no less "
        "than just forming a quadratic approximation (not linear) via taylor expansion and then "
        "solving it.",
        "They say the same of two things. A quadratic model of the energy, made stationary, and a "
        "linear model of its gradient, set to zero, are one linear system, (35). The model has to "
        "be complete to second order for that to be Newton's method: (26) drops ∂²c/∂x², which "
        "keeps the limit and makes convergence linear; with (24) it is quadratic.",
    ),
    Remark(
        "whether the δ are needed",
        (5, 27),
        "Also, for creating a Newton solver there's no need to create this bunch of extra δ terms "
        "in the above and below.",
        "They are not: K δ = -∂E is all, with the derivatives of (2) at the iterate, and that is "
        "what UFL does. (26) and (27) are one equation with and without them. What the derivation "
        "gains is the new multiplier λ in place of δλ: E is linear in λ, so that λ^t leaves the "
        "right-hand side and stays in F, and in (24), alone.",
    ),
    Remark(
        "sign of Λ",
        (1, 6, 19),
        "E(x, s, λ) = E_M(x) + E_Ψ(s) - E_Λ(x, s, λ)",
        "The minus belongs to E_Λ = Λ : (R S - F), so that F enters E with +Λ : F, and Λ is the "
        "first Piola-Kirchhoff stress with a plus: ∂E/∂s = 0 reads ∂Ψ/∂S = sym(RᵀΛ), and for "
        "isotropic Ψ R ∂Ψ/∂S is P. With E_M + E_Ψ + E_Λ it would be -P, and F, G and D would "
        "change their signs, which is why those of (32)-(34) look as they do.",
    ),
    Remark(
        "arg min of a saddle point",
        (2,),
        "x^{t+1}, s^{t+1}, λ^{t+1} = arg min_{x,s,λ}",
        "A multiplier is never minimised over: the energy is linear in it. (2) has neither "
        "minimum nor maximum; its stationary points are saddle points, and its Hessian, (35) with "
        "(24), has eigenvalues of both signs. What one may minimise is E_M(x) + Ψ(S(F(x))), over "
        "x alone; it has the same stationary points.",
    ),
    Remark(
        "consistent or lumped M",
        (2, 7, 9),
        "M is the mass matrix for our mesh",
        "Consistent: (1) integrates ρ |x - x̃|², which for linear elements is ρ V_K (1 + δ_ab)/20 "
        "on a tetrahedron, and nothing else is a discretisation of (1) with exact integrals. "
        "Lumping, the row sums on the diagonal, is another rule of integration, with the vertices "
        "as points. Nothing from (7) to (41) would change but the numbers in M: of M only its "
        "symmetry is used.",
    ),
    Remark(
        "section 5",
        (41,),
        "The various numerical methods: todo",
        "demos/numerical_methods.py is that section: (35) by LU, its Schur complements, static "
        "condensation, Gauss-Newton, a lagged rotation, the displacement alone, globalisations, a "
        "constant matrix; what each costs, and where it fails. demos/block_preconditioners.py goes "
        "from (35) to (41) and on to the matrix of the displacement alone, by options of PETSc's "
        "field splits, and holds each matrix against a Schur complement.",
    ),
)
"""In the order of the seed, then those without bold face."""
