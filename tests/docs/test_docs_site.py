"""The built site: no broken link, nothing from elsewhere, every public name."""

import functools
import importlib
import importlib.util
import os
import pkgutil
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import torch_ekm

ROOT = Path(__file__).parents[2]
_LOADED = {"img": "src", "script": "src", "link": "href", "source": "src", "iframe": "src", "object": "data"}
_NO_ASSET = {"canonical", "next", "prev", "author", "search", "index"}  # rel of links that load nothing


class Page(HTMLParser):
    """Anchors, links and assets of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.ids: set[str] = set()
        self.links: set[str] = set()
        self.assets: set[str] = set()
        self.styles = ""
        self._in_style = False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.ids.add(given.get("id", ""))
        self.styles += given.get("style", "")
        self._in_style = tag == "style"
        if tag == "a" and "href" in given:
            self.links.add(given["href"])
        if given.get(_LOADED.get(tag, "")) and not _NO_ASSET & {*given.get("rel", "").split()}:
            self.assets.add(given[_LOADED[tag]])

    def handle_data(self, data: str) -> None:
        self.styles += data if self._in_style else ""
        self._in_style = False


@pytest.fixture(scope="session")
def site() -> Path:
    """What ``make docs`` has built."""
    built = os.environ.get("TORCH_EKM_SITE")
    if not built:
        pytest.skip("make docs builds the site and runs these tests on it")
    return ROOT / built


@functools.cache
def page_at(path: Path) -> Page:
    return Page(path)


def pages(site: Path) -> list[Page]:
    found = [page_at(path) for path in sorted(site.rglob("*.html")) if "_static" not in path.parts]
    assert len(found) > 20
    return found


def outside(style: str) -> list[str]:
    """What a style sheet loads from a network."""
    loaded = re.findall(r"url\(\s*['\"]?([^'\")]+)", style) + re.findall(r"@import\s+['\"]([^'\"]+)", style)
    return [one for one in loaded if urlsplit(one).netloc]


def public_modules() -> Iterator[str]:
    """Found here once more, so that the site's own list is checked."""
    yield "torch_ekm"
    for info in pkgutil.walk_packages(torch_ekm.__path__, "torch_ekm."):
        private = any(part.startswith("_") for part in info.name.split("."))
        command_line = info.name.startswith("torch_ekm.cli")
        if private or command_line or not (info.ispkg or info.name.count(".") == 1):
            continue
        if getattr(importlib.import_module(info.name), "__all__", ()):
            yield info.name


def test_every_link_leads_somewhere(site: Path) -> None:
    broken = []
    for page in pages(site):
        for link in sorted(page.links):
            target = urlsplit(link)
            if target.scheme or target.netloc:
                continue
            there = (page.path.parent / unquote(target.path)).resolve() if target.path else page.path
            if not there.is_file():
                broken.append(f"{page.path.relative_to(site)}: {link}")
            elif there.suffix == ".html" and unquote(target.fragment) not in {"", *page_at(there).ids}:
                broken.append(f"{page.path.relative_to(site)}: no anchor {link}")
    assert not broken, "\n".join(broken)


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    foreign = []
    for page in pages(site):
        for asset in sorted(page.assets):
            target = urlsplit(asset)
            there = page.path.parent / unquote(target.path)
            if target.netloc or target.scheme not in ("", "data") or not (target.scheme or there.is_file()):
                foreign.append(f"{page.path.relative_to(site)}: {asset}")
        foreign += [f"{page.path.name}: {one}" for one in outside(page.styles)]
    for sheet in site.rglob("*.css"):
        foreign += [f"{sheet.name}: {one}" for one in outside(sheet.read_text(encoding="utf-8"))]
    assert not foreign, "\n".join(foreign)


def test_every_public_name_is_documented(site: Path) -> None:
    modules = list(public_modules())
    assert {"torch_ekm.control", "torch_ekm.testing", "torch_ekm.exceptions"} <= {*modules}
    missing = []
    for module in modules:
        path = site / "reference" / "api" / "generated" / f"{module}.html"
        if not path.is_file():
            missing.append(f"{module}: no page")
            continue
        page = page_at(path)
        elsewhere = {link.rpartition("#")[2].removeprefix("module-") for link in page.links} - page.ids
        for name in importlib.import_module(module).__all__:
            value = getattr(importlib.import_module(module), name)
            place = f"{module}.{name}"
            if place not in page.ids | elsewhere and not any(one.endswith(f".{name}") for one in elsewhere):
                missing.append(f"{place}: no entry")
            ours = getattr(value, "__module__", "").startswith("torch_ekm")
            if ours and not (value.__doc__ or "").strip():
                missing.append(f"{place}: no docstring")
    assert not missing, "\n".join(missing)
