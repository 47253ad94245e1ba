"""What Mitsuba computes on: the variant, and the LLVM library that the CPU variants need.

Dr.Jit compiles its CPU kernels with a libLLVM that it loads at run time, and takes the first one
that it finds. LLVM 14 is refused, and LLVM 15 and 16 end the process in the middle of a render,
past any ``try`` (x86-64: "Cannot select: fminimum"); so the library is chosen here, before Dr.Jit
starts: the one that the user names, else that of the Python package ``karellen-llvm-core``, which
is the same on every machine and comes with this package where it exists, else the system's.
Command lines, tests and library users all call :func:`set_variant`. Importing this module has no
side effect and needs the standard library alone; ``python -m polyfit.backend`` and
``polysft --version`` print the library that would be used.
"""

import contextlib
import ctypes
import functools
import glob
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Iterable, Iterator
from importlib import metadata

from .errors import InputError, cli

_Version = tuple[int, ...]

OLDEST_LLVM = 16  # the first that tells its version; an older one is not tried
PROVEN_LLVM = (19, 22, 23)  # what the tests passed with; any other is tried before it is used
VARIABLE = "DRJIT_LIBLLVM_PATH"  # Dr.Jit's own
_PACKAGE = "karellen-llvm-core"  # the Python package that brings a libLLVM
DEFAULT = "llvm_ad_rgb"  # the one that the tests passed on
# what the code needs of a variant: Dr.Jit arrays with derivatives, three colour channels
_SUFFIX = "_ad_rgb"

# libLLVM-15.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1, libLLVM.so, libLLVM.dylib; not libLLVM-C.so
# (a part of the interface alone). Windows: LLVM-C.dll, the whole of it
_NAME = re.compile(
    r"libLLVM(?:-(?P<before>\d[\d.]*))?\.(?:so|dylib)(?:\.(?P<after>\d[\d.]*))?|LLVM-C\.dll"
)

# Where packages of Linux distributions, FreeBSD, Homebrew and LLVM's installer for Windows put it
_FOLDERS = (
    "/usr/local/lib*",
    "/usr/lib/*-linux-gnu*",
    "/usr/lib64",
    "/usr/lib",
    "/lib64",
    "/usr/lib*/llvm*/lib*",
    "/usr/lib*/llvm/*/lib*",
    "/usr/local/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "C:/Program Files/LLVM/bin",
)

# In a process of its own: loading two LLVMs into one process, or one whose own libraries are
# missing, can end it. LLVMGetVersion exists from LLVM 16 on, so a library without it is too old.
_ASK_VERSION = """
import ctypes, sys
numbers = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*[ctypes.byref(number) for number in numbers])
print(*[number.value for number in numbers])
"""

# One ray against one rectangle, a derivative, and the instruction that LLVM 15 and 16 lack: needs a
# driver, a device, the compiler, and (on a GPU) OptiX
_TRY_VARIANT = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
import drjit as dr
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
distance = mi.Float(2, 3)
dr.enable_grad(distance)
hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, distance), mi.Vector3f(0, 0, -1)))
area = dr.minimum(hit.t * distance, 8)
dr.backward(area)
found = [*area, *dr.grad(distance)]
print(all(abs(x - y) < 1e-4 for x, y in zip(found, (4, 8, 4, 0))))  # processors round differently
"""


def find_libllvm(folders: Iterable[str] | None = None) -> tuple[str, _Version]:
    """The libLLVM that Dr.Jit shall use.

    ``DRJIT_LIBLLVM_PATH`` goes before everything, and must then hold. Else it is that of the Python
    package ``karellen-llvm-core``, where it is installed and works; else the newest usable one in
    the environment's folders, the system's usual ones, and what ``ldconfig`` knows. With
    ``folders``, only these are searched. Each file is asked for its version. One that is not in
    ``PROVEN_LLVM`` must compile and run a kernel first. Asking and trying happen in processes of
    their own.

    Returns (path, version): the file's real path, and its version as a tuple of three ints. Raises
    :class:`InputError` where ``DRJIT_LIBLLVM_PATH`` names what cannot be used, or where nothing is
    found.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen:
        return chosen, _check_chosen(chosen)
    unusable: set[int] = set()
    for paths in (
        _of_package() if folders is None else [],
        _libraries(_search_folders() if folders is None else folders),
    ):
        versions = {}
        for path in paths:
            version = _version(path)
            if version and version[0] >= OLDEST_LLVM:
                versions[path] = version
            elif version:
                unusable.add(version[0])
        for path in sorted(versions, key=versions.__getitem__, reverse=True):
            if _usable(path, versions[path]):
                return path, versions[path]
            unusable.add(versions[path][0])
    found = f" (only LLVM {', '.join(str(v) for v in sorted(unusable))})" if unusable else ""
    if folders is None and _of_package():  # its links are made by the first start of Python
        found += f" (that of {_PACKAGE} cannot be loaded: start Python once as its installer)"
    raise InputError(
        f"no usable LLVM found{found}, which rendering on the CPU needs: install one (Linux on"
        f" x86-64: pip install {_PACKAGE}; Debian, Ubuntu: apt-get install libllvm19; Fedora: dnf"
        " install llvm-libs; macOS: brew install llvm; Windows: winget install LLVM.LLVM), or set"
        f" {VARIABLE} to the file of its libLLVM"
    )


def llvm_line() -> str:
    """The LLVM that would be used, in a line for people: version, file, and who brought it. Raises
    :class:`InputError` as :func:`find_libllvm` does.
    """
    path, version = find_libllvm()
    if os.environ.get(VARIABLE):
        origin = VARIABLE
    else:
        origin = _PACKAGE if path in _of_package() else "the system's"
    return f"LLVM {'.'.join(str(number) for number in version)}: {path} ({origin})"


def set_variant(mode: str | None = None) -> str:
    """Set Mitsuba's variant; a second call with the same mode does nothing. Best called before
    ``import mitsuba``, which makes Dr.Jit choose an LLVM.

    ``mode``: a variant that ends in ``_ad_rgb``. None takes one that is already set and fits, else
    ``llvm_ad_rgb``. ``cuda_ad_rgb`` is taken only where it is asked for: it hardly gains.

    Returns the variant's name. Raises :class:`InputError` where the mode is unknown or does not
    fit, a GPU is asked for and none works, LLVM is missing, or this process was forked from one
    that had rendered.
    """
    _refuse_fork()
    mitsuba = sys.modules.get("mitsuba")
    current = mitsuba and mitsuba.variant()
    if current and (mode == current or mode is None) and current.endswith(_SUFFIX):
        _refuse_llvm(current)
        _fit_threads()
        return current
    if mode is None:
        mode = DEFAULT
    try:  # before the import, which already starts Dr.Jit and makes it look for an LLVM
        os.environ[VARIABLE], _ = find_libllvm()
    except InputError:
        if mode.startswith("llvm"):
            raise
    with _without_ctrl_c():
        import mitsuba as mi

    known = [name for name in mi.variants() if name.endswith(_SUFFIX)]
    if mode not in known:
        raise InputError(f"mode {mode!r}: one of {', '.join(known)} is needed")
    if mode.startswith("cuda") and (reason := _gpu_fails()):
        raise InputError(
            f"mode {mode!r}: no working GPU (NVIDIA, its driver, OptiX) was found: {reason};"
            " leave the mode out, or give llvm_ad_rgb"
        )
    try:
        with _without_ctrl_c():
            mi.set_variant(mode)
    except ImportError as error:
        raise InputError(
            f"mode {mode!r} cannot be used here: {' '.join(str(error).split())}"
        ) from None
    _refuse_llvm(mode)
    _fit_threads()
    return mode


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Ctrl-C waits for the end of the block: an extension that is interrupted while it is loaded
    ends the process.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _refuse_llvm(mode: str) -> None:
    """Where Mitsuba or Dr.Jit was imported before, it may run on another LLVM than it should, which
    would end the process.
    """
    import drjit as dr

    if not mode.startswith("llvm") or (running := dr.detail.llvm_version())[0] in PROVEN_LLVM:
        return
    if running != find_libllvm()[1]:
        raise InputError(
            f"Dr.Jit already runs on LLVM {running[0]}: call polysft_mi.set_variant before"
            f" importing mitsuba or drjit, or set {VARIABLE}"
        )


_process = None  # the one in which set_variant was last called


def _refuse_fork() -> None:
    """A forked child has no threads but its own, and Dr.Jit would wait for ever for those that its
    parent computed with.
    """
    global _process
    dr = sys.modules.get("drjit")
    if dr and any(dr.detail.launch_stats()):
        forked = _process not in (None, os.getpid())
        with contextlib.suppress(OSError):  # Linux's alone; for those who rendered without us
            forked = forked or len(os.listdir("/proc/self/task")) == 1
        if forked:
            raise InputError(
                "this process was forked from one that had rendered, and Dr.Jit would wait for ever"
                " for threads that stayed there: start it with multiprocessing's 'spawn', or"
                " render nothing before the fork"
            )
    _process = os.getpid()


def cores() -> int:
    """How many processor cores this process may use, as ``taskset`` or a batch system leaves it."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _fit_threads() -> None:
    """A thread a core that may be used, where Dr.Jit has one for each that there is: threads that
    wait for one another's core double the time. At least two: with one, Mitsuba would wait for
    ever for an EXR file.
    """
    import drjit as dr

    if dr.thread_count() in (1, os.cpu_count()):
        dr.set_thread_count(max(2, cores()))


def gpu_works() -> bool:
    """Whether ``cuda_ad_rgb`` computes and traces rays here; costs nothing on a machine without an
    NVIDIA driver.
    """
    return not _gpu_fails()


@functools.cache
def _gpu_fails() -> str:
    """Why there is no GPU that works, in words; empty where one does."""
    if not _driver_sees_device():
        return "the driver (libcuda.so.1) is missing or sees none"
    return _variant_fails("cuda_ad_rgb")


def variant_works(mode: str, library: str | None = None, timeout: float = 120.0) -> bool:
    """Whether a variant traces a ray and takes a derivative, in a process of its own so that a
    broken driver or compiler cannot end this one.

    ``library``: the libLLVM to do it with (default: what Dr.Jit takes). ``timeout``: seconds after
    which it counts as not working.
    """
    return not _variant_fails(mode, library, timeout)


def _variant_fails(mode: str, library: str | None = None, timeout: float = 120.0) -> str:
    """Why a variant does not work, in words; empty where it does."""
    with tempfile.TemporaryDirectory() as empty:
        # Dr.Jit's cache on the disk would answer with kernels that another LLVM compiled
        environment = (
            {**os.environ, VARIABLE: library, "DRJIT_CACHE_DIR": empty} if library else None
        )
        code = [sys.executable, "-c", _TRY_VARIANT, mode]
        try:
            tried = subprocess.run(
                code,
                env=environment,
                capture_output=True,
                text=True,
                timeout=timeout,
                stdin=subprocess.DEVNULL,
            )
        except OSError as error:
            return str(error)
        except subprocess.TimeoutExpired:
            return f"no answer in {timeout:g} seconds"
    if tried.returncode == 0 and tried.stdout.split()[-1:] == ["True"]:
        return ""
    if tried.returncode == 0:
        return "it computes what is wrong"
    said = tried.stderr.split("\n")
    return next((line for line in reversed(said) if line.strip()), f"status {tried.returncode}")


def add_mode_argument(parser: ArgumentParser) -> None:
    """Give an ``argparse`` parser ``-m`` / ``--mode`` as Mitsuba's own command line has it; its
    value is for :func:`set_variant`.
    """
    parser.add_argument(
        "-m",
        "--mode",
        metavar="VARIANT",
        help=f"Mitsuba variant (default: {DEFAULT}; cuda_ad_rgb needs a GPU: docs/gpu.md)",
    )


def _driver_sees_device() -> bool:
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        count = ctypes.c_int()
        return (
            driver.cuInit(0) == 0
            and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
            and count.value > 0
        )
    except (OSError, AttributeError):
        return False


def _check_chosen(path: str) -> _Version:
    accepted = "give the file of a newer libLLVM (19, say), or unset it to have one searched"
    if not os.path.isfile(path):
        raise InputError(f"{VARIABLE}={path}: no such file; {accepted}")
    version = _version(path)
    if version is None:
        raise InputError(
            f"{VARIABLE}={path}: cannot be loaded as an LLVM {OLDEST_LLVM} or newer; {accepted}"
        )
    if not _usable(path, version):
        raise InputError(
            f"{VARIABLE}={path}: is LLVM {version[0]}, which Dr.Jit cannot use here; {accepted}"
        )
    return version


def _usable(path: str, version: _Version) -> bool:
    return version[0] >= OLDEST_LLVM and (
        version[0] in PROVEN_LLVM or variant_works("llvm_ad_rgb", library=path)
    )


def _of_package() -> list[str]:
    """The libLLVM files of the Python package ``_PACKAGE``, real paths; none where it is not
    installed.
    """
    try:
        files = metadata.distribution(_PACKAGE).files or []
    except metadata.PackageNotFoundError:
        return []
    located = [str(file.locate()) for file in files if _NAME.fullmatch(file.name)]
    return list(dict.fromkeys(os.path.realpath(path) for path in located if os.path.isfile(path)))


def _search_folders() -> list[str]:
    prefixes = [os.environ.get("CONDA_PREFIX"), sys.prefix, sys.base_prefix]
    below = ("Library", "bin") if sys.platform == "win32" else ("lib",)
    folders = [os.path.join(prefix, *below) for prefix in prefixes if prefix]
    variable = "PATH" if sys.platform == "win32" else "LD_LIBRARY_PATH"
    folders += [folder for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
    for pattern in _FOLDERS:
        folders += sorted(glob.glob(pattern))
    ldconfig = shutil.which(
        "ldconfig", path=os.pathsep.join([os.environ.get("PATH", ""), "/sbin", "/usr/sbin"])
    )
    if ldconfig and sys.platform.startswith("linux"):
        listed = subprocess.run(
            [ldconfig, "-p"], capture_output=True, text=True, stdin=subprocess.DEVNULL
        ).stdout
        folders += [
            os.path.dirname(line.rpartition("=> ")[2])
            for line in listed.splitlines()
            if "libLLVM" in line and "=> " in line
        ]
    return folders


def _libraries(folders: Iterable[str]) -> list[str]:
    """The libLLVM files in the folders, each real file once, in the folders' order."""
    found: dict[str, None] = {}
    for folder in folders:
        for path in sorted(glob.glob(os.path.join(glob.escape(folder), "*LLVM*"))):
            if _NAME.fullmatch(os.path.basename(path)) and os.path.isfile(path):
                found.setdefault(os.path.realpath(path), None)
    return list(found)


def _named_version(path: str) -> _Version | None:
    """The version that a file's name tells, as a tuple of ints, or None: libLLVM-14.0.6.so.1 is
    (14, 0, 6), libLLVM.so.19.1 is (19, 1).
    """
    name = _NAME.fullmatch(os.path.basename(os.path.realpath(path)))
    text = name and (name["before"] or name["after"])
    return tuple(int(part) for part in text.split(".") if part) if text else None


def _version(path: str) -> _Version | None:
    """A library's version as a tuple of ints, told by its name if that is too old to be loaded,
    else by itself; None where it does not load or does not tell.
    """
    named = _named_version(path)
    if named and named[0] < OLDEST_LLVM:
        return named
    code = [sys.executable, "-I", "-S", "-c", _ASK_VERSION, path]
    try:
        asked = subprocess.run(
            code, capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    numbers = asked.stdout.split()
    return (
        tuple(int(number) for number in numbers)
        if asked.returncode == 0 and len(numbers) == 3
        else None
    )


def main() -> None:
    print(llvm_line())


if __name__ == "__main__":
    cli(main)
