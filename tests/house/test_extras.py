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
from polyfit.backend import set_variant
set_variant("llvm_ad_rgb")
import polyfit, onefit, polysft_mi
for module in pkgutil.walk_packages(polysft_mi.__path__, "polysft_mi."):
    if module.name not in ("polysft_mi.bridge", "polysft_mi.__main__"):
        importlib.import_module(module.name)
"""


_JETS = """
import numpy as np, polyfit, polysft_mi
from polyfit import CanonicalFrame, jets
x = np.random.default_rng(0).normal(size=(50, 3)) * (3, 2, 1)
x = CanonicalFrame.from_points(x).to_chart(x)
jets.principal_curvatures(jets.fit_points(x, 3).alpha, jets.point(np.ones(6), x[:, :2])[:, :2])
"""
_RUN = """
from polyfit import backend; backend.set_variant("llvm_ad_rgb")
import polysft_mi.run, polysft_mi.scene.experiment, polysft_mi.solvers, polysft_mi.report
import numpy as np
from polysft_mi.surface.template import Template
x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 2, 4)))
square = (0, 1, 4), (1, 5, 4)
faces = [[4 * r + c + k for k in f] for r in range(3) for c in range(3) for f in square]
Template.fit(np.stack([x, y, 0 * x], 1), np.array(faces), np.stack([x, y], 1), 2)
"""
_FIGURES = """
import polysft_mi.pictures.figures, polysft_mi.results.metrics, polysft_mi.evaluate
import polysft_mi.pictures.exr, polyfit.pictures.video, polysft_mi.surface.meshio
"""
_PUBLIC = "onefit.load, onefit.Garment, onefit.AnnyBody, onefit.Motion, onefit.SmplBody"
LIGHT = {
    "import polyfit; dir(polyfit)": "torch mitsuba drjit pyvista numpy",
    "import polyfit; polyfit.PatchedSurface, polyfit.PolyFit": "mitsuba drjit polysft_mi onefit",
    "from polyfit.pictures import write_video": "torch mitsuba drjit av cv2",
    "import onefit": "torch numpy mitsuba drjit warp anny polysft_mi",
    "import polysft_mi": "torch numpy mitsuba drjit onefit",
    f"import onefit; {_PUBLIC}": "mitsuba polysft_mi",
    "from onefit.body import AnnyBody; AnnyBody().body()": "warp mitsuba",
    "import polysft_mi.__main__ as m; m.main(['--help'])": "numpy torch mitsuba plotly pxr",
    _FIGURES: "matplotlib OpenEXR trimesh skimage scipy rich mitsuba torch cv2",
    _JETS: "torch drjit mitsuba",
    _RUN: "torch",
}


@pytest.mark.parametrize("code", LIGHT)
def test_what_is_light_loads_nothing_heavy_and_says_nothing(code):
    look = f"import sys; print(sorted({set(LIGHT[code].split())} & set(sys.modules)))"
    done = processes.python("-c", f"{code}\n{look}")
    assert done.stderr == "" and done.stdout.splitlines()[-1] == "[]", done.stdout


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
