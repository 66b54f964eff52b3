"""How sphinx makes the site, `make docs`; demos are copied in and run, equations are generated."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = str(ROOT)  # of the kernels that run the demos

from demos.by_hand.errata import ERRATA, READING, REMARKS  # noqa: E402

project = "mixed-fem"
author = "mixed-fem authors"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
html_theme = "furo"
html_title = "mixed-fem"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "docs-cache")
nb_execution_timeout = 300
nb_execution_raise_on_error = True
napoleon_use_ivar = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
exclude_patterns = ["conf.py"]


def _generate() -> None:
    """Copy the demos and write the page of equations, where these have changed."""
    folder = HERE / "generated"
    folder.mkdir(exist_ok=True)
    for path in sorted((ROOT / "demos").glob("*.py")):
        if path.read_text("utf-8").startswith("# ---"):
            _write(folder / path.name, path.read_text("utf-8"))
    _write(folder / "equations.md", _equations())


def _equations() -> str:
    """The records of the seed's equations, with what `mixed-fem compare --json` has measured."""
    measured = json.loads((ROOT / "build" / "compare.json").read_text("utf-8"))["rows"]
    lines = [
        "# Every equation of the seed",
        "",
        "`mixed-fem compare` evaluates each equation, in numbers, from a derivation by hand in "
        "NumPy, and holds it against what UFL derives from eq. (1). This page is made from its "
        "records; differences are relative.",
        "",
        *(f"- {line}" for line in READING),
    ]
    for erratum in ERRATA:
        lines += ["", f"## ({erratum.number}) {erratum.states}", "", f"Verdict: {erratum.verdict}."]
        lines += ["", "```text", erratum.printed, "```"]
        if erratum.corrected:
            lines += ["", "As it should be:", "", "```text", erratum.corrected, "```"]
        if erratum.reason:
            lines += ["", _plain(erratum.reason)]
        rows = [row for row in measured if row["equation"] == erratum.number]
        if rows:
            lines += ["", "| compared | cases | largest difference |", "|---|---|---|"]
            lines += [
                f"| {_plain(row['what'])} | {row['cases']} | {row['difference']:.1e} |"
                for row in rows
                if row["difference"] is not None
            ]
    lines += ["", "## What the seed leaves open", ""]
    for remark in REMARKS:
        numbers = ", ".join(f"({n})" for n in remark.equations)
        lines += [f"### {remark.topic} {numbers}", "", f"> {_plain(remark.quote)}", ""]
        lines += [_plain(remark.answer), ""]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """Text in which Markdown finds nothing to mark up."""
    return re.sub(r"([\\*_$|<>\[\]`])", r"\\\1", text)


def _write(path: Path, text: str) -> None:
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")


def _mark_up(
    app: object, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Docstrings are plain text: nothing in them is emphasis, indented lines stay as they are."""
    told: list[str] = []
    code, last = False, ""
    for line in lines:
        indented = line.startswith("    ")
        if indented and told[-1:] == [""] and not last.startswith(" ") and not last.endswith(":"):
            told += [".. code-block:: text", ""]
            code = True
        elif line and not indented:
            code = False
        told.append(line if code else re.sub(r"([*|])", r"\\\1", line))
        last = line or last
    lines[:] = told


def setup(app) -> None:
    """Called by sphinx; docstrings are marked up before napoleon reads their sections."""
    app.connect("autodoc-process-docstring", _mark_up, priority=400)


_generate()
