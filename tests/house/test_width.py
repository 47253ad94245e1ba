"""Documentation wraps at 100 columns, so that a diff can be read: but for tables, code, links and
pictures, which do not wrap."""

import re

import pytest
from places import ROOT

WIDTH = 100
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")])


def too_wide(text):
    """Numbers of the lines that are too wide, from 1."""
    found, code = [], False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            code = not code
        exempt = code or line.startswith(("|", "    ", "!["))
        if len(re.sub(r"\]\([^)]*\)", "]()", line)) > WIDTH and not exempt and "://" not in line:
            found.append(number)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_pages_wrap(page):
    assert too_wide(page.read_text(encoding="utf-8")) == []


def test_what_counts_as_wide():
    text = "\n".join(
        ["x" * 101, "x" * 100, "| " + "x" * 101, "[a](" + "x" * 101 + ")", "    " + "x" * 101]
    )
    assert too_wide(text + "\n```\n" + "x" * 101 + "\n```\n" + "y" * 101) == [1, 9]
