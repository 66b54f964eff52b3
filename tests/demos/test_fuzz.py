"""Scenes and command lines of all kinds: taken, or refused in one line; never a traceback.

`HYPOTHESIS_PROFILE=long` looks longer, see `tests/conftest.py`.
"""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from demos import studies
from demos.app import cli, mesh_report, viewer
from demos.app.scene import BUILT_IN, Overrides, build, parse
from demos.app.tables import SceneError
from demos.by_hand import compare

pytestmark = pytest.mark.serial

TEXTS = {path.name: path.read_text("utf-8") for path in sorted(BUILT_IN.glob("*.toml"))}
SCENES = {name: tomllib.loads(text) for name, text in TEXTS.items()}

calm = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])

leaves = st.one_of(
    st.none().map(lambda _: ""),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(
        ["x", "min", "static", "symmetric", "twist", "fixed", "traction", 0, 1, -1, 0.5]
    ),
    st.datetimes(),
)
values = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)


def places(value, path=()):
    """All places in nested tables and lists."""
    yield path
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*path, key))


def put(tables, path, value):
    """Put a value in a place; None takes away what is there."""
    *way, last = path
    place = tables
    for key in way:
        place = place[key]
    if value is None:
        del place[last]
    else:
        place[last] = value


def refused_in_one_line(read):
    try:
        read()
    except SceneError as error:
        assert str(error) and "\n" not in str(error)


@calm
@given(data=st.data())
def test_scenes_with_other_values(data):
    """A key taken away, given another value, or a key that nobody knows."""
    name = data.draw(st.sampled_from(sorted(SCENES)))
    tables = copy.deepcopy(SCENES[name])
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from([p for p in places(tables) if p]))
        if data.draw(st.booleans()) and isinstance(path[-1], str):
            path = (*path[:-1], data.draw(st.text(max_size=6)))
            put(tables, path, data.draw(values))
        else:
            put(tables, path, data.draw(st.none() | values))
    refused_in_one_line(lambda: build(tables, Path(name), Overrides(), name))


@calm
@given(data=st.data())
def test_damaged_scene_files(data):
    """Pieces left out, doubled, or other letters in their place."""
    name = data.draw(st.sampled_from(sorted(TEXTS)))
    text = TEXTS[name]
    for _ in range(data.draw(st.integers(1, 3))):
        a, b = sorted(data.draw(st.tuples(*[st.integers(0, len(text))] * 2)))
        text = (
            text[:a]
            + data.draw(st.sampled_from(["", text[a:b] * 2]) | st.text(max_size=5))
            + text[b:]
        )
    refused_in_one_line(lambda: parse(text, Path(name)))


@pytest.mark.parametrize("depth", [100, 5000])
def test_deep_nesting(depth):
    refused_in_one_line(lambda: parse("a = " + "[" * depth + "]" * depth, Path("deep.toml")))
    refused_in_one_line(
        lambda: parse("a = " + "{b=" * depth + "1" + "}" * depth, Path("deep.toml"))
    )


WORDS = [
    *("run", "study", "sweep", "compare", "mesh", "list", "view", "plot"),
    *("hanging-bar", "newton", "nothing.toml"),
    *("--out", "--steps", "--resume", "--checkpoint", "--formulation", "--material", "--solver"),
    *("--picture", "--movie", "--field", "--step", "--web", "speed"),
    *("--vary", "--measure", "--json", "--quick", "--fresh", "--equation", "--scale", "--help"),
    *(
        "-1",
        "0",
        "3",
        "1e9",
        "symmetric",
        "time.h=0.1",
        "tip.y",
        "mesh.refine=0:1",
        "-snes_monitor",
    ),
    *("", "-", "--", "=", ".", "..", "/dev/null", "é", "a\nb", "\x00"),
]


@calm
@given(arguments=st.lists(st.sampled_from(WORDS) | st.text(max_size=6), max_size=7))
def test_command_lines(arguments, tmp_path, monkeypatch, capfd):
    """Exit codes 0, 1 or 2; of the last with one line. What they would start is left out."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "run", lambda *_: "")
    monkeypatch.setattr(viewer, "view", lambda *_: (0, ""))
    monkeypatch.setattr(compare, "run", lambda *_: 0)
    monkeypatch.setattr(mesh_report, "run", lambda *_: 0)
    outcome = studies.Outcome([], 0, [])
    monkeypatch.setattr(studies, "run", lambda *_, **__: outcome)
    monkeypatch.setattr(cli, "_one_study", lambda *_: [])
    capfd.readouterr()
    try:
        code = cli.main(arguments)
    except SystemExit as left:
        code = left.code
    error = capfd.readouterr().err
    assert code in (0, 1, 2)
    if code == 2:
        assert error.startswith("mixed-fem: ") and len(error.splitlines()) == 1, error
