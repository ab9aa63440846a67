"""The pages of docs/: their examples run, and the page on the frozen law is complete."""

import doctest
import inspect
import re
from pathlib import Path

import jax
import pytest
from docs.extensions.check_site import faults

import dvax

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def named(page: Path) -> str:
    return page.relative_to(DOCS).as_posix()


SHORT = ["index.md", "results.md", "models/own-problem.md"]
"""Pages whose examples `make test` runs; the others run in `make thorough` and on the newest Python."""


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)


def is_short(page: Path) -> bool:
    """Whether the page has no examples, or is one of the short ones."""
    return not blocks(page) or named(page) in SHORT


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=named(page), marks=[] if is_short(page) else [pytest.mark.thorough])
        for page in PAGES
    ],
)
def test_page_examples_print_the_documented_output(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)  # some write files
    found = blocks(page)
    assert len(found) == page.read_text(encoding="utf-8").count("```python")
    assert all(">>>" in block for block in found), "an example that shows no result"
    # One page is one session: later examples use what earlier ones made.
    test = doctest.DocTestParser().get_doctest("\n".join(found), {}, page.name, str(page), 0)
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    # As a user runs them: the strict promotion of the tests is for the library.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        runner.run(test, out=report.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(report)


def test_pages_have_examples():
    assert sum(len(blocks(page)) for page in PAGES) >= 9


def children(page: Path) -> list[Path]:
    """The pages in the tables of contents of a page; pages that the build writes are left out."""
    text = page.read_text(encoding="utf-8")
    entries = "\n".join(re.findall(r"^```\{toctree\}\n(.*?)^```$", text, re.M | re.S)).split("\n")
    places = [entry for entry in entries if entry and not entry.startswith(":")]
    files = [(page.parent / f"{place}.md").resolve() for place in places]
    return [
        file
        for file, place in zip(files, places, strict=True)
        if not place.startswith(("api/", "gallery/"))
    ]


def test_every_page_is_in_one_table_of_contents():
    found = [DOCS / "index.md"]
    for page in found:
        assert page.is_file(), f"{page} is in a table of contents and does not exist"
        found += children(page)
    assert sorted(found) == PAGES


def public(module: object, base: type) -> list[str]:
    return [
        name
        for name, thing in vars(module).items()
        if isinstance(thing, type) and issubclass(thing, base) and not name.startswith("Abstract")
    ]


def test_page_on_the_frozen_law_lists_every_set_solver_and_result():
    text = (DOCS / "variational-inequalities.md").read_text(encoding="utf-8")
    names = [
        *public(dvax.sets, dvax.sets.AbstractSet),
        *public(dvax.vi, dvax.vi.AbstractSolver),
        *re.findall(r"^    (\w+) = ", inspect.getsource(dvax.vi.RESULTS), re.M),
    ]
    assert len(names) > 30
    missing = [name for name in names if f"`{name}`" not in text]
    assert not missing, f"not on the page: {missing}"


def test_site_check_finds_broken_links_missing_texts_and_networks(tmp_path: Path):
    (tmp_path / "a.html").write_text(
        '<h1 id="top">A</h1><a href="b.html#here">b</a><a href="b.html#there">b</a>'
        '<a href="c.html">c</a><img src="a.html"><img src="a.html" alt="a page">'
        '<script src="https://example.org/x.js"></script><a href="https://example.org">x</a>',
        encoding="utf-8",
    )
    (tmp_path / "b.html").write_text('<p id="here"><a href="#here">b</a></p>', encoding="utf-8")
    assert sorted(set(faults(tmp_path))) == [
        "a.html: a.html has no alternative text",
        "a.html: loads https://example.org/x.js from a network",
        "a.html: the link b.html#there has no such place",
        "a.html: the link c.html leads nowhere",
    ]
