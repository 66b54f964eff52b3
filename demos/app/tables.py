"""Tables of a TOML file that check what is asked of them."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Any, NoReturn


class SceneError(ValueError):
    """A scene cannot be run as written; the message is one line."""


_REQUIRED: Any = object()

LARGEST = 1e60
"""Beyond, products of five such numbers leave the range of double precision."""


@dataclass
class Table:
    """A table that knows its place in the file, and which of its keys were asked for.

    Every method that reads a key raises `SceneError` where the value is not what it says.

    Attributes:
        source: How messages call the file.
        place: Where in the file the table stands, such as ``[mesh]``.
        data: Its keys and values.
        known: Keys that were asked for.
        labels: What messages call values that came from the command line.
    """

    source: str
    place: str
    data: dict[str, Any]
    known: list[str] = field(default_factory=list)
    labels: dict[str, str] = field(default_factory=dict)

    def error(self, message: str) -> SceneError:
        """An error in this table."""
        return SceneError(": ".join(part for part in (self.source, self.place, message) if part))

    def fail(self, key: str, message: str) -> NoReturn:
        """Complain about the value of a key."""
        if key in self.labels:
            raise SceneError(f"{self.labels[key]} {_spell(self.data[key])}: {message}")
        place = f"{self.place} {key}".strip()
        raise SceneError(f"{self.source}: {place} = {_spell(self.data[key])}: {message}")

    def override(self, key: str, value: object, label: str) -> None:
        """Put a value of the command line in place of that of the file, if it is given."""
        if value is not None:
            self.data = {**self.data, key: value}
            self.labels[key] = label

    def value(self, key: str, default: Any = _REQUIRED) -> Any:
        """The value of a key, unchecked."""
        self.known.append(key)
        if key in self.data:
            return self.data[key]
        if default is _REQUIRED:
            close = difflib.get_close_matches(key, set(self.data) - set(self.known), 1)
            near = close or [k for k in self.data if k.lower() == key.lower()]
            raise self.error(f"misses the key {key}" + (f" (is {near[0]} meant?)" if near else ""))
        return default

    def table(self, key: str, required: bool = True) -> Table:
        """A table in this one."""
        value = self.value(key, _REQUIRED if required else {})
        if not isinstance(value, dict):
            self.fail(key, "must be a table")
        place = f"{self.place} {key}" if self.place else f"[{key}]"
        return Table(self.source, place, value)

    def tables(self, key: str, required: bool = False) -> list[Table]:
        """The tables of an array of tables."""
        value = self.value(key, _REQUIRED if required else [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            raise self.error(f"{key} must be written as [[{key}]], once for each")
        if required and not value:
            raise self.error(f"needs a [[{key}]]")
        places = [
            f"[[{key}]] {i}" if len(value) > 1 else f"[[{key}]]" for i in range(1, 1 + len(value))
        ]
        return [Table(self.source, p, v) for p, v in zip(places, value, strict=True)]

    def text(self, key: str, default: Any = _REQUIRED) -> str:
        """A string."""
        value = self.value(key, default)
        if not isinstance(value, str):
            self.fail(key, "must be text in quotes")
        return str(value)

    def number(self, key: str) -> float:
        """A finite number."""
        value = self.value(key)
        if not is_number(value):
            self.fail(key, "must be a finite number")
        return float(value)

    def positive(self, key: str, what: str, default: Any = _REQUIRED) -> float:
        """A finite number above 0; `what` names the quantity in the message."""
        value = self.value(key, default)
        if not is_number(value) or value <= 0:
            self.fail(key, f"must be {what}, above 0")
        if not 1 / LARGEST <= value <= LARGEST:
            self.fail(
                key, f"must lie between {1 / LARGEST:g} and {LARGEST:g}, so that products fit"
            )
        return float(value)

    def count(self, key: str, default: Any = _REQUIRED) -> int:
        """A whole number of 1 or more."""
        value = self.value(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            self.fail(key, "must be a whole number of 1 or more")
        return int(value)

    def whole(self, key: str, default: Any = _REQUIRED) -> int:
        """A whole number of 0 or more."""
        value = self.value(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            self.fail(key, "must be a whole number of 0 or more")
        return int(value)

    def tag(self, key: str) -> int | str:
        """A whole number or a name."""
        value: int | str = self.value(key)
        if not isinstance(value, int | str) or isinstance(value, bool):
            self.fail(key, "must be a whole number or a name, a cell tag of the mesh file")
        return value

    def numbers(self, key: str, default: Any = _REQUIRED) -> tuple[float, ...]:
        """A list of 2 or 3 finite numbers."""
        value = self.value(key, default)
        if value == default:
            return tuple(value)
        if not isinstance(value, list) or not 2 <= len(value) <= 3:
            self.fail(key, "must be a list of 2 or 3 numbers, one for each dimension")
        if not all(is_number(v) for v in value):
            self.fail(key, "must hold finite numbers only")
        return tuple(float(v) for v in value)

    def choice(self, key: str, available: Collection[str], default: Any = _REQUIRED) -> str:
        """A name out of `available`."""
        value = self.value(key, default)
        if not isinstance(value, str):
            self.fail(key, f"must be a name in quotes; available: {', '.join(available)}")
        if key in self.data and value not in available:
            hint = suggestion(value, available)
            self.fail(key, f"unknown{hint}; available: {', '.join(available)}")
        return value

    def close(self) -> None:
        """Complain about the first key that nobody has asked for."""
        for key in self.data:
            if key not in self.known:
                known = ", ".join(self.known)
                told = key if key.isprintable() else json.dumps(key)
                raise self.error(f"unknown key {told}{suggestion(key, self.known)}; known: {known}")


def is_number(value: object) -> bool:
    """Whether a value is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def flat(value: Any, place: str = "") -> dict[str, Any]:
    """Nested tables as one, with dotted keys."""
    if isinstance(value, dict):
        inner = [(f"{place}.{key}" if place else key, v) for key, v in value.items()]
    elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
        inner = [(f"{place}.{k}", v) for k, v in enumerate(value, start=1)]
    else:
        return {place: value}
    return {key: v for where, one in inner for key, v in flat(one, where).items()}


def _spell(value: object) -> str:
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)


def suggestion(word: object, known: Iterable[str]) -> str:
    """A closing remark when a word is close to a known one, else nothing."""
    close = difflib.get_close_matches(str(word), list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else ""
