"""Depth images against surfaces: what is compared, and depth that is known up to a scale and a
shift.
"""

import cv2
import numpy as np
import pytest
from problems import data_of, problem_of

from polysft_mi.images import DepthData, DepthNoise, Level
from polysft_mi.scene import DepthImages

LEVEL, NOISE = Level(0.0), DepthNoise(2e-3, 2e-3, 2.5, 0.0)


FRAME = 2  # in which the sheet is bent


@pytest.fixture
def scene(truth):
    """(problem, the true vertices, their depth (H, W), 0 beside the surface)."""
    problem = problem_of(truth.folder, order=4)
    vertices = truth.vertices[FRAME]
    view = data_of(problem).view(vertices, LEVEL)
    (x, y), (w, h) = (int(view.region[k][0]) for k in (0, 1)), view.size
    depth = np.zeros((problem.camera.height, problem.camera.width))
    seen = np.array(view.triangle).reshape(h, w) >= 0
    depth[y : y + h, x : x + w] = np.where(seen, np.array(view.depth).reshape(h, w), 0)
    return problem, vertices, depth


def depth_of(problem, folder, numbers, unit, known_to="metric"):
    """:class:`DepthData` of one image of numbers, written in whole ``unit``; as they are without
    one.
    """
    whole, count = numbers.astype(np.float32), len(problem.sequence)
    if unit:
        whole = np.round(numbers / unit)
        assert whole.min() >= 0 and whole.max() < 65536
        whole = whole.astype(np.uint16)
    for k in range(count):
        assert cv2.imwrite(str(folder / f"{k}.{'png' if unit else 'tiff'}"), whole)
    given = str(folder), count, list(range(count)), unit, known_to
    problem.sequence.depth = DepthImages.open(*given)
    return DepthData(data_of(problem), problem.sequence)


def test_a_surface_is_compared_with_what_the_image_knows_of_it(scene, tmp_path):
    problem, vertices, depth = scene
    known = depth_of(problem, tmp_path, np.where(depth > 0, depth + 5e-3, 0), 1e-5)
    residual, z = known.residuals(vertices, FRAME, LEVEL)
    compared = np.isfinite(residual)
    mask = problem.sequence.mask(FRAME) > 0.5
    assert compared.sum() == (mask & (depth > 0)).sum() == np.isfinite(z).sum() > 1000
    assert np.abs(residual[compared] + 5e-3).max() < 2e-5
    energy, gradient, _ = known.sums(vertices, FRAME, LEVEL, NOISE)
    moved, _, _ = known.sums(vertices + (0, 0, 5e-3), FRAME, LEVEL, NOISE)
    assert moved < 1e-2 * energy
    assert gradient[..., 2].sum() < 0  # farther away is better
    empty = depth_of(problem, tmp_path, np.where(depth > 1, depth, 0) + (depth == 0), 1e-4)
    assert not np.isfinite(empty.residuals(vertices, FRAME, LEVEL)[0]).any()


@pytest.mark.parametrize("known_to", ["affine", "disparity"])
def test_a_scale_and_a_shift_are_fitted_though_some_pixels_are_wrong(scene, known_to, tmp_path):
    problem, vertices, depth = scene
    rng = np.random.default_rng(0)
    seen = depth > 0
    value = np.where(seen, depth if known_to == "affine" else 1 / np.maximum(depth, 1e-3), 0)
    numbers = np.where(seen, (value - 0.2) / 0.5, 0)
    wrong = seen & (rng.uniform(size=depth.shape) < 0.1)
    numbers = np.where(wrong, 1.3 * numbers, numbers)
    known = depth_of(problem, tmp_path, numbers, 1e-4, known_to)
    scale, shift = known.fitted(vertices, FRAME, LEVEL)
    assert scale == pytest.approx(0.5, rel=0.05)
    residual, _ = known.residuals(vertices, FRAME, LEVEL, (scale, shift))
    assert np.nanmedian(np.abs(residual)) < 5e-4
    energy, gradient, _ = known.sums(vertices, FRAME, LEVEL, NOISE, (scale, shift))
    pushed, _, _ = known.sums(vertices + (0, 0, 0.01), FRAME, LEVEL, NOISE, (scale, shift))
    assert energy < pushed and np.isfinite(gradient).all()
    # the fit goes along with a surface that is moved
    other = known.fitted(vertices + (0, 0, 0.01), FRAME, LEVEL)
    again, _, _ = known.sums(vertices + (0, 0, 0.01), FRAME, LEVEL, NOISE, other)
    assert again < pushed


@pytest.mark.parametrize("known_to", ["affine", "disparity"])
def test_a_network_s_numbers_may_be_0_and_below(scene, known_to, tmp_path):
    problem, vertices, depth = scene
    value = depth if known_to == "affine" else 1 / np.maximum(depth, 1e-3)
    middle = np.median(value[depth > 0])  # so that half of them are below 0
    numbers = np.where(depth > 0, (value - middle) / 0.5, np.nan)
    known = depth_of(problem, tmp_path, numbers, 0, known_to)
    fit = known.fitted(vertices, FRAME, LEVEL)
    assert fit[0] == pytest.approx(0.5, rel=0.01)
    residual, _ = known.residuals(vertices, FRAME, LEVEL, fit)
    inside = problem.sequence.mask(FRAME) > 0.5
    assert np.isfinite(residual).sum() == (inside & (depth > 0)).sum()
    assert np.nanmax(np.abs(residual)) < 1e-3


def test_metric_depth_is_taken_as_it_is(scene, tmp_path):
    problem, vertices, depth = scene
    known = depth_of(problem, tmp_path, 1.1 * depth, 1e-4)
    assert known.fitted(vertices, FRAME, LEVEL) == (1.0, 0.0)


def test_numbers_that_do_not_go_along_with_the_surface_say_nothing(scene, tmp_path):
    problem, vertices, depth = scene
    noise = np.random.default_rng(0).uniform(0.5, 1, depth.shape)
    known = depth_of(problem, tmp_path, np.where(depth > 0, noise, 0), 1e-4, "affine")
    assert known.fitted(vertices, FRAME, LEVEL) is None
