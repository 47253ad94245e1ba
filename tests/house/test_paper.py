"""docs/paper.md: it is what docs/paper.py makes, and each of its commands is there and parses."""

import argparse
import importlib
import shlex
import sys

import pytest
from places import ROOT
from scripts import load

sys.path.insert(0, str(ROOT / "docs"))
paper = load("docs/paper.py")
COMMANDS = sorted(
    {line for entries in paper.SECTIONS.values() for e in entries for line in e.commands}
    | {line.strip() for line in paper.HEAD.splitlines() if line.startswith("    python")}
)


class Parsed(Exception):
    """The arguments were read, and nothing was run."""


@pytest.fixture
def parse_only(monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def stop(self, args=None, namespace=None):
        raise Parsed(parse(self, args, namespace))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)


def main_of(words):
    """(main, its arguments) of a command line in words."""
    assert words[0] == "python"
    if words[1] == "-m":
        name, words = words[2], words[3:]
        module = importlib.import_module(name)
        if hasattr(module, "__path__"):
            module = importlib.import_module(f"{name}.__main__")
        return module.main, words
    return load(words[1]).main, words[2:]


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_is_there_and_parses(command, parse_only):
    main, words = main_of(shlex.split(command))
    with pytest.raises(Parsed):
        main(words)
    with pytest.raises((ValueError, SystemExit)):
        main([*words, "--no-such-flag"])


def test_the_page_is_the_generated_one():
    shown = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert shown == paper.page(paper.read())


def test_what_was_not_measured_says_so(tmp_path):
    (tmp_path / "onefit_paper.json").write_text(
        '{"collisions": {"dress": {"tshirt": 1.0, '
        '"dress": 2.0, "tank": 3.0, "long_sleeve_top": 4.0, "shorts": 5.0, "trousers": 6.0}}}'
    )
    text = paper.page(paper.read(tmp_path))
    assert "*Not measured yet.*" in text and "| tank | 0.1" not in text
    assert "| dress | ours | 1.00 | 2.00 | 3.00 | 4.00 | 5.00 | 6.00 |" in text
    assert "| six | ours" not in text


def test_orders_are_plotted(tmp_path):
    row = {kind: {frame: dict(height=0.1, angle=3.0) for frame in ("PCA", "STN")} for kind in "ab"}
    paper.plot_orders({"1": row, "2": row}, tmp_path / "orders.png")
    assert (tmp_path / "orders.png").read_bytes().startswith(b"\x89PNG")
