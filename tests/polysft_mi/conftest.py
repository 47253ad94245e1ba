"""The small cloth that many tests look at, and the tracker's problem of it."""

import pytest


@pytest.fixture(scope="session")
def truth(tmp_path_factory):
    """Four frames of a small cloth, as :mod:`synthetic` makes them."""
    from problems import small_cloth

    return small_cloth(tmp_path_factory.mktemp("data"), frames=4)


@pytest.fixture(scope="session")
def tube(tmp_path_factory):
    """Four frames of a small sleeve, held by several patches."""
    from problems import small_tube

    return small_tube(tmp_path_factory.mktemp("data"), frames=4)


@pytest.fixture(scope="session")
def tracked(truth, tmp_path_factory):
    """The :class:`polysft_mi.tracker.Track` of ``truth`` under the default settings."""
    from problems import problem_of

    from polysft_mi.tracker import FrameTracker, track

    problem = problem_of(truth.folder)
    folder = str(tmp_path_factory.mktemp("tracked"))
    return track(FrameTracker(problem), 4, folder)


@pytest.fixture(scope="module")
def tube_problem(tube):
    """The problem of ``tube``, its images compared as they are; jets of order 4."""
    from problems import problem_of

    return problem_of(tube.folder, brightness="none", order=4)


@pytest.fixture(scope="module")
def problem(truth):
    """The problem of ``truth``, its images compared as they are."""
    from problems import problem_of

    return problem_of(truth.folder, brightness="none")
