"""What a plain installation does without torch, USD and viser, and what a command says that
needs one of them."""

import processes
import pytest

from polyfit.errors import EXTRAS

# Modules that are None in sys.modules cannot be imported
_BLOCKED = f"""
import sys
sys.modules.update(dict.fromkeys({sorted(EXTRAS)}))
"""
_COMMAND = """
import runpy
sys.argv = sys.argv[1:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
_ALL = """
import importlib, pkgutil
from polysft_mi.backend import set_variant
set_variant("llvm_ad_rgb")
import polyfit, onefit, polysft_mi
for module in pkgutil.walk_packages(polysft_mi.__path__, "polysft_mi."):
    if module.name not in ("polysft_mi.bridge", "polysft_mi.__main__"):
        importlib.import_module(module.name)
"""


def python(code, *arguments):
    return processes.python("-c", _BLOCKED + code, *arguments)


def test_polysft_imports_without_any_extra():
    done = python(_ALL)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "command, module",
    [
        ("polyfit.train -o OUT", "torch"),
        ("polyfit scenes/demo/template.obj -o OUT.ply", "torch"),
        ("onefit.train dress -o OUT", "torch"),
        ("onefit.drape dress walk -o OUT", "torch"),
        ("onefit.simulate dress walk -o OUT", "torch"),
        ("onefit.tailor -o OUT", "torch"),
        ("polysft_mi.batch scenes/demo.xml -o OUT", "ray"),
    ],
)
def test_a_command_names_the_extra_that_it_misses(command, module, tmp_path):
    arguments = command.replace("OUT", str(tmp_path / "out")).split()
    done = python(_COMMAND, *arguments)
    line = processes.refusal(done)
    assert f"{module} is not installed" in line and f"'polysft-mi[{EXTRAS[module]}]'" in line
    assert list(tmp_path.iterdir()) == []


def test_export_to_usd_names_the_extra_that_it_misses(finished_run, tmp_path):
    _, run = finished_run
    done = python(_COMMAND, "polysft_mi.export", run, "--format", "usd", "-o", tmp_path / "a.usdc")
    assert "'polysft-mi[usd]'" in processes.refusal(done)
    assert list(tmp_path.iterdir()) == []


def test_a_module_that_no_extra_brings_is_a_fault_of_ours():
    done = python("from polyfit.errors import cli\ncli(lambda: __import__('no_such_module'))")
    assert done.returncode == 1 and "Traceback" in done.stderr
