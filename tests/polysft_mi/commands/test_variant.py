"""The variant is set by a name of the package, and what needs one says so."""

import os

import pytest
from old_llvm import OLD_LLVM
from processes import python, refusal

import polysft_mi
from polyfit import backend


def test_the_name_that_sets_it_is_handed_on():
    assert polysft_mi.set_variant is backend.set_variant
    assert "set_variant" in polysft_mi.__all__ and dir(polysft_mi) == polysft_mi.__all__
    look = "import sys, polysft_mi; print('polyfit.backend' in sys.modules)"
    assert python("-c", look).stdout.strip() == "False"


@pytest.mark.skipif(not OLD_LLVM, reason="needs an LLVM 15 to start Dr.Jit on")
@pytest.mark.parametrize("before", ["", 'mitsuba.set_variant("llvm_ad_rgb")'])
@pytest.mark.parametrize(
    "then", ["from polysft_mi import set_variant", "from polysft_mi.scene import register"]
)
def test_dr_jit_already_on_an_old_llvm_is_told(before, then):
    """As where the caller imported Mitsuba before, or set its variant, too, and LLVM 15 was found
    first: nothing may be computed then.
    """
    if "register" in then and not before:
        pytest.skip("without a variant there is nothing to register")
    code = f"""
import os, mitsuba
{before}
del os.environ["DRJIT_LIBLLVM_PATH"]
from polysft_mi.errors import cli
{then} as begin
cli(lambda: begin() and 0)
"""
    done = python("-c", code, env=os.environ | {backend.VARIABLE: OLD_LLVM[0]})
    assert "already runs on LLVM 15" in refusal(done)


@pytest.mark.parametrize("name", ["tracker.track", "render.PlacedMesh", "Problem"])
def test_a_name_that_needs_a_variant_says_so(name):
    package, _, name = f"polysft_mi.{name}".rpartition(".")
    done = python("-c", f"from {package} import {name}")
    said = done.stderr.splitlines()[-1]
    assert "InputError: polysft_mi." in said
    assert said.endswith(" needs a Mitsuba variant: call polysft_mi.set_variant() first")


def test_no_public_name_starts_dr_jit_before_a_variant_is_set():
    """It would take an LLVM, and the variant that is then asked for be refused."""
    code = """
import sys, polysft_mi
refused = []
for name in polysft_mi.__all__:
    try:
        getattr(polysft_mi, name)
    except polysft_mi.InputError:
        refused.append(name)
print("drjit" in sys.modules, "Problem" in refused, "Run" in refused)
"""
    assert python("-c", code).stdout.split() == ["False", "True", "False"]


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_while_mitsuba_is_loaded_waits_for_its_end():
    code = """
import builtins, os, signal
from polyfit.backend import set_variant
load = builtins.__import__
def interrupted(name, *how):
    if name == "drjit":
        builtins.__import__ = load
        os.kill(os.getpid(), signal.SIGINT)
    return load(name, *how)
builtins.__import__ = interrupted
try:
    set_variant()
except KeyboardInterrupt:
    set_variant()
    import drjit
    print("Ctrl-C", float(drjit.sum(drjit.arange(drjit.llvm.Float, 4))[0]))
"""
    assert python("-c", code).stdout.split() == ["Ctrl-C", "6.0"]
