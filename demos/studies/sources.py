"""What the result of a function depends on, among the sources of this repository.

Of its own module the statements that it reaches by name, so that a table or a figure beside it does
not count; of the modules that these import the whole file and the C beside it, and so on. Nothing
is run for that. What has no absolute name in the sources, such as a module named in a string, is
not found.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

_REGISTRY = Path(__file__).with_name("__init__.py")  # names all studies, of which one uses none


def sources(function: Callable[..., Any]) -> dict[Path, str]:
    """By file what counts of it, without comments, layout and annotations.

    Args:
        function: Of a module with a file. If it has no name at the top level of it, as a lambda
            has none, all of the module counts.
    """
    while isinstance(function, partial):
        function = function.func
    own = Path(sys.modules[function.__module__].__file__ or "")
    name = getattr(function, "__qualname__", type(function).__qualname__).partition(".")[0]
    found: dict[Path, str] = {}
    todo = [(own, _reached(_parse(own), name))]
    while todo:
        file, statements = todo.pop()
        found[file] = "\n".join(map(ast.dump, statements))
        for imported in _imported(statements):
            if imported not in found:
                found[imported] = ""
                todo.append((imported, _parse(imported)))
    folders = dict.fromkeys(file.parent for file in found if ROOT in file.parents)
    compiled = [file for folder in folders for file in sorted(folder.glob("*.[ch]"))]
    return found | {file: file.read_text("utf-8") for file in compiled}


def _parse(file: Path) -> list[ast.stmt]:
    tree = ast.parse(file.read_text("utf-8"))
    for node in ast.walk(tree):  # nothing is computed from annotations
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                node.returns = None
            case ast.arg():
                node.annotation = None
            case ast.AnnAssign():
                node.annotation = ast.Constant(None)
    return tree.body


def _reached(statements: list[ast.stmt], name: str) -> list[ast.stmt]:
    """Those that a name refers to, directly or through others, and those that bind no name."""
    names = [_bound(statement) for statement in statements]
    if not any(name in bound for bound in names):
        return statements
    reached: set[str] = set()
    todo = {name}
    while todo:
        reached |= todo
        todo = {
            node.id
            for statement, bound in zip(statements, names, strict=True)
            if bound & todo
            for node in ast.walk(statement)
            if isinstance(node, ast.Name)
        } - reached
    return [
        statement
        for statement, bound in zip(statements, names, strict=True)
        if bound & reached or not (bound or _is_text(statement))
    ]


def _bound(statement: ast.stmt) -> set[str]:
    """The names that a statement defines or imports."""
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {statement.name}
    bound = set()
    for node in ast.walk(statement):
        match node:
            case ast.Name(id=name, ctx=ast.Store()):
                bound.add(name)
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                bound.add(name)
            case ast.ClassDef(name=name):
                bound.add(name)
            case ast.alias(name=name, asname=other):
                bound.add((other or name).partition(".")[0])
    return bound


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _imported(statements: Iterable[ast.stmt]) -> Iterator[Path]:
    """Files of this repository that statements import, wherever in them."""
    for statement in statements:
        for node in ast.walk(statement):
            if isinstance(node, ast.Import):
                candidates = [[alias.name] for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                module = node.module or ""
                candidates = [[f"{module}.{alias.name}", module] for alias in node.names]
            else:
                continue
            for names in candidates:
                files = [file for name in names if (file := _file(name))]
                yield from (file for file in files[:1] if file != _REGISTRY)


def _file(module: str) -> Path | None:
    place = ROOT.joinpath(*module.split("."))
    files = (place.with_name(f"{place.name}.py"), place / "__init__.py")
    return next((file for file in files if file.is_file()), None)
