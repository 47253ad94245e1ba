"""What the tests of bad input share: edits of a scene, and what a refusal must look like."""

import re
from pathlib import Path

import pytest

from polysft_mi import errors, run

SIZE = (48, 36)
QUICK = ["-q", "--exr", "2", "-D", "last=1", "-D", "window=2"]


def contents(out):
    return {p.relative_to(out): p.read_bytes() for p in sorted(Path(out).rglob("*")) if p.is_file()}


def refused(scene, *options, out=None):
    """The line that ``run`` refuses with; OUT is afterwards as it was before."""
    out = Path(out) if out else Path(scene).parent / "out"
    before = contents(out) if out.is_dir() else out.exists()
    with pytest.raises(errors.InputError) as caught:
        run.main([str(scene), "-o", str(out), *options])
    assert (contents(out) if out.is_dir() else out.exists()) == before
    message = str(caught.value)
    assert (
        "\n" not in message
        and "Traceback" not in message
        and ".cpp" not in message
        and len(message) < 800
    )
    return message


def edited(folder, old, new, *, pattern=False):
    """The folder's scene with ``old`` (a text, or a regular expression) replaced, as another file
    beside it.
    """
    text = (folder / "scene.xml").read_text()
    changed = re.sub(old, new, text, flags=re.S) if pattern else text.replace(old, new)
    assert changed != text
    path = folder / "changed.xml"
    path.write_text(changed)
    return path


def line_of(path, text):
    """``line N``, as a message names the one line of a scene file that has ``text``."""
    lines = path.read_text(encoding="utf-8").splitlines()
    (number,) = (k for k, line in enumerate(lines, start=1) if text in line)
    return f"line {number}"


def has(message, *words):
    assert all(word in message for word in words), message
