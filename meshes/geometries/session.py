"""gmsh as a maker of meshes: silent, deterministic, and gone when the mesh is made."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import meshio.gmsh
import numpy as np

from meshes.errors import MeshError
from meshes.formats.listing import Block, Listing

# One thread and a fixed seed: the same mesh each time.
_OPTIONS = {
    "General.Terminal": 0.0,
    "General.NumThreads": 1.0,
    "Mesh.MaxNumThreads1D": 1.0,
    "Mesh.MaxNumThreads2D": 1.0,
    "Mesh.MaxNumThreads3D": 1.0,
    "Mesh.RandomSeed": 1.0,
    "Mesh.ElementOrder": 1.0,
    "Mesh.Algorithm": 6.0,  # frontal Delaunay
    "Mesh.Algorithm3D": 1.0,  # Delaunay
    "Mesh.MeshSizeFromPoints": 0.0,
    "Mesh.MeshSizeMin": 0.0,
    "Mesh.MeshSizeFromCurvature": 10.0,  # elements a turn
}
# Beyond this number of cells, about, a mesh size is an oversight.
_MOST_CELLS = 5e7


@contextlib.contextmanager
def model(name: str, h: float) -> Iterator[Any]:
    """Start gmsh with an empty model, to be used on one rank.

    gmsh prints to the terminal and takes over Ctrl-C unless told otherwise.

    Args:
        name: Of the geometry, for messages.
        h: Size of an element [m].

    Raises:
        MeshError: gmsh is not installed or cannot be loaded, or it fails at the geometry.
    """
    try:
        import gmsh
    except ModuleNotFoundError as e:
        raise MeshError("needs gmsh, which is not installed (pip install gmsh)") from e
    except OSError as e:  # the wheel loads libraries of X11 and OpenGL
        raise MeshError(f"needs gmsh, which cannot be loaded ({e})") from e
    mine = not gmsh.isInitialized()
    if mine:
        gmsh.initialize(argv=[], readConfigFiles=False, run=False, interruptible=False)
    options = {**_OPTIONS, "Mesh.MeshSizeMax": h}
    former = {option: gmsh.option.getNumber(option) for option in options}
    other = gmsh.model.getCurrent()
    try:
        for option, value in options.items():
            gmsh.option.setNumber(option, value)
        gmsh.model.add(f"mixed-fem {name}")
        yield gmsh
        gmsh.model.remove()
    except MeshError:
        raise
    except Exception as e:  # gmsh has no class of its own
        said = " ".join(str(e).split()) or type(e).__name__
        raise MeshError(f"gmsh cannot make it ({said})") from e
    finally:
        if mine:
            gmsh.finalize()
        else:
            for option, value in former.items():
                gmsh.option.setNumber(option, value)
            gmsh.model.setCurrent(other)


def listing(gmsh: Any, d: int) -> Listing:
    """The mesh of the model, with physical groups; without vertices of no cell."""
    numbers, points, _ = gmsh.model.mesh.getNodes()
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    place = np.full(int(max(numbers, default=0)) + 1, -1, dtype=np.int64)
    place[np.asarray(numbers, dtype=np.int64)] = np.arange(len(numbers))
    names, blocks = {}, []
    for dim, number in gmsh.model.getPhysicalGroups():
        names[dim, number] = gmsh.model.getPhysicalName(dim, number)
    for dim, entity in gmsh.model.getEntities():
        physical = gmsh.model.getPhysicalGroupsForEntity(dim, entity)
        if dim < d and not len(physical):
            continue
        kinds, _, vertices = gmsh.model.mesh.getElements(dim, entity)
        for kind, rows in zip(kinds, vertices, strict=True):
            _, _, _, size, _, _ = gmsh.model.mesh.getElementProperties(kind)
            elements = place[np.asarray(rows, dtype=np.int64).reshape(-1, size)]
            tags = np.tile(np.asarray([*physical] or [0], dtype=np.int64), (len(elements), 1))
            blocks.append(Block(meshio.gmsh.gmsh_to_meshio_type[int(kind)], elements, tags))
    cells = [b.elements.ravel() for b in blocks if b.elements.shape[1] > d]
    used = np.unique(np.concatenate(cells)) if cells else np.empty(0, dtype=np.int64)
    place = np.full(len(points), -1, dtype=np.int64)
    place[used] = np.arange(len(used))
    for block in blocks:
        block.elements = place[block.elements]
    return Listing(points[used], blocks, names)


def mesh(gmsh: Any, d: int, h: float) -> None:
    """Mesh what has been drawn, unless that is done.

    Raises:
        MeshError: It would make far too many cells.
    """
    if len(gmsh.model.mesh.getNodes()[0]):
        return
    volume = sum(gmsh.model.occ.getMass(dim, entity) for dim, entity in gmsh.model.getEntities(d))
    cells = volume / h**d * (2.3 if d == 2 else 8.5)  # regular ones with edges h
    if cells > _MOST_CELLS:
        raise MeshError(f"h = {h:g}: would make about {cells:.0e} cells")
    gmsh.model.mesh.generate(d)
    if d == 3:
        gmsh.model.mesh.optimize("Netgen")


def name_group(
    gmsh: Any, dim: int, name: str, inside: Callable[[float, float, float], bool]
) -> None:
    """Make a group of the entities whose centre of mass is where the function says."""
    chosen = [
        entity
        for dim, entity in gmsh.model.getEntities(dim)
        if inside(*gmsh.model.occ.getCenterOfMass(dim, entity))
    ]
    gmsh.model.addPhysicalGroup(dim, chosen, name=name)
