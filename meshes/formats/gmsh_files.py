"""gmsh's .msh files, versions 2 and 4.1, as text or binary.

Version 2 lists an element once for each physical group that it is in. Version 4.1 lists it once,
under the geometric entity that it is part of, which may be in several groups.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import meshio.gmsh
import numpy as np
import numpy.typing as npt

from meshes.errors import MeshError
from meshes.formats.listing import Block, Listing, cell_kind
from meshes.formats.numbers import parsed, places, whole
from meshes.groups import Integers, repeated_rows

# gmsh's number of a kind of element: meshio's name, and how many vertices it has.
_KINDS = {
    15: ("vertex", 1),
    1: ("line", 2),
    2: ("triangle", 3),
    3: ("quad", 4),
    4: ("tetra", 4),
    5: ("hexahedron", 8),
}

Reals = npt.NDArray[np.float64]


def is_gmsh(path: Path) -> bool:
    """Whether a file is one that `load_gmsh` reads."""
    with path.open("rb") as file:
        start = file.read(200).split()
    return (
        start[:1] == [b"$MeshFormat"]
        and len(start) > 1
        and (start[1].startswith(b"2") or start[1] == b"4.1")
    )


def load_gmsh(path: Path) -> Listing:
    """Read what the file lists. Vertices and elements keep its order."""
    data = path.read_bytes()
    version, binary, size, order = _format(data)
    nodes, elements = _section(data, "Nodes"), _section(data, "Elements")
    if version.startswith("2"):
        numbers, points = _nodes_2(nodes, binary, order)
        blocks = _merged(_elements_2(elements, binary, order))
    else:
        numbers, points = _nodes_4(_Numbers(nodes, binary, size, order))
        groups: dict[tuple[int, int], list[int]] = {}
        for name in ("Entities", "PartitionedEntities"):
            text = _section(data, name, needed=False)
            if text:
                groups |= _groups_4(_Numbers(text, binary, size, order), name != "Entities")
        blocks = _elements_4(_Numbers(elements, binary, size, order), groups)
    for block in blocks:
        block.elements = _places(numbers, block.elements)
    return Listing(points, blocks, _names(_section(data, "PhysicalNames", needed=False)))


def _format(data: bytes) -> tuple[str, bool, int, str]:
    """Version, whether binary, bytes of a size_t, and the order of bytes."""
    text = _section(data, "MeshFormat")
    line, _, rest = text.partition(b"\n")
    words = line.decode("latin-1").split()
    if len(words) != 3 or not words[2].isdecimal():
        raise MeshError("has a $MeshFormat other than version, type and size")
    version, binary, size = words
    order = "<" if rest[:4] != b"\x00\x00\x00\x01" else ">"
    return version, binary == "1", int(size), order


def _section(data: bytes, name: str, needed: bool = True) -> bytes:
    """What stands between the lines $name and $Endname."""
    start = re.search(rb"^\$" + name.encode() + rb"[ \t]*\r?\n", data, re.MULTILINE)
    stop = -1 if start is None else data.find(b"$End" + name.encode(), start.end())
    if start is None or stop < 0:
        if needed:
            raise MeshError(f"has no section ${name} with an end")
        return b""
    return data[start.end() : stop]


def _names(text: bytes) -> dict[tuple[int, int], str]:
    """Names of physical groups by dimension and number."""
    found = re.findall(r'^\s*(\d+)\s+(-?\d+)\s+"(.*)"', text.decode(errors="replace"), re.MULTILINE)
    return {(int(dim), abs(int(number))): name for dim, number, name in found}


class _Numbers:
    """Numbers of a section, taken one after another, whether text or binary."""

    def __init__(self, data: bytes, binary: bool, size: int, order: str) -> None:
        self._at = 0
        self._data = data
        self._types = {"int": f"{order}i4", "size": f"{order}u{size}", "double": f"{order}f8"}
        self._text: Reals | None = None if binary else _parsed(data)

    def take(self, kind: str, count: int) -> npt.NDArray[np.number]:
        """The next numbers, of kind "int", "size" or "double"."""
        at = self._at
        if self._text is not None:
            self._at += count
            found = self._text[at : at + count]
        else:
            dtype = np.dtype(self._types[kind])
            self._at += count * dtype.itemsize
            found = np.frombuffer(self._data[at : self._at], dtype)
        if count < 0 or len(found) < count:
            raise MeshError("ends within its numbers")
        return found if kind == "double" else whole(found, "in a section of numbers")

    def one(self, kind: str) -> int:
        """The next number, which is whole."""
        return int(self.take(kind, 1)[0])


def _parsed(text: bytes) -> Reals:
    return parsed(text.decode("latin-1"), "in a section of numbers")


def _places(numbers: Integers, named: Integers) -> Integers:
    """Places in a list of the node numbers that elements name."""
    found = places(numbers, named)
    if (found < 0).any():
        strange = named[found < 0].flat[0]
        raise MeshError(f"an element names node {strange}, which the file does not list")
    return found


def _kind(number: int) -> tuple[str, int]:
    if number not in _KINDS:
        names: Mapping[int, str] = meshio.gmsh.gmsh_to_meshio_type
        cell_kind({names.get(number, f"{number} of gmsh")})
    return _KINDS[number]


def _counted(data: bytes, name: str) -> tuple[int, bytes]:
    """The number on the first line, and what follows."""
    line, _, rest = data.partition(b"\n")
    if not line.strip().isdigit():
        raise MeshError(f"has no number of its ${name}")
    return int(line), rest


def _nodes_2(data: bytes, binary: bool, order: str) -> tuple[Integers, Reals]:
    count, rest = _counted(data, "Nodes")
    if not binary:
        numbers = _parsed(rest)
        if len(numbers) != 4 * count:
            raise MeshError(f"has {len(numbers)} numbers where {count} nodes of 4 are due")
        rows = numbers.reshape(count, 4)
        return whole(rows[:, 0], "for a node"), rows[:, 1:]
    dtype = np.dtype([("number", f"{order}i4"), ("x", f"{order}f8", (3,))])
    found = np.frombuffer(rest[: count * dtype.itemsize], dtype)
    return found["number"].astype(np.int64), found["x"].astype(np.float64)


def _elements_2(data: bytes, binary: bool, order: str) -> list[Block]:
    """Runs of elements of one kind. An element is its number, kind, tags and nodes."""
    count, rest = _counted(data, "Elements")
    if binary:
        every = np.frombuffer(rest[: len(rest) // 4 * 4], f"{order}i4").astype(np.int64)
    else:
        every = whole(_parsed(rest), "among the elements")
    blocks, at = [], 0
    while count > 0:
        if len(every) < at + 3:
            raise MeshError("ends within its elements")
        if binary:  # a header for a run: kind, elements, tags of each
            kind, run, tags = every[at : at + 3].tolist()
            before, at = 1, at + 3
        else:
            kind, tags = every[at + 1 : at + 3].tolist()
            before, run = 3, 0
        name, vertices = _kind(kind)
        width = before + tags + vertices
        if not binary:
            run = _like_the_first(every[at:], width, count)
        rows = every[at : at + run * width]
        if tags < 0 or run < 1 or len(rows) < run * width:
            raise MeshError("ends within its elements")
        rows = rows.reshape(run, width)
        physical = rows[:, before] if tags else np.zeros(run, dtype=np.int64)
        blocks.append(Block(name, rows[:, before + tags :], np.abs(physical)))
        at, count = at + run * width, count - run
    return blocks


def _like_the_first(numbers: Integers, width: int, most: int) -> int:
    """How many elements from the first on have its kind and number of tags, and so its width."""
    run, window = 0, 64
    while run < most:
        rows = numbers[run * width : (run + window) * width]
        rows = rows[: len(rows) // width * width].reshape(-1, width)
        other = np.flatnonzero((rows[:, 1:3] != numbers[1:3]).any(axis=1))
        if len(other) or len(rows) < window:
            return min(most, run + int(other[0] if len(other) else len(rows)))
        run, window = run + window, 8 * window
    return most


def _merged(blocks: list[Block]) -> list[Block]:
    """One block of each kind, with an element once however many groups it is in.

    One that a group lists twice stays twice.
    """
    merged = []
    for kind in dict.fromkeys(block.kind for block in blocks):
        those = [block for block in blocks if block.kind == kind]
        elements = np.concatenate([block.elements for block in those])
        tags = np.concatenate([np.asarray(block.tags) for block in those])
        if not repeated_rows(np.sort(elements, axis=1)):
            merged.append(Block(kind, elements, tags))
            continue
        _, which = np.unique(np.sort(elements, axis=1), axis=0, return_inverse=True)
        which = which.ravel()
        _, once = np.unique(np.stack([which, tags], axis=1), axis=0, return_index=True)
        once = np.sort(once)  # the first of each element in each group
        _, leader, member = np.unique(which[once], return_index=True, return_inverse=True)
        leader = once[leader][member.ravel()]  # the first of the element, for each in `once`
        order = np.argsort(leader, kind="stable")
        leader, tag = leader[order], tags[once][order]
        start = np.flatnonzero(np.r_[True, leader[1:] != leader[:-1]])
        column = np.arange(len(leader)) - np.repeat(start, np.diff(np.r_[start, len(leader)]))
        columns = np.zeros((len(elements), 1 + column.max(initial=0)), dtype=np.int64)
        columns[leader, column] = tag
        again = np.setdiff1d(np.arange(len(elements)), once)
        columns[again, 0] = tags[again]
        kept = np.union1d(leader, again)
        merged.append(Block(kind, elements[kept], columns[kept]))
    return merged


def _nodes_4(numbers: _Numbers) -> tuple[Integers, Reals]:
    blocks, _, _, _ = numbers.take("size", 4).tolist()
    names, points = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    for _ in range(blocks):
        dim, _, parametric = numbers.take("int", 3).tolist()
        size = numbers.one("size")
        names.append(numbers.take("size", size).astype(np.int64))
        width = 3 + (dim if parametric else 0)
        rows = numbers.take("double", size * width).reshape(size, width)
        points.append(rows[:, :3].astype(np.float64))
    return np.concatenate(names), np.concatenate(points)


def _groups_4(numbers: _Numbers, partitioned: bool) -> dict[tuple[int, int], list[int]]:
    """Physical groups of each geometric entity, by its dimension and number."""
    if partitioned:
        numbers.one("size")
        numbers.take("int", 2 * numbers.one("size"))
    groups = {}
    for dim, count in enumerate(numbers.take("size", 4).tolist()):
        for _ in range(count):
            number = numbers.one("int")
            if partitioned:
                numbers.take("int", 2)
                numbers.take("int", numbers.one("size"))
            numbers.take("double", 3 if dim == 0 else 6)
            physical = numbers.take("int", numbers.one("size"))
            groups[dim, number] = np.abs(physical).tolist()
            if dim > 0:
                numbers.take("int", numbers.one("size"))
    return groups


def _elements_4(numbers: _Numbers, groups: Mapping[tuple[int, int], list[int]]) -> list[Block]:
    blocks = []
    count = int(numbers.take("size", 4)[0])
    for _ in range(count):
        dim, entity, kind = numbers.take("int", 3).tolist()
        size = numbers.one("size")
        name, vertices = _kind(kind)
        rows = numbers.take("size", size * (1 + vertices)).reshape(size, 1 + vertices)
        physical = groups.get((dim, entity)) or [0]
        tags = np.tile(np.array(physical, dtype=np.int64), (size, 1))
        blocks.append(Block(name, rows[:, 1:].astype(np.int64), tags))
    return blocks
