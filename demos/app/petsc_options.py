"""PETSc options among the arguments of `mixed-fem`: those with one dash."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from petsc4py import PETSc

Options = dict[str, str | None]

_OPTION = re.compile("--?[A-Za-z]")  # and not a negative number
_NOT_PETSCS = re.compile("--|-h(elp)?$")


def split(arguments: Sequence[str]) -> tuple[list[str], Options]:
    """Tell PETSc's options from the other arguments, by PETSc's own rules.

    An option is a dash and a letter, and what follows is its value, unless that is an option too.

    Args:
        arguments: Those of the command line.

    Returns:
        The other arguments, and the values of the options by name; None where there is no value.
    """
    others: list[str] = []
    options: Options = {}
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if not _OPTION.match(argument) or _NOT_PETSCS.match(argument):
            others.append(argument)
            continue
        has_value = bool(rest) and not _OPTION.match(rest[0])
        options[argument[1:]] = rest.pop(0) if has_value else None
    return others, options


@contextmanager
def entered(options: Mapping[str, str | None]) -> Iterator[None]:
    """Put options into PETSc's database, where problems find them, and take them out at the end."""
    database = PETSc.Options()
    for name, value in options.items():
        database[name] = value
    try:
        yield
    finally:
        for name in options:
            database.delValue(name)


def unread(options: Mapping[str, str | None]) -> list[str]:
    """The options, with their dash, that nothing has read; they must be in the database still."""
    used = PETSc.Options().used
    return [f"-{name}" for name in options if not used(name)]
