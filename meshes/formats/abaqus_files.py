"""Input files of Abaqus and CalculiX, .inp: their nodes, elements, sets and surfaces.

A file is flat, or made of parts that number their nodes and elements each by itself and of
instances of these, which may be moved. Sets keep their names: node sets are for the boundary,
element sets for facets (shells, skins) and regions, surfaces for facets. Sets of one name in
several instances are one set; "INSTANCE.SET" is that of one instance, and the name of an instance
stands for its elements.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.formats.abaqus_keywords import Keyword, element_kind, integers, keywords, rows
from meshes.formats.listing import Block, Listing
from meshes.formats.numbers import places, whole
from meshes.groups import Integers

# Vertices of the faces S1, S2, ... of an element.
_FACES = {
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "hexahedron": (
        *((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1)),
        *((1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
    ),
}

Reals = npt.NDArray[np.float64]
Names = dict[str, Integers]


@dataclass
class _Set:
    """A set as it is written: numbers and names of other sets."""

    name: str
    keyword: Keyword
    numbers: Integers
    names: list[str]


@dataclass
class _Part:
    """Nodes, elements and sets that are numbered together."""

    name: str = ""
    nodes: list[tuple[Integers, Reals]] = field(default_factory=list)
    elements: list[tuple[str, Integers, Integers]] = field(default_factory=list)
    node_sets: list[_Set] = field(default_factory=list)
    element_sets: list[_Set] = field(default_factory=list)
    surfaces: list[Keyword] = field(default_factory=list)

    def take(self, keyword: Keyword) -> None:
        """Add what a keyword says, if it is about the mesh."""
        options = keyword.options
        if keyword.name == "NODE":
            if options.get("SYSTEM", "R").upper() != "R":
                raise MeshError(
                    "has nodes in cylindrical or spherical coordinates; write them in x, y, z"
                )
            found = rows(keyword)
            self.nodes.append((whole(found[:, 0], "for a node"), found[:, 1:]))
            if "NSET" in options:
                self.node_sets.append(_Set(options["NSET"], keyword, self.nodes[-1][0], []))
        elif keyword.name == "ELEMENT":
            kind, vertices = element_kind(keyword.option("TYPE"))
            numbers = integers(keyword)
            if len(numbers) % (1 + vertices):
                raise MeshError(
                    f"has {len(numbers)} numbers under *ELEMENT, TYPE={options['TYPE']}, where "
                    f"rows of {1 + vertices} are due"
                )
            table = numbers.reshape(-1, 1 + vertices)
            self.elements.append((kind, table[:, 0], table[:, 1:]))
            if "ELSET" in options:
                self.element_sets.append(_Set(options["ELSET"], keyword, table[:, 0], []))
        elif keyword.name == "NSET":
            self.node_sets.append(_Set(keyword.option("NSET"), keyword, *keyword.members()))
        elif keyword.name == "ELSET":
            self.element_sets.append(_Set(keyword.option("ELSET"), keyword, *keyword.members()))
        elif keyword.name == "SURFACE":
            self.surfaces.append(keyword)

    def with_(self, other: _Part) -> _Part:
        """This part and what an instance of it adds."""
        return _Part(
            self.name,
            self.nodes + other.nodes,
            self.elements + other.elements,
            self.node_sets + other.node_sets,
            self.element_sets + other.element_sets,
            self.surfaces + other.surfaces,
        )


@dataclass
class _Instance:
    """A part in its place."""

    name: str
    part: str
    placement: list[str]
    own: _Part = field(default_factory=_Part)


def load_abaqus(path: Path) -> Listing:
    """Read what the file lists. Vertices and elements keep its order, instance after instance."""
    whole, parts, instances = _model(path)
    listing = Listing(np.empty((0, 3)), [])
    places: dict[str, _Placed] = {}
    if instances:
        for instance in instances:
            part = parts.get(instance.part.upper(), None if instance.part else _Part())
            if part is None:
                raise MeshError(
                    f"has an instance of part {instance.part}, which it does not define"
                )
            placed = _Placed(listing, part.with_(instance.own), instance.name, instance.placement)
            places[instance.name.upper()] = placed
    else:
        for part in parts.values():
            places[part.name.upper()] = _Placed(listing, part, part.name)
    _Placed(listing, whole, "", (), places)
    return listing


def _model(path: Path) -> tuple[_Part, dict[str, _Part], list[_Instance]]:
    """What stands outside of parts, the parts by name, and the instances."""
    whole, parts, instances = _Part(), dict[str, _Part](), list[_Instance]()
    part: _Part | None = None
    instance: _Instance | None = None
    for keyword in keywords(path):
        if keyword.name == "PART":
            part = parts[keyword.option("NAME").upper()] = _Part(keyword.option("NAME"))
        elif keyword.name == "INSTANCE":
            instance = _Instance(
                keyword.option("NAME"), keyword.options.get("PART", ""), keyword.data
            )
            instances.append(instance)
        elif keyword.name == "END PART":
            part = None
        elif keyword.name == "END INSTANCE":
            instance = None
        elif instance is not None:
            instance.own.take(keyword)
        else:
            (whole if part is None else part).take(keyword)
    return whole, parts, instances


class _Placed:
    """A part whose nodes, elements and sets have been entered into a listing."""

    def __init__(
        self,
        listing: Listing,
        part: _Part,
        name: str,
        placement: list[str] | tuple[str, ...] = (),
        others: dict[str, _Placed] | None = None,
    ) -> None:
        self._listing, self._name = listing, name
        self._others = others or {}
        self._vertex_numbers, self._first_vertex = np.empty(0, dtype=np.int64), len(listing.points)
        self._element_numbers = np.empty(0, dtype=np.int64)
        self._first_element = sum(len(block.elements) for block in listing.blocks)
        if part.nodes:
            self._enter_nodes(part, placement)
        if part.elements:
            self._enter_elements(part)
        self._nodes: Names = {}
        self._elements: Names = {}
        for sets, found, vertices in (
            (part.element_sets, self._elements, False),
            (part.node_sets, self._nodes, True),  # which may be those of an element set
        ):
            for given in sets:
                self._enter_set(given, found, vertices)
        for surface in part.surfaces:
            self._enter_surface(surface)

    def _enter_nodes(self, part: _Part, placement: list[str] | tuple[str, ...]) -> None:
        d = max(points.shape[1] for _, points in part.nodes)
        points = np.concatenate([np.pad(x, ((0, 0), (0, d - x.shape[1]))) for _, x in part.nodes])
        points = _moved(np.pad(points, ((0, 0), (0, max(0, 3 - d)))), placement)
        self._vertex_numbers = np.concatenate([numbers for numbers, _ in part.nodes])
        self._listing.points = np.concatenate([self._listing.points, points])

    def _enter_elements(self, part: _Part) -> None:
        for kind, _, nodes in part.elements:
            vertices = _places(self._vertex_numbers, nodes, "node", "an element")
            self._listing.blocks.append(Block(kind, vertices + self._first_vertex))
        self._element_numbers = np.concatenate([numbers for _, numbers, _ in part.elements])
        every = np.arange(len(self._element_numbers)) + self._first_element
        self._publish(self._listing.element_sets, "", every)

    def _enter_set(self, given: _Set, found: Names, vertices: bool) -> None:
        instance = given.keyword.options.get("INSTANCE")
        scope = self if instance is None else self._others.get(instance.upper())
        if scope is None:
            raise MeshError(
                f"has a set {given.name} of instance {instance}, which it does not have"
            )
        members = [scope.numbered(given.numbers, vertices, f"the set {given.name}")]
        members += [scope.named(name, vertices, given.name) for name in given.names]
        if vertices and "ELSET" in given.keyword.options:
            elements = scope.named(given.keyword.options["ELSET"], False, given.name)
            members += [block.elements[here].ravel() for block, here in self._by_block(elements)]
        former = found.get(given.name.upper(), np.empty(0, dtype=np.int64))
        found[given.name.upper()] = np.unique(np.concatenate([former, *members]))
        if "INTERNAL" not in given.keyword.options:
            sets = self._listing.vertex_sets if vertices else self._listing.element_sets
            self._publish(sets, given.name, found[given.name.upper()])

    def _publish(self, sets: Names, name: str, members: Integers) -> None:
        """Under the name, with those of other parts, and under that with the part's before it."""
        keys = [name] if name else []
        if self._name:
            keys.append(f"{self._name}.{name}" if name else self._name)
        for key in keys:
            sets[key] = np.union1d(sets.get(key, np.empty(0, dtype=np.int64)), members)

    def numbered(self, numbers: Integers, vertices: bool, who: str) -> Integers:
        """Nodes or elements by their numbers in this part."""
        if vertices:
            return _places(self._vertex_numbers, numbers, "node", who) + self._first_vertex
        return _places(self._element_numbers, numbers, "element", who) + self._first_element

    def named(self, name: str, vertices: bool, who: str) -> Integers:
        """A set by its name, or "INSTANCE.SET", or "INSTANCE.NUMBER"."""
        sets = self._nodes if vertices else self._elements
        if name.upper() in sets:
            return sets[name.upper()]
        instance, dot, rest = name.rpartition(".")
        if dot and instance.upper() in self._others:
            scope = self._others[instance.upper()]
            if rest.isdecimal():
                return scope.numbered(np.array([int(rest)]), vertices, f"the set {who}")
            return scope.named(rest, vertices, who)
        raise MeshError(f"has a set {who} of a set {name}, which it does not define")

    def _enter_surface(self, surface: Keyword) -> None:
        name = surface.option("NAME")
        lines = [[word.strip() for word in line.split(",")] for line in surface.data]
        if surface.options.get("TYPE", "ELEMENT").upper() == "NODE":
            members = [self._member(line[0], True, name) for line in lines]
            self._publish(self._listing.vertex_sets, name, np.concatenate(members))
            return
        if surface.options.get("TYPE", "ELEMENT").upper() != "ELEMENT":
            return
        found: list[Integers] = []
        for chosen, side in ((line[0], (*line, "")[1].upper()) for line in lines):
            for block, here in self._by_block(self._member(chosen, False, name)):
                found += _faces(block, here, side)
        if found and len({facets.shape[1] for facets in found}) == 1:
            facets = np.concatenate(found)
            for key in (name, f"{self._name}.{name}") if self._name else (name,):
                others = [self._listing.facet_sets[key]] if key in self._listing.facet_sets else []
                self._listing.facet_sets[key] = np.concatenate([*others, facets])

    def _by_block(self, elements: Integers) -> Iterator[tuple[Block, Integers]]:
        """Some elements by the blocks that they are in, and their places there."""
        first = 0
        for block in self._listing.blocks:
            last = first + len(block.elements)
            yield block, elements[(elements >= first) & (elements < last)] - first
            first = last

    def _member(self, word: str, vertices: bool, who: str) -> Integers:
        if word.isdecimal():
            return self.numbered(np.array([int(word)]), vertices, f"the surface {who}")
        return self.named(word, vertices, who)


def _faces(block: Block, elements: Integers, side: str) -> list[Integers]:
    """Faces of some elements: one by its label, the element of a shell itself, or all free ones."""
    faces = _FACES.get(block.kind, ())
    corners = block.elements[elements]
    if not len(elements):
        return []
    if side in ("SPOS", "SNEG"):
        return [corners]
    if side == "":
        every = np.concatenate([corners[:, face] for face in faces])
        _, first, times = np.unique(
            np.sort(every, axis=1), axis=0, return_index=True, return_counts=True
        )
        return [every[np.sort(first[times == 1])]]
    if side[0] != "S" or not side[1:].isdecimal() or not 1 <= int(side[1:]) <= len(faces):
        raise MeshError(f"has a surface on side {side} of a {block.kind}, which that does not have")
    return [corners[:, faces[int(side[1:]) - 1]]]


def _places(numbers: Integers, named: Integers, noun: str, who: str) -> Integers:
    found = places(numbers, named)
    if (found < 0).any():
        raise MeshError(f"{who} names {noun} {named[found < 0].flat[0]}, which it does not define")
    return found


def _moved(points: Reals, placement: list[str] | tuple[str, ...]) -> Reals:
    """Translate, and then turn about an axis through two points by an angle in degrees."""
    values = [
        np.array([float(word) for word in line.split(",") if word.strip()]) for line in placement
    ]
    if values:
        points = points + np.pad(values[0], (0, 3))[:3]
    if len(values) > 1:
        if len(values[1]) != 7:
            raise MeshError("turns an instance by other than two points and an angle")
        start, stop, angle = values[1][:3], values[1][3:6], np.deg2rad(values[1][6])
        axis = (stop - start) / np.linalg.norm(stop - start)
        to = points - start
        along = np.outer(to @ axis, axis)
        points = start + along + np.cos(angle) * (to - along) + np.sin(angle) * np.cross(axis, to)
    return points
