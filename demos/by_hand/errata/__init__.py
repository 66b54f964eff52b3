"""Which numbered equations of the seed hold as printed, and what holds in place of the others.

The texts are evaluated, not only read: `symbols` says what each letter stands for, `formula` works
out a formula from its text, and the comparison and the tests hold the result against derivatives.
"""

from demos.by_hand.errata.energies import ENERGIES
from demos.by_hand.errata.formula import FormulaError, evaluate
from demos.by_hand.errata.record import Erratum, Verdict
from demos.by_hand.errata.remarks import REMARKS, Remark
from demos.by_hand.errata.symbols import EVALUATED, INDICES, Letters
from demos.by_hand.errata.system import SYSTEM

ERRATA: tuple[Erratum, ...] = ENERGIES + SYSTEM
"""One record per numbered equation, in order."""

READING = (
    "'Holds as printed' is said of an equation that is true wherever all of its terms are defined, "
    "in every Newton iteration; 'corrected' of one in which a symbol has to change.",
    "λ^t is the old multiplier, λ in (26)-(41) the new one, λ^t + δλ. The indices of Ŵ are entry "
    "of F, entry of R S, dof of S, the one order in which (18)-(33) make sense.",
    "Volumes: g_s, H and c without an index K are derivatives of E_Ψ and E_Λ, by (27), and contain "
    "V_K. What carries an index K, in (10), (11), (18)-(24) and (28)-(31), is per unit volume, as "
    "E_Λ^K = λ_K · c_K is. Read so, (34) alone lacks a volume.",
)
"""How the verdicts are meant, and how the equations are read."""

__all__ = [
    "ERRATA",
    "EVALUATED",
    "INDICES",
    "READING",
    "REMARKS",
    "Erratum",
    "FormulaError",
    "Letters",
    "Remark",
    "Verdict",
    "evaluate",
]
