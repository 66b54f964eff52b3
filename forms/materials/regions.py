"""Different materials in different cells."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import ufl
from dolfinx import fem, mesh
from ufl.core.expr import Expr

from forms.materials.base import Material, StrainEnergy


def by_tag(
    msh: mesh.Mesh, tags: mesh.MeshTags, materials: Mapping[int, StrainEnergy]
) -> StrainEnergy:
    """Return the strain energy density that is `materials[tag]` on the cells with that tag.

    Materials that differ in E and ν alone become one, with Lamé parameters that are constant on
    each cell. Of the others each cell evaluates its own only, so that none is asked for a stretch
    of another's cells at which it has no value.

    Args:
        msh: The mesh.
        tags: Tags of all owned and ghost cells.
        materials: Materials by tag.

    Raises:
        ValueError: A cell has no material. Says which tags have none; on the ranks with such cells.
    """
    groups: dict[object, dict[int, StrainEnergy]] = {}
    for tag, material in materials.items():
        groups.setdefault(_family(material), {})[tag] = material
    number = cell_values(
        msh, tags, {tag: k for k, members in enumerate(groups.values()) for tag in members}
    )
    laws: list[StrainEnergy] = []
    for members in groups.values():
        first = next(iter(members.values()))
        if isinstance(first, Material) and len(members) > 1:
            laws.append(_with_parameters(msh, tags, members, first, list(materials)))
        else:
            laws.append(first)

    def psi(S: Expr) -> Expr:
        energy = laws[-1](S)
        for k, law in enumerate(laws[:-1]):
            energy = ufl.conditional(ufl.lt(abs(number - k), 0.5), law(S), energy)
        return energy

    return psi


def cell_values(msh: mesh.Mesh, tags: mesh.MeshTags, values: Mapping[int, float]) -> fem.Function:
    """Return the DG0 function that is `values[tag]` on the cells with that tag.

    Args:
        msh: The mesh.
        tags: Tags of all owned and ghost cells.
        values: A value for each tag.

    Raises:
        ValueError: A cell has no value. Says which tags have none; on the ranks with such cells.
    """
    space = fem.functionspace(msh, ("DG", 0))
    f = fem.Function(space)
    f.x.array[:] = np.nan
    for tag, value in values.items():
        f.x.array[space.dofmap.list[tags.find(tag), 0]] = value
    if np.isnan(f.x.array).any():
        bare = sorted(set(tags.values.tolist()) - set(values)) or "none at all"
        raise ValueError(f"cells tagged {bare} are given nothing; there is {sorted(values)}")
    return f


def _family(psi: StrainEnergy) -> object:
    """What materials have in common that differ in E and ν alone."""
    if not isinstance(psi, Material):
        return id(psi)
    return type(psi), *(v for k, v in vars(psi).items() if k not in ("E", "nu"))


def _with_parameters(
    msh: mesh.Mesh,
    tags: mesh.MeshTags,
    members: Mapping[int, StrainEnergy],
    law: Material,
    all_tags: list[int],
) -> StrainEnergy:
    """One law with Lamé parameters by cell; on the cells of other laws, its own."""
    mu, lam = (
        cell_values(msh, tags, {tag: getattr(members.get(tag, law), name) for tag in all_tags})
        for name in ("mu", "lam")
    )
    return lambda S: law.strain_energy(S, mu, lam)
