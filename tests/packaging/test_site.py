"""The documentation site, where `make docs` has built it: it asks for nothing from outside."""

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

SITE = Path(__file__).resolve().parents[2] / "build" / "site"
pytestmark = pytest.mark.skipif(not SITE.is_dir(), reason="`make docs` has not built the site")
OUTSIDE = re.compile(r"\s*(?:[a-z]+:)?//", re.IGNORECASE)


class Resources(HTMLParser):
    """Addresses that a browser fetches by itself: scripts, styles, images, fonts, frames."""

    def __init__(self):
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        if tag == "link" and named.get("rel") in ("canonical", "next", "prev"):
            return
        names = ("href",) if tag == "link" else ("src", "srcset", "data", "poster")
        if tag != "a":
            self.addresses += [named[name] for name in names if named.get(name)]
        self.addresses += styles_of(named.get("style") or "")


def styles_of(css):
    return re.findall(r"(?:url\(|@import)\s*['\"]?([^'\")]+)", css)


def resources_of(html):
    parser = Resources()
    parser.feed(html)
    return [*parser.addresses, *styles_of(" ".join(re.findall(r"<style.*?</style>", html, re.S)))]


@pytest.mark.parametrize(("kind", "find"), [("html", resources_of), ("css", styles_of)])
def test_nothing_is_loaded_from_outside(kind, find):
    files = sorted(SITE.rglob(f"*.{kind}"))
    assert files
    for file in files:
        assert not [a for a in find(file.read_text("utf-8")) if OUTSIDE.match(a)], file
