"""The search for libLLVM, on libraries compiled here, and the choice of the variant, in processes
of their own.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from old_llvm import OLD_LLVM
from places import ROOT

from polyfit import backend
from polyfit.errors import InputError

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(not COMPILER, reason="needs a C compiler")


def library(folder, name, version=None):
    """A shared library in ``folder`` that tells ``version`` as LLVM 16 and newer do, or, as LLVM 15
    and older, none.
    """
    function = (
        "void LLVMGetVersion(unsigned *a, unsigned *b, unsigned *c)"
        " {{ *a = {}; *b = {}; *c = {}; }}".format(*version)
        if version
        else "int unused;"
    )
    path = os.path.join(str(folder), name)
    subprocess.run(
        [COMPILER, "-shared", "-fPIC", "-x", "c", "-", "-o", path],
        input=function,
        text=True,
        check=True,
    )
    return path


def python(code, **environment):
    """Run ``code`` in a fresh interpreter; variables given as None are unset."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    env = {name: value for name, value in env.items() if value is not None}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=env,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=100,
    )


def one_line_and_status_2(process):
    assert process.returncode == 2
    assert process.stdout == ""
    assert process.stderr.startswith("error: ") and process.stderr.count("\n") == 1, process.stderr
    return process.stderr


@pytest.fixture(autouse=True)
def no_choice(monkeypatch):
    monkeypatch.delenv(backend.VARIABLE, raising=False)


@needs_compiler
@pytest.mark.parametrize(
    "newest, others",
    [
        # by number and not by text; a name that says 9 is not even loaded
        (("libLLVM.so.19.1", (19, 1, 7)), {"libLLVM-9.so.1": 99, "libLLVM.so.18.1": 18}),
        # a name without a number is asked
        (("libLLVM.so", (22, 1, 0)), {"libLLVM.so.19.1": 19}),
        # what the library tells goes before its name
        (("libLLVM.so.19.1", (19, 1, 7)), {"libLLVM.so.22.1": 18}),
    ],
)
def test_the_newest_is_found(tmp_path, newest, others):
    path = library(tmp_path, *newest)
    for name, major in others.items():
        library(tmp_path, name, (major, 0, 0))
    assert backend.find_libllvm([str(tmp_path)]) == (path, newest[1])


@needs_compiler
def test_links_are_followed_and_folders_joined(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    real = library(tmp_path / "a", "libLLVM.so.19.1", (19, 1, 7))
    os.symlink(real, tmp_path / "b" / "libLLVM-19.so")
    library(tmp_path / "b", "libLLVM-16.so.1", (16, 0, 0))
    assert backend.find_libllvm([str(tmp_path / "missing"), str(tmp_path / "b")])[0] == real


@needs_compiler
def test_unusable_files_are_passed_over(tmp_path):
    (tmp_path / "libLLVM.so.22.1").write_text("not a library")
    (tmp_path / "libLLVM-21.so.1").mkdir()
    library(tmp_path, "libLLVM.so", None)  # loads, but is older than 16
    library(tmp_path, "libLLVM-C.so.23", (23, 0, 0))  # not the whole interface
    library(tmp_path, "libLLVMDemangle.so.23", (23, 0, 0))
    usable = library(tmp_path, "libLLVM-19.so.1", (19, 0, 0))
    assert backend.find_libllvm([str(tmp_path)])[0] == usable


@needs_compiler
def test_a_version_that_is_not_proven_must_run_a_kernel_first(tmp_path):
    library(tmp_path, "libLLVM.so.24.1", (24, 1, 0))  # tells a version, compiles nothing
    library(tmp_path, "libLLVM-16.so.1", (16, 0, 6))
    with pytest.raises(InputError, match=r"only LLVM 16, 24"):
        backend.find_libllvm([str(tmp_path)])
    proven = library(tmp_path, "libLLVM.so.19.1", (19, 1, 7))
    assert backend.find_libllvm([str(tmp_path)])[0] == proven


def test_the_trial_accepts_a_working_library_and_refuses_an_old_one(monkeypatch):
    """With the machine's own libraries; as if no version were proven."""
    monkeypatch.setattr(backend, "PROVEN_LLVM", ())
    path, version = backend.find_libllvm()
    assert os.path.isfile(path) and version[0] >= backend.OLDEST_LLVM
    for old in OLD_LLVM:
        assert not backend.variant_works("llvm_ad_rgb", library=old)


@needs_compiler
def test_none_found_names_the_older_ones_and_what_to_install(tmp_path):
    library(tmp_path, "libLLVM-15.so.1")
    library(tmp_path, "libLLVM-14.0.6.so.1")
    with pytest.raises(
        InputError,
        match=(
            r"no usable LLVM found \(only LLVM 14, 15\).*apt-get install"
            r" libllvm19.*DRJIT_LIBLLVM_PATH"
        ),
    ):
        backend.find_libllvm([str(tmp_path)])


def installed(folder, *files):
    """The folder of an installation of the package that brings an LLVM, with ``files`` [paths from
    there].
    """
    about = folder / "karellen_llvm_core-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: karellen-llvm-core\nVersion: 1.0\n"
    )
    (about / "RECORD").write_text("".join(f"{file},,\n" for file in files))
    return folder


@needs_compiler
def test_the_packages_llvm_is_taken_before_the_systems(tmp_path, monkeypatch):
    (tmp_path / "system").mkdir()
    (tmp_path / "lib").mkdir()
    systems = library(tmp_path / "system", "libLLVM.so.22.1", (22, 1, 0))
    own = library(tmp_path / "lib", "libLLVM.so.19.1", (19, 1, 7))
    os.symlink(own, tmp_path / "lib" / "libLLVM.so")
    library(tmp_path / "lib", "libLTO.so.19.1", (23, 0, 0))
    monkeypatch.setattr(backend, "_search_folders", lambda: [str(tmp_path / "system")])
    names = "libLLVM.so", "libLLVM.so.19.1", "libLTO.so.19.1", "libLLVM-gone.so"
    site = installed(tmp_path / "python" / "site", *(f"../../lib/{name}" for name in names))
    monkeypatch.syspath_prepend(str(site))
    assert backend.find_libllvm() == (own, (19, 1, 7))
    assert backend.llvm_line() == f"LLVM 19.1.7: {own} (karellen-llvm-core)"
    os.remove(own)  # as where it was installed, and cannot be loaded
    assert backend.find_libllvm() == (systems, (22, 1, 0))
    assert backend.llvm_line() == f"LLVM 22.1.0: {systems} (the system's)"
    monkeypatch.setattr(backend, "_search_folders", list)
    Path(own).write_text("no library")
    with pytest.raises(InputError, match="that of karellen-llvm-core cannot be loaded: start Py"):
        backend.find_libllvm()
    monkeypatch.setenv(backend.VARIABLE, systems)
    assert backend.llvm_line() == f"LLVM 22.1.0: {systems} (DRJIT_LIBLLVM_PATH)"


@needs_compiler
def test_the_users_choice_is_taken_before_newer_ones(tmp_path, monkeypatch):
    library(tmp_path, "libLLVM.so.19.1", (19, 1, 7))
    chosen = library(tmp_path, "mine.so", (19, 0, 0))
    monkeypatch.setenv(backend.VARIABLE, chosen)
    assert backend.find_libllvm([str(tmp_path)]) == (chosen, (19, 0, 0))


@needs_compiler
@pytest.mark.parametrize(
    "name, make, complaint",
    [
        ("missing.so", lambda path: None, "no such file"),
        ("libLLVM.so", lambda path: path.write_text("x"), "cannot be loaded"),
        ("libLLVM.so", lambda path: library(path.parent, path.name), "cannot be loaded"),
        ("libLLVM-15.so.1", lambda path: library(path.parent, path.name), "is LLVM 15"),
        ("libLLVM.so", lambda path: library(path.parent, path.name, (12, 0, 1)), "is LLVM 12"),
        (
            "libLLVM.so",
            lambda path: library(path.parent, path.name, (17, 0, 6)),
            "is LLVM 17, which Dr.Jit cannot use",
        ),
    ],
)
def test_a_bad_choice_is_refused_though_others_are_there(
    tmp_path, monkeypatch, name, make, complaint
):
    library(tmp_path, "libLLVM.so.19.1", (19, 1, 7))
    make(tmp_path / name)
    monkeypatch.setenv(backend.VARIABLE, str(tmp_path / name))
    with pytest.raises(
        InputError,
        match=f"DRJIT_LIBLLVM_PATH={tmp_path / name}: {complaint}.*give the file of a newer",
    ):
        backend.find_libllvm([str(tmp_path)])


def test_a_bad_choice_ends_the_command_in_one_line(tmp_path):
    code = (
        "from polyfit.backend import cli, set_variant; cli(lambda: set_variant('llvm_ad_rgb')"
        " and 0)"
    )
    message = one_line_and_status_2(python(code, DRJIT_LIBLLVM_PATH=str(tmp_path / "libLLVM.so")))
    assert str(tmp_path / "libLLVM.so") in message


def test_importing_has_no_side_effect():
    code = (
        "import os, sys, polyfit.backend; print([m for m in ('mitsuba', 'drjit', 'numpy',"
        " 'torch') if m in sys.modules], 'DRJIT_LIBLLVM_PATH' in os.environ)"
    )
    assert python(code, DRJIT_LIBLLVM_PATH=None).stdout.strip() == "[] False"


def test_library_users_get_a_working_variant_and_the_same_on_a_second_call():
    code = """
from polyfit.backend import set_variant
first = set_variant("llvm_ad_rgb")
import mitsuba as mi, drjit as dr, os
x = mi.Float(3)
print(first, set_variant("llvm_ad_rgb"), set_variant(), dr.detail.llvm_version()[0] >= 16)
print(os.path.isfile(os.environ["DRJIT_LIBLLVM_PATH"]), (x + 1)[0])
"""
    assert python(code, DRJIT_LIBLLVM_PATH=None).stdout.split() == ["llvm_ad_rgb"] * 3 + [
        "True",
        "True",
        "4.0",
    ]


def test_a_fitting_variant_that_is_set_stays_and_another_is_replaced():
    code = """
import mitsuba as mi
from polyfit.backend import set_variant
mi.set_variant("scalar_rgb")
print(set_variant("llvm_ad_rgb"), mi.variant())
mi.set_variant("scalar_rgb")
print(set_variant() in ("cuda_ad_rgb", "llvm_ad_rgb"), mi.variant() != "scalar_rgb")
"""
    usable = {backend.VARIABLE: backend.find_libllvm()[0]}  # Dr.Jit alone takes any that it finds
    assert python(code, **usable).stdout.split() == ["llvm_ad_rgb", "llvm_ad_rgb", "True", "True"]


@pytest.mark.parametrize("mode", ["scalar_rgb", "llvm_ad_spectral", "llvm", "", "nonsense"])
def test_an_unfit_mode_is_refused_with_the_fitting_ones(mode):
    import mitsuba as mi

    before = mi.variant()
    with pytest.raises(InputError, match=f"mode '{mode}': one of .*llvm_ad_rgb"):
        backend.set_variant(mode)
    assert mi.variant() == before


def test_the_default_is_llvm():
    """On a GPU too, which hardly gains."""
    code = "from polyfit import backend; backend.gpu_works = lambda: True;"
    assert python(code + "print(backend.set_variant())").stdout.strip() == "llvm_ad_rgb"


@pytest.mark.skipif(not backend.gpu_works(), reason="needs a GPU")
def test_cuda_is_had_by_its_name():
    done = python("from polyfit.backend import set_variant; print(set_variant('cuda_ad_rgb'))")
    assert done.stdout.strip() == "cuda_ad_rgb" and not done.stderr


@pytest.mark.skipif(backend.gpu_works(), reason="a GPU works here")
def test_without_a_gpu_cuda_is_refused():
    message = one_line_and_status_2(
        python(
            "from polyfit.backend import cli, set_variant; cli(lambda:"
            " set_variant('cuda_ad_rgb') and 0)"
        )
    )
    assert "cuda_ad_rgb" in message and "GPU" in message


def test_trying_a_variant_tells_working_from_broken(monkeypatch):
    """The GPU's own check, on the CPU's variant: it must see a ray and a derivative come out right,
    and survive a process that dies.
    """
    usable = backend.find_libllvm()[0]  # Dr.Jit alone takes any that it finds
    assert backend.variant_works("llvm_ad_rgb", library=usable)
    assert not backend.variant_works("scalar_rgb")  # no Dr.Jit arrays
    assert not backend.variant_works("llvm_ad_rgb", timeout=0.01)
    monkeypatch.setenv(backend.VARIABLE, "/nonexistent/libLLVM.so")
    assert not backend.variant_works("llvm_ad_rgb")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a way to take cores away")
def test_an_exr_file_is_read_on_a_machine_of_one_core(tmp_path):
    path = str(tmp_path / "image.exr")
    code = f"""
import os
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from polyfit.backend import set_variant
set_variant()
import mitsuba as mi
mi.Bitmap(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, [8, 8]).write({path!r})
print(mi.Bitmap({path!r}).size()[0])
"""
    done = python(code)
    assert done.stdout.split() == ["8"], done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs a way to take cores away")
def test_threads_are_those_of_the_cores_that_a_process_may_use():
    code = """
import os
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from polyfit.backend import cores, set_variant
set_variant()
import drjit as dr
print(cores(), dr.thread_count())
"""
    done = python(code)
    assert done.stdout.split() == ["1", "2"], done.stderr
