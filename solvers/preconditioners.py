"""PETSc options of the block preconditioners of `solver="fieldsplit"`.

A preconditioner eliminates the cell-local fields group by group, most often one field at a time:
for fields u, S, Lam first S, then Lam. Each elimination is a field split into the group and the
rest, the next one in the rest of the one before. The parts have options under their own prefixes:

    fieldsplit_S_                            the local blocks of S
    fieldsplit_u_Lam_                        their Schur complement, eq. (41)
    fieldsplit_u_Lam_fieldsplit_Lam_         the local blocks of Lam in it
    fieldsplit_u_Lam_fieldsplit_u_           the condensed matrix, the displacement's preconditioner

`"block-diagonal"` has one split with a part for each group: `fieldsplit_S_`, `fieldsplit_Lam_`,
`fieldsplit_u_`. With the displacement alone there is no split.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from solvers.options import (
    CONDENSED_CG,
    CONDENSED_DIRECT,
    FORCING_LIMITS,
    SCHUR_DIRECT_UP_TO,
    UNSYMMETRIC,
    Options,
)

INEXACT: Options = {
    # The linear tolerance follows the nonlinear residual (Eisenstat and Walker, 1996, choice 2).
    "snes_ksp_ew": True,
    "snes_ksp_ew_rtol0": FORCING_LIMITS[0],
    "snes_ksp_ew_rtolmax": FORCING_LIMITS[0],
    # Small enough that the last iteration, too, is as good as one of the exact Newton method.
    "snes_ksp_ew_gamma": 0.1,
    "ksp_max_it": 500,
}
"""How exactly the Newton system is solved."""

FGMRES: Options = {"ksp_type": "fgmres", "ksp_gmres_restart": 60}
"""Takes any preconditioner, also one that varies; keeps two vectors an iteration."""

GMRES: Options = {"ksp_type": "gmres", "ksp_gmres_restart": 60, "ksp_pc_side": "right"}
"""With the preconditioner on the right the residual that is tested is the true one."""

MINRES: Options = {"ksp_type": "minres"}
"""For symmetric systems with a positive definite preconditioner; keeps a few vectors in all."""

FULL: Options = {
    "pc_type": "fieldsplit",
    "pc_fieldsplit_type": "schur",
    # Forward and back substitution: exact if the local blocks and the Schur complement are.
    "pc_fieldsplit_schur_fact_type": "full",
    # The assembled Schur complement stands for the operator, which PETSc applies by the blocks.
    "pc_fieldsplit_schur_precondition": "user",
}
"""Each elimination as the full block factorisation."""

UPPER: Options = {**FULL, "pc_fieldsplit_schur_fact_type": "upper"}
"""Each elimination as the back substitution alone, with half the solves with local blocks."""

ADDITIVE: Options = {"pc_type": "fieldsplit", "pc_fieldsplit_type": "additive"}
"""The absolute values of the local blocks, after elimination, and the condensed matrix."""

LOCAL: Options = {
    "ksp_type": "preonly",
    # Exact: one block a cell.
    "pc_type": "vpbjacobi",
}
"""A field whose matrix has one point block a cell."""

LOCAL_GROUP: Options = {"ksp_type": "preonly", "pc_type": "python"}
"""Any other group of cell-local fields: inverses of its blocks, kept by the solver."""

MUMPS: Options = CONDENSED_DIRECT
"""LDLᵀ of the condensed matrix."""

_MULTIGRID = {key: value for key, value in CONDENSED_CG.items() if not key.startswith("ksp_")}

GAMG: Options = {
    **_MULTIGRID,
    "ksp_type": "preonly",
    # Smooth with the condensed matrix, not with the Schur complement block by block.
    "pc_use_amat": False,
    # Cycles are cheap beside an iteration on the whole system, so that strong ones pay.
    "pc_gamg_aggressive_coarsening": 0,
    "mg_levels_ksp_max_it": 4,
    "pc_mg_multiplicative_cycles": 2,
    # From one Newton iteration to the next the coarse spaces stay, their operators are made anew.
    "pc_gamg_reuse_interpolation": True,
}
"""Two cycles of algebraic multigrid on the condensed matrix, with rigid-body modes."""

GMRES_GAMG: Options = {
    # As a preconditioner, GMRES multiplies by the condensed matrix itself; as the solver of the
    # split it would apply the Schur complement block by block.
    "ksp_type": "preonly",
    "pc_type": "ksp",
    # Not CG, as the matrix may be indefinite.
    "ksp_ksp_type": "gmres",
    # A displacement is a twentieth of all unknowns in 3D: iterations here save dearer ones outside.
    "ksp_ksp_rtol": 1e-2,
    "ksp_ksp_max_it": 30,
    **{f"ksp_{key}": value for key, value in _MULTIGRID.items()},
}
"""A few iterations on the condensed matrix, a preconditioner that varies: for FGMRES."""


@dataclass(frozen=True)
class Preconditioner:
    """A block preconditioner.

    Attributes:
        description: One line.
        krylov: Options of the Krylov method.
        split: Options of each field split.
        nested: Whether each elimination is a split of its own, in the rest of the one before.
        displacement: Options of the displacement's block; of the condensed matrix.
    """

    description: str
    krylov: Options
    split: Options
    nested: bool
    displacement: Options

    @property
    def options(self) -> Options:
        """Options of the system if the displacement is all there is."""
        pc = {key: value for key, value in self.displacement.items() if not key.startswith("ksp_")}
        return {**pc, **self.krylov}

    @property
    def unsymmetric(self) -> bool:
        """Whether it can be of use where the Newton matrix is not symmetric."""
        return self.krylov is not MINRES

    def for_unsymmetric(self) -> Preconditioner:
        """The same for a matrix that is not symmetric: LU in the place of LDLᵀ."""
        if self.displacement is not MUMPS:
            return self
        return replace(self, displacement={**MUMPS, **UNSYMMETRIC["preonly"]})

    def split_options(
        self, parts: Sequence[Sequence[str]], point_blocks: Sequence[bool]
    ) -> Options:
        """Options of the system and of each split.

        Args:
            parts: Names of the parts of each split, the displacement's last.
            point_blocks: Whether each group of cell-local fields, in the order in which they are
                eliminated, is one field with one point block a cell.
        """
        options = dict(self.krylov)
        prefix = ""
        local = iter(LOCAL if point else LOCAL_GROUP for point in point_blocks)
        for *groups, rest in parts:
            options |= _prefixed(prefix, self.split)
            for group in groups:
                options |= _prefixed(f"{prefix}fieldsplit_{group}_", next(local))
            prefix += f"fieldsplit_{rest}_"
            options[f"{prefix}ksp_type"] = "preonly"
        return {**options, **_prefixed(prefix, self.displacement)}


def _prefixed(prefix: str, options: Options) -> Options:
    return {f"{prefix}{key}": value for key, value in options.items()}


_FULL = "full block factorisation, FGMRES"
_TRIANGULAR = "block-triangular, GMRES"
_DIAGONAL = "block-diagonal, MINRES"
PRECONDITIONERS: Mapping[str, Preconditioner] = {
    "schur-full-mumps": Preconditioner(f"{_FULL}; LDLᵀ of K", FGMRES, FULL, True, MUMPS),
    "schur-full-gamg": Preconditioner(f"{_FULL}; two GAMG cycles on K", FGMRES, FULL, True, GAMG),
    "schur-full-gmres": Preconditioner(
        f"{_FULL}; GMRES with GAMG on K", FGMRES, FULL, True, GMRES_GAMG
    ),
    "block-triangular-mumps": Preconditioner(
        f"{_TRIANGULAR}; LDLᵀ of K", GMRES, UPPER, True, MUMPS
    ),
    "block-triangular-gamg": Preconditioner(
        f"{_TRIANGULAR}; two GAMG cycles on K", GMRES, UPPER, True, GAMG
    ),
    "block-diagonal-mumps": Preconditioner(
        f"{_DIAGONAL}; LDLᵀ of K", MINRES, ADDITIVE, False, MUMPS
    ),
    "block-diagonal-gamg": Preconditioner(
        f"{_DIAGONAL}; two GAMG cycles on K", MINRES, ADDITIVE, False, GAMG
    ),
}
"""Preconditioners by name; K is the condensed matrix. "schur-full" stands for the first on small
problems and for the third on large ones."""

BY_SIZE = "schur-full"
"""The name that stands for a choice by size."""


def find(name: str, unknowns: int) -> Preconditioner:
    """The preconditioner of a name.

    Args:
        name: One in `PRECONDITIONERS`, or "schur-full".
        unknowns: Degrees of freedom of the displacement.

    Raises:
        ValueError: There is none of that name.
    """
    if name == BY_SIZE:
        name = "schur-full-mumps" if unknowns <= SCHUR_DIRECT_UP_TO else "schur-full-gmres"
    if name not in PRECONDITIONERS:
        known = ", ".join([BY_SIZE, *PRECONDITIONERS])
        raise ValueError(f"preconditioner is {name!r}; available: {known}")
    return PRECONDITIONERS[name]
