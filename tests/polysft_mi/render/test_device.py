"""Recorded functions, Ctrl-C in the middle of them, and their threads."""

import gc
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from problems import problem_of, small_cloth

from polyfit.backend import cores
from polysft_mi.render.device import frozen, interruptible, threads
from polysft_mi.render.raster import RasterIntegrator
from polysft_mi.tracker import FrameTracker, Track, track


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return problem_of(small_cloth(tmp_path_factory.mktemp("data"), frames=3).folder)


@pytest.mark.parametrize("where", ["loop", "record"])
@pytest.mark.parametrize("kind", [KeyboardInterrupt, ZeroDivisionError])
def test_ctrl_c_in_the_middle_of_a_loop_or_a_recording(where, kind):
    """Dr.Jit makes a RuntimeError of whatever is raised there."""

    def stop(*_):
        raise kind

    def work():
        if where == "loop":
            dr.while_loop((mi.Float([1.0, 2.0]),), lambda x: x < 3, stop)
        else:
            frozen(stop)(mi.Float([1.0, 2.0]))

    with (
        pytest.raises(KeyboardInterrupt if kind is KeyboardInterrupt else RuntimeError),
        interruptible(),
    ):
        work()
    assert np.array_equal(
        np.array(frozen(lambda x: x + 1)(mi.Float([1.0, 2.0]))), [2, 3]
    )  # what comes after works


def test_ctrl_c_in_the_middle_of_an_evaluation_ends_the_track_as_anywhere(
    problem, tmp_path, monkeypatch
):
    tracker, solved, original = FrameTracker(problem), [], RasterIntegrator.crossings

    def crossings(self, view, outline=False):
        if len(solved) == 2:
            return dr.while_loop((mi.Float([1.0]),), lambda x: x < 3, stop)
        return original(self, view, outline)

    def stop(x):
        raise KeyboardInterrupt

    monkeypatch.setattr(RasterIntegrator, "crossings", crossings)
    with pytest.raises(KeyboardInterrupt):
        track(tracker, 3, str(tmp_path), solved=lambda frame, vertices: solved.append(frame))
    assert len(Track.load(str(tmp_path / "checkpoint.npz")).states) == 2


def test_nothing_is_collected_while_a_function_is_recorded():
    state = SimpleNamespace(collecting=None)

    def work(x):
        state.collecting = gc.isenabled()
        return x + 1

    frozen(work)(mi.Float([1.0, 2.0]))
    assert state.collecting is False and gc.isenabled()


def test_a_share_of_the_cores():
    before = dr.thread_count()
    with threads(1.0):
        assert dr.thread_count() == cores()
        with threads(1e-3):
            assert dr.thread_count() == 1
    assert dr.thread_count() == before
