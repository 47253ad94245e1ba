"""One variant for the whole session, a cleared Dr.Jit between modules, and the data that is not in
the repository.
"""

import gc
import os
from pathlib import Path

import pytest
from places import ROOT

from polyfit.backend import set_variant
from polysft_mi.errors import InputError


def pytest_addoption(parser):
    parser.addoption(
        "--mode", default="llvm_ad_rgb", help="Mitsuba variant of the tests (default: llvm_ad_rgb)"
    )


def pytest_configure(config):
    # Each worker of pytest-xdist has its share of the cores, as have the processes that it starts:
    # threads that wait for one another's core double the time. Before NumPy and torch are imported.
    # Dr.Jit keeps its own: on one thread, Mitsuba waits for ever for an EXR that it reads
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 0))  # 0 in what starts them
    if workers:
        threads = str(max(1, (os.cpu_count() or 1) // workers))
        os.environ.setdefault("OMP_NUM_THREADS", threads)
        os.environ.setdefault("OPENBLAS_NUM_THREADS", threads)
    # Before the test modules are imported: classes that derive from Mitsuba's can be defined only
    # with a variant set
    try:
        config.variant = set_variant(config.getoption("--mode"))
    except InputError as error:
        raise pytest.UsageError(str(error)) from None


def pytest_report_header(config):
    return f"Mitsuba variant: {config.variant}"


@pytest.fixture(scope="module", autouse=True)
def cleared_dr_jit():
    """Leave no scene, memory or flag of one module to the next; compiled kernels are kept, for they
    cost most of the tests' time.

    An exception that pytest keeps for its report also keeps the scenes of its frames in Dr.Jit's
    registry, where the next module's virtual function calls would still compile their code.
    """
    yield
    import drjit as dr

    gc.collect()
    gc.collect()
    dr.sync_thread()
    dr.kernel_history_clear()
    dr.flush_malloc_cache()
    dr.detail.clear_registry()
    dr.set_flag(dr.JitFlag.Default, True)


@pytest.fixture(scope="session")
def shared_data():
    """The folder with the sequences that are too large or not free for the repository; POLYSFT_DATA
    names another.
    """
    folder = Path(os.environ.get("POLYSFT_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"the sequences are not at {folder} (POLYSFT_DATA names another folder)")
    return folder


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory):
    """``(truth, out)``: a short run as the command leaves it, and the true surface; to be read, not
    changed. Its jets are of order 4 at least: on so coarse a mesh, what the mesh's own edges say of
    normals and curvatures is near to what a jet of order 8 has only by luck.
    """
    import synthetic

    truth = synthetic.cloth(
        tmp_path_factory.mktemp("finished") / "sheet", frames=4, bend=2.5, turn=0.1
    )
    return truth, finished(truth, tmp_path_factory)


def finished(truth, tmp_path_factory):
    """The folder of a run on a sequence, with jets of order 4."""
    from polysft_mi import prepare, run

    prepare.main([str(truth.folder)])
    out = tmp_path_factory.mktemp("finished") / "out"
    words = [str(truth.folder / "scene.xml"), "-o", str(out), "-q"]
    assert run.main([*words, "--exr", "all", "-D", "order=4"]) == 0
    return out


@pytest.fixture(scope="session")
def finished_tube(tmp_path_factory):
    """``(truth, out)`` of a short run on a sleeve, whose texture has a seam and whose template has
    several patches; to be read, not changed.
    """
    from problems import small_tube

    truth = small_tube(tmp_path_factory.mktemp("finished"), frames=3)
    return truth, finished(truth, tmp_path_factory)
