"""Sums on the device: pixels to triangles, triangles to vertices, each against a slow sum on the
host.
"""

import itertools

import numpy as np
import pytest
from problems import data_of, problem_of, small_cloth
from scipy.spatial.transform import Rotation

from polysft_mi.images.pyramid import Level

LEVEL = Level(1.0, 1, 8.0)


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return problem_of(small_cloth(tmp_path_factory.mktemp("data"), frames=3).folder)


def surfaces(problem):
    """Vertices (N, 3) [m] of the template: nearer and farther, turned, creased and folded over
    itself.
    """
    rest = problem.template.vertices
    middle = rest.mean(0)
    near = middle + (rest - middle) * [1.15, 1.05, 1.0] - [0, 0, 0.04]
    turned = Rotation.from_rotvec([0.4, 1.0, 0.2]).apply(rest - middle) + middle
    folded = rest.copy()
    right = rest[:, 0] > middle[0]
    folded[right, 0] = 2 * middle[0] - rest[right, 0] + 0.004
    folded[right, 2] -= 0.01
    return near, turned, folded, rest + [0, 0, 0.2]


def test_what_was_recorded_for_one_view_is_right_for_any_other(problem):
    """Kernels are recorded once, and replayed for regions, frames and outlines of any size."""
    known = data_of(problem)
    for vertices, level in itertools.product(surfaces(problem), (LEVEL, Level(2.0, 2, 8.0))):
        appearance = known.appearance(vertices + [0.003, 0, 0], level)
        a, b = (x.evaluate(vertices, 1, level, 0.3, appearance) for x in (known, data_of(problem)))
        assert (a.photometric, a.silhouette, a.misfit) == (b.photometric, b.silhouette, b.misfit)
        for name in ("gradient", "second"):
            first, other = (np.array(getattr(x.images, name)) for x in (a, b))
            assert np.abs(first).max() > 0 and np.array_equal(first, other)


def test_pixels_of_a_silhouette_pull_alike_in_every_run(problem):
    """Threads add to vertices in any order."""
    known = data_of(problem)
    vertices = surfaces(problem)[2]
    runs = [known.evaluate(vertices, 1, LEVEL, 0.3).images for _ in range(20)]
    for name in ("gradient", "second"):
        first, *others = (np.array(getattr(x, name)) for x in runs)
        assert np.abs(first).max() > 0 and all(np.array_equal(first, x) for x in others)


@pytest.mark.parametrize("shift", [3.0, 8.0, 16.0])
def test_a_silhouettes_step_goes_far(problem, shift):
    """Beside its mask, a sheet is moved back by half of what it is off, or more; plain Gauss-Newton
    would go one pixel.
    """
    known = data_of(problem)
    pixel = (
        problem.template.vertices[:, 2:].mean()
        / known.camera.intrinsics().fx
        * np.array([1.0, 0, 0])
    )  # one to the right
    vertices = problem.template.vertices + shift * pixel
    images = known.evaluate(vertices, 0, Level(1.0), 1e-6).images  # at this scale no texture pulls
    slope = (np.array(images.gradient).reshape(-1, 3) @ pixel).sum()
    second, (i, j) = (
        np.array(images.second).reshape(-1, 2, 2)[:, 0, 0],
        (np.array(x) for x in (known.gather.tables.i, known.gather.tables.j)),
    )
    curvature = second[i == j].sum() + 2 * second[i != j].sum()
    assert 0.4 * shift < slope / curvature < 1.1 * shift
