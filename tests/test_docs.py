"""The pages: their code runs; once built by `make docs` they open in a browser, and links hold."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tests.browser import chromium

pytestmark = pytest.mark.serial

ROOT = Path(__file__).parents[1]
SITE = ROOT / "build" / "docs"
RECIPES = (ROOT / "docs" / "recipes.md").read_text("utf-8")
TITLED = re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", RECIPES, flags=re.DOTALL | re.MULTILINE)

needs_site = pytest.mark.skipif(not (SITE / "index.html").exists(), reason="needs make docs")


@pytest.mark.parametrize("title", [title for title, text in TITLED if "```python" in text])
def test_recipes_run(title):
    """As printed, each by itself."""
    for code in re.findall(r"```python\n(.*?)```", dict(TITLED)[title], flags=re.DOTALL):
        exec(code, {"__name__": "recipe"})


def test_there_are_twenty_recipes():
    """And what they call `mixed-fem` has the commands and options that they use."""
    from demos.app.arguments import parser

    assert len(TITLED) >= 20
    commands = re.findall(r"^    mixed-fem (.*?)(?: *#.*)?$", RECIPES, flags=re.MULTILINE)
    assert len(commands) >= 6
    for command in commands:
        words = command.replace("'", "").split()
        given = [w for w in words if not re.match(r"-mixed_fem", w) and w != "cholesky"]
        assert parser().parse_args(given).name == words[0]


class _Page(HTMLParser):
    """Links, pictures and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.links += [v for k in ("href", "src") if (v := found.get(k))]
        self.anchors |= {v for k in ("id", "name") if (v := found.get(k))}


@needs_site
def test_no_link_is_broken():
    """Within the site: to pages, pictures and places in pages."""
    pages = {path: _Page(path) for path in SITE.rglob("*.html")}
    assert len(pages) > 15
    broken = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            there = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not there.exists():
                broken.append(f"{path.name}: {link}")
            elif parts.fragment and there in pages:
                if unquote(parts.fragment) not in pages[there].anchors:
                    broken.append(f"{path.name}: {link}")
    assert not broken


@needs_site
def test_every_equation_has_its_verdict():
    """All that the comparison numbers, and what it has measured."""
    text = (SITE / "generated" / "equations.html").read_text("utf-8")
    from demos.by_hand import ERRATA

    assert text.count("Verdict: ") == len(ERRATA)
    assert len(re.findall(r"<td><p>\d\.\de-\d\d</p></td>", text)) > len(ERRATA) / 2


@needs_site
def test_the_site_opens_in_a_browser(tmp_path, monkeypatch):
    """The first page shows its picture, and leads to the method."""
    with chromium(tmp_path, monkeypatch) as browser:
        browser.get((SITE / "index.html").as_uri())
        width = "return document.querySelector('article img').naturalWidth"
        assert browser.execute_script(width) > 1000
        browser.find_element("link text", "the method in ten minutes").click()
        assert "The method in ten minutes" in browser.title
