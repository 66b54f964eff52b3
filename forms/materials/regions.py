"""Different materials in different cells."""

from __future__ import annotations

from collections.abc import Mapping

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.materials.base import Material, StrainEnergy
from forms.spaces import function, function_space


def by_tag(
    msh: mesh.Mesh, tags: mesh.MeshTags, materials: Mapping[int, StrainEnergy]
) -> StrainEnergy:
    """Return the strain energy density that is `materials[tag]` on the cells with that tag.

    Collective.

    Materials that differ in E and ν alone become one, with Lamé parameters that are constant on
    each cell. Others are summed, Σₖ χₖ Ψₖ(I + χₖ (S - I)) with χₖ = 1 on the cells of Ψₖ and 0
    elsewhere, where Ψₖ sees no stretch at which it might have no value.

    Args:
        msh: The mesh.
        tags: Tags of all owned and ghost cells.
        materials: Materials by tag.

    Raises:
        ValueError: On all ranks: a cell has no material. Says which tags have none.
    """
    families: dict[object, dict[int, StrainEnergy]] = {}
    for tag, material in materials.items():
        families.setdefault(_family(material), {})[tag] = material
    indicators = [
        cell_values(msh, tags, {tag: float(tag in members) for tag in materials})
        for members in families.values()
    ]
    laws = [_one_law(msh, tags, members, materials) for members in families.values()]
    if len(laws) == 1:
        return laws[0]

    def psi(S: Expr) -> Expr:
        I = ufl.Identity(S.ufl_shape[0])  # noqa: E741
        return sum(chi * law(I + chi * (S - I)) for chi, law in zip(indicators, laws, strict=True))

    return psi


def cell_values(msh: mesh.Mesh, tags: mesh.MeshTags, values: Mapping[int, float]) -> fem.Function:
    """Return the DG0 function that is `values[tag]` on the cells with that tag. Collective.

    Args:
        msh: The mesh.
        tags: Tags of all owned and ghost cells.
        values: A value for each tag.

    Raises:
        ValueError: On all ranks: a cell has no value. Says which tags have none.
    """
    space = function_space(msh, ("DG", 0))
    f = function(space)
    f.x.array[:] = np.nan
    for tag, value in values.items():
        f.x.array[space.dofmap.list[tags.find(tag), 0]] = value
    used = msh.comm.allgather(set(tags.values.tolist()))
    bare = sorted(set.union(*used) - set(values))
    if bare:
        raise ValueError(
            f"cells tagged {bare} are given nothing; the tags given are {sorted(values)}"
        )
    if msh.comm.allreduce(bool(np.isnan(f.x.array).any()), MPI.LOR):
        raise ValueError("some cells have no tag; each needs one")
    return f


def _family(psi: StrainEnergy) -> object:
    """What materials have in common that differ in E and ν alone."""
    if not isinstance(psi, Material):
        return id(psi)
    return type(psi), *(v for k, v in vars(psi).items() if k not in ("E", "nu"))


def _one_law(
    msh: mesh.Mesh,
    tags: mesh.MeshTags,
    members: Mapping[int, StrainEnergy],
    materials: Mapping[int, StrainEnergy],
) -> StrainEnergy:
    """The materials of a family as one; on the cells of other families, with any parameters."""
    law = next(iter(members.values()))
    if not isinstance(law, Material) or len(members) == 1:
        return law
    mu, lam = (
        cell_values(msh, tags, {tag: getattr(members.get(tag, law), name) for tag in materials})
        for name in ("mu", "lam")
    )
    return lambda S: law.strain_energy(S, mu, lam)
