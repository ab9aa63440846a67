"""Check a built site: links between its pages, alternative texts, and its size.

python -m docs.extensions.check_site site
"""

import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LARGEST = 60e6
"""Bytes of a site."""


class Page(HTMLParser):
    """The links, anchors and pictures of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.without_text: list[str] = []
        self.outside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {v for k, v in attrs if k in {"id", "name"} and v}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"] or "")
        if tag in {"img", "script", "link", "source"}:
            target = values.get("src") or (values.get("href") if tag == "link" else None)
            if target and not target.startswith("data:"):
                self.links.append(target)
                if urlsplit(target).netloc:
                    self.outside.append(target)
        if tag == "img" and not (values.get("alt") or "").strip():
            self.without_text.append(values.get("src") or "?")


def faults(site: Path) -> Iterator[str]:
    """Yield what is wrong with a site, one sentence each."""
    pages = {
        file: Page(file.read_text(encoding="utf-8"))
        for file in sorted(site.rglob("*.html"))
        if "_static" not in file.parts
    }
    if not pages:
        yield f"{site} has no pages"
    for file, page in pages.items():
        name = file.relative_to(site).as_posix()
        yield from (f"{name}: {src} has no alternative text" for src in page.without_text)
        yield from (f"{name}: loads {url} from a network" for url in page.outside)
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            if not target.is_file():
                yield f"{name}: the link {link} leads nowhere"
            elif parts.fragment and target in pages and target.suffix == ".html":
                if unquote(parts.fragment) not in pages[target].anchors:
                    yield f"{name}: the link {link} has no such place"
    size = sum(file.stat().st_size for file in site.rglob("*") if file.is_file())
    if size > LARGEST:
        yield f"the site has {size / 1e6:.1f} MB, and at most {LARGEST / 1e6:.0f} are allowed"


def main() -> None:
    site = Path(sys.argv[1]).resolve()
    found = list(dict.fromkeys(faults(site)))
    files = [file for file in site.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files)
    pages = sum(file.suffix == ".html" for file in files)
    if found:
        sys.exit("\n".join([*found[:30], f"{len(found)} faults in {pages} pages"]))
    print(f"{site}: {pages} pages, {size / 1e6:.1f} MB, no broken links")  # noqa: T201


if __name__ == "__main__":
    main()
