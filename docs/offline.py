"""The site loads nothing from other hosts: the build fails where a page or a style sheet would."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from sphinx.errors import SphinxError

# What a browser loads by itself; links that a reader follows (`a`) may lead anywhere.
LOADED: dict[str, str] = dict.fromkeys(["script", "img", "iframe", "source", "video", "audio", "embed"], "src")
LOADED.update({"link": "href", "object": "data", "image": "href"})
NAMED_ONLY = {"canonical", "license", "author", "next", "prev"}
HOST = re.compile(r"\s*(?:https?:)?//")
IN_STYLE = re.compile(r"(?:url\(|@import)\s*['\"]?((?:https?:)?//[^'\")\s]+)")


class External(HTMLParser):
    """What a page loads from other hosts."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        address = named.get(LOADED.get(tag, "")) or ""
        if HOST.match(address) and named.get("rel") not in NAMED_ONLY:
            self.found.append(address)
        self.found += IN_STYLE.findall(named.get("style") or "")


def external(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".css":
        return IN_STYLE.findall(text)
    page = External()
    page.feed(text)
    styles = re.findall(r"<style[^>]*>(.*?)</style>", text, re.DOTALL)
    return page.found + [address for style in styles for address in IN_STYLE.findall(style)]


def check(app: Any, exception: Exception | None) -> None:
    if exception or app.builder.format != "html":
        return
    folder = Path(app.outdir)
    found = {path.relative_to(folder): external(path) for kind in ("html", "css") for path in folder.rglob(f"*.{kind}")}
    lines = [f"{path}: {address}" for path, addresses in found.items() for address in addresses]
    if lines:
        raise SphinxError("pages load from other hosts:\n" + "\n".join(lines))


def setup(app: Any) -> dict[str, bool]:
    app.connect("build-finished", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
