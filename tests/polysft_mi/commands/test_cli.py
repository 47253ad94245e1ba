"""The commands as one: their names, help, examples, exit status, and what goes to which stream."""

import importlib
import json
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from places import ROOT
from processes import python, refusal

from polysft_mi import __main__ as polysft
from polysft_mi import commands
from polysft_mi.errors import InputError


def test_installed_command_is_ours():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    module, function = re.search(r'^polysft = "([\w.]+):(\w+)"', text, re.M).groups()
    assert getattr(importlib.import_module(module), function) is polysft.entry


def test_help_lists_every_command(capsys):
    assert polysft.main(["--help"]) == 0
    listed = re.findall(r"^  (\w+)  ", capsys.readouterr().out, re.M)
    assert [name for name in listed if name in commands.COMMANDS] == list(commands.COMMANDS)
    for name in commands.COMMANDS:
        assert callable(importlib.import_module(f"polysft_mi.{name}").main)


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_help_of_a_command_teaches_by_examples_that_parse(name, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [f"polysft {name}"])
    module = importlib.import_module(f"polysft_mi.{name}")
    with pytest.raises(SystemExit) as ended:
        module.main(["--help"])
    text = capsys.readouterr().out
    assert ended.value.code == 0 and text.startswith(f"usage: polysft {name} ")
    for arguments, _ in module._EXAMPLES:
        assert f"  polysft {name} {arguments}\n" in text
        module.parser().parse_args(shlex.split(arguments))
    monkeypatch.setattr(sys, "argv", ["whatever"])
    assert module.parser().prog == f"python -m polysft_mi.{name}"


@pytest.mark.parametrize(
    "name",
    [
        *(f"polysft_mi.{name}" for name in commands.COMMANDS),
        *("polyfit.__main__", "polyfit.train"),
        *("onefit.drape", "onefit.simulate", "onefit.train", "onefit.tailor", "onefit.teach"),
    ],
)
def test_every_command_ends_as_one_and_tells_of_a_wrong_option(name):
    module = importlib.import_module(name)
    with pytest.raises(InputError, match="--help lists the options$"):
        module.main(["--wrong-option"])
    source = Path(module.__file__).read_text(encoding="utf-8")
    assert source.endswith('\n\nif __name__ == "__main__":\n    cli(main)\n')


def test_no_command_and_a_wrong_one(capsys):
    assert polysft.main([]) == 2
    with pytest.raises(InputError, match="exprot: no such command, did you mean export"):
        polysft.main(["exprot"])
    capsys.readouterr()
    assert polysft.main(["--version"]) == 0
    version, llvm = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"polysft \d+\.\d+\.\d+", version)
    assert re.fullmatch(r"LLVM \d+\.\d+\.\d+: \S*LLVM\S* \(.+\)", llvm)


def test_a_mistake_ends_the_process_with_status_2():
    said = refusal(python("-m", "polysft_mi", "export", "out", "--format", "fbx"))
    assert "invalid choice: 'fbx'" in said


_OTHERS = """
import logging, warnings
from polyfit.errors import Notice, cli

def main():
    warnings.warn("a function that will go", DeprecationWarning)
    warnings.warn("some user warning")
    logging.getLogger("matplotlib.font_manager").warning("building the font cache")
    logging.getLogger("trimesh").exception("unable to load image!")
    warnings.warn("loss.png: picture not written", Notice)

cli(main)
"""


def test_what_other_packages_say_reaches_nobody():
    done = python("-c", _OTHERS)
    assert done.returncode == 0 and done.stdout == ""
    assert "picture not written" in done.stderr
    for word in ("function", "user warning", "font cache", "image"):
        assert word not in done.stderr
    assert "a function that will go" in python("-W", "default", "-c", _OTHERS).stderr


def test_json_is_all_that_stdout_holds(finished_run, tmp_path, capsys, monkeypatch):
    truth, out = finished_run
    monkeypatch.setattr(sys, "argv", sys.argv)

    def printed(*arguments):
        assert polysft.main([str(a) for a in arguments]) == 0
        seen = capsys.readouterr()
        assert seen.err == ""
        return seen.out

    evaluated = json.loads(printed("evaluate", out, truth.folder, "--json"))
    compared = json.loads(printed("compare", out, truth.folder, "--json"))
    assert evaluated["rmse_mm"] == pytest.approx(compared["difference"]["rmse_mm"])
    new = tmp_path / "a folder"
    figures = json.loads(
        printed(
            "run",
            truth.folder / "scene.xml",
            "-o",
            new,
            "-D",
            "last=1",
            "-q",
            "--json",
            "--no-report",
        )
    )
    assert (figures["frames"], figures["report"], figures["out"]) == (2, None, str(new)) and not (
        new / "report.html"
    ).exists()
    recorded = json.loads((new / "run.json").read_text())["command"]
    assert shlex.split(recorded)[:3] == ["python", "-m", "polysft_mi.run"] and str(
        new
    ) in shlex.split(recorded)
    assert (
        printed("export", new, "--format", "npz", "-q") == ""
        and (new / "export" / "surface.npz").exists()
    )


@pytest.mark.parametrize("plain", [False, True])
def test_colours_only_on_a_terminal_that_wants_them(plain):
    environment = {**os.environ, "TERM": "xterm"} | ({"NO_COLOR": "1"} if plain else {})
    if not plain:
        environment.pop("NO_COLOR", None)
    parent, child = pty.openpty()
    subprocess.run(
        [sys.executable, "-m", "polysft_mi", "wrong"], stderr=child, cwd=ROOT, env=environment
    )
    os.close(child)
    shown = os.read(parent, 4096).decode()
    os.close(parent)
    assert ("\033[" in shown) is not plain and "error:" in shown


def test_ctrl_c_when_all_is_done_prints_nothing():
    """Python's own end waits for threads, and would else tell with a traceback that it was
    interrupted there.
    """
    code = (
        "import threading, time\nfrom polyfit.errors import"
        " cli\nthreading.Thread(target=time.sleep, args=(20,)).start()\ncli(lambda: print('done',"
        " flush=True))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"done\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        assert process.stderr.read() == b"" and process.wait(10) == -signal.SIGINT


@pytest.mark.parametrize("letters", [10, 10**6], ids=["before", "after the buffer is full"])
def test_a_reader_that_leaves_early_is_not_told_off(letters):
    code = f"from polyfit.errors import cli\ncli(lambda: print('x' * {letters}))"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141
