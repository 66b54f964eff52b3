"""Objects of registered classes from tables: the fields of a dataclass are the keys.

A field can be written in a scene if its type allows a number, text, true or false, a list of
numbers or texts, or a list of lists of numbers; `where` is a clause. The class itself says more in
its `__post_init__`. Of a class that is no dataclass the keyword-only parameters are the fields.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from demos.app.tables import Table, is_number
from meshes import Where


@dataclasses.dataclass(frozen=True)
class _Kind:
    """A kind of value: what it is called, how to tell it, and how to take it."""

    name: str
    is_one: Callable[[object], bool]
    take: Callable[[Any], Any]


def _is_text(value: object) -> bool:
    return isinstance(value, str)


_KINDS: dict[Any, _Kind] = {
    float: _Kind("a finite number", is_number, float),
    int: _Kind("a whole number", lambda v: isinstance(v, int) and not isinstance(v, bool), int),
    bool: _Kind("true or false", lambda v: isinstance(v, bool), bool),
    str: _Kind("text in quotes", _is_text, str),
    Any: _Kind("a value", lambda _: True, lambda v: v),
}
_LISTS: dict[Any, _Kind] = {
    float: _Kind("a list of finite numbers", lambda v: _all(v, is_number), lambda v: _floats(v)),
    str: _Kind("a list of texts in quotes", lambda v: _all(v, _is_text), tuple),
    Sequence[float]: _Kind(
        "a list of lists of finite numbers",
        lambda v: _all(v, lambda row: _all(row, is_number)),
        lambda v: tuple(map(_floats, v)),
    ),
}


def offered[T](registry: Mapping[str, type[T]]) -> dict[str, type[T]]:
    """The classes of a registry of which a scene can write all that they need."""
    return {
        name: choice
        for name, choice in registry.items()
        if all(kinds for _, kinds, required in _fields(choice) if required)
    }


def described(registry: Mapping[str, type[Any]]) -> dict[str, str]:
    """The first line of each class's docstring that a scene can write, and its keys."""
    return {
        name: f"{(choice.__doc__ or '').splitlines()[0]} Keys: {_told_keys(choice)}"
        for name, choice in offered(registry).items()
    }


def made[T](table: Table, kind: type[T], given: Mapping[str, Any] | None = None) -> T:
    """Make an object from the keys of a table, of which none may be left over.

    Args:
        table: The table.
        kind: A dataclass.
        given: Fields that are known already, by name.

    Raises:
        SceneError: A key is missing or unknown, or its value is none that the class takes.
    """
    values = read(table, kind, given)
    table.close()
    try:
        return kind(**values)
    except ValueError as e:
        raise table.error(str(e)) from e


def read(table: Table, kind: type[Any], given: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Read the keys of a class from a table, in which there may be others.

    Args:
        table: The table.
        kind: The class.
        given: Fields that are known already, by name.

    Raises:
        SceneError: A key is missing, or its value is none that the class takes.
    """
    values = dict(given or {})
    for name, kinds, required in _fields(kind):
        if name in values or not kinds:
            continue
        if not required and name not in table.data:
            table.known.append(name)
        else:
            values[name] = _value(table, name, kinds)
    return values


def _value(table: Table, name: str, kinds: Sequence[_Kind]) -> Any:
    value = table.value(name)
    if name == "where":
        try:
            return Where.parse(value)
        except ValueError as e:
            raise table.error(f"where: {e}") from e
    for kind in kinds:
        if kind.is_one(value):
            return kind.take(value)
    table.fail(name, f"must be {' or '.join(kind.name for kind in kinds)}")


def _fields(choice: type[Any]) -> list[tuple[str, list[_Kind], bool]]:
    """Name of each field, the kinds of value that it may have, and whether it must have one."""
    if not dataclasses.is_dataclass(choice):
        hints = typing.get_type_hints(choice.__init__)
        return [
            (p.name, _kinds(hints[p.name]), p.default is p.empty)
            for p in inspect.signature(choice).parameters.values()
            if p.kind is p.KEYWORD_ONLY and p.name in hints
        ]
    hints = typing.get_type_hints(choice)
    missing = dataclasses.MISSING
    return [
        (f.name, _kinds(hints[f.name]), f.default is missing and f.default_factory is missing)
        for f in dataclasses.fields(choice)
        if f.init
    ]


def _kinds(hint: Any) -> list[_Kind]:
    """What of a type can be written in TOML."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return [kind for argument in arguments for kind in _kinds(argument)]
    if origin in (Sequence, tuple, list):
        return [_LISTS[arguments[0]]] if arguments[0] in _LISTS else []
    return [_KINDS[hint]] if hint in _KINDS else []


def _told_keys(choice: type[Any]) -> str:
    """Keys of a class, those in brackets that may be left out."""
    told = [name if required else f"[{name}]" for name, kinds, required in _fields(choice) if kinds]
    return ", ".join(told) or "none"


def _all(value: object, is_one: Callable[[object], bool]) -> bool:
    return isinstance(value, list) and all(map(is_one, value))


def _floats(value: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(float, value))
