"""Function spaces and functions, sparing with communicators.

DOLFINx gives each space a communicator of its own and, on several ranks, two more to each vector.
MPICH has 2048. So there is one space of an element on a mesh for as long as anyone has it, and the
vectors of a space share their communicators.
"""

from __future__ import annotations

import weakref
from collections.abc import Hashable
from typing import Any

from dolfinx import fem, la, mesh

_spaces: weakref.WeakValueDictionary[tuple[int, Hashable], fem.FunctionSpace] = (
    weakref.WeakValueDictionary()
)


def function_space(msh: mesh.Mesh, element: Any) -> fem.FunctionSpace:
    """Return the space of an element on a mesh, the one that there is if there is one. Collective.

    Args:
        msh: The mesh.
        element: What `dolfinx.fem.functionspace` takes.
    """
    key = id(msh._cpp_object), element  # which a space keeps alive
    known = _spaces.get(key)
    # The garbage collector may have taken it on some ranks only.
    if not all(msh.comm.allgather(known is not None)):
        known = fem.functionspace(msh, element)
        _spaces[key] = known
    assert known is not None
    return known


def function(V: fem.FunctionSpace, name: str | None = None) -> fem.Function:
    """Return a function that is zero. Collective.

    Args:
        V: Its space.
        name: Its name.
    """
    return fem.Function(V, zeros(V), name=name)


def zeros(V: fem.FunctionSpace) -> la.Vector:
    """Return a vector of zeros for the degrees of freedom of a space, ghosts included. Collective.

    It shares its communicators with the other vectors of the space: none may be in the middle of
    an exchange while another begins one.
    """
    kept = vars(V)
    if "_zeros" not in kept:
        kept["_zeros"] = la.vector(V.dofmap.index_map, V.dofmap.index_map_bs)
    origin = kept["_zeros"]._cpp_object
    return la.Vector(type(origin)(origin))
