"""Sums on the device: pixels to triangles, triangles to vertices, each against a slow sum on the
host.
"""

import dataclasses
import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from problems import data_of, problem_of, small_cloth
from scipy.spatial.transform import Rotation

from polysft_mi.images import pixels
from polysft_mi.images.pyramid import MAX_CONTOUR_DISTANCE, Level
from polysft_mi.render.device import on_device

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


def test_sums_over_each_triangles_pixels(problem):
    known, rng = data_of(problem), np.random.default_rng(2)
    for vertices in surfaces(problem):
        view = known.view(vertices, LEVEL)
        triangle = np.array(view.triangle)
        found = rng.random((3, len(triangle), 4)).astype(np.float32)
        arrays = [mi.Vector4f(*(on_device(x[:, k], mi.Float) for k in range(4))) for x in found]
        table, figures = (
            np.array(x).reshape(len(known.faces), -1)
            for x in pixels.by_triangle(view.seen(), known.sheet, arrays)
        )
        expected = np.zeros((len(known.faces), 31))
        for t, second, slope, figure in zip(triangle, *found.astype(np.float64)):
            if t >= 0:
                corner = 1 - second[3] - slope[3], second[3], slope[3]
                expected[t, :18] += np.concatenate(
                    [corner[a] * corner[b] * second[:3] for a, b in pixels.CORNERS]
                )
                expected[t, 18:] += np.concatenate([*(b * slope[:3] for b in corner), figure])
        assert (triangle >= 0).sum() > 300
        assert (
            np.abs(np.column_stack([table, figures]) - expected).max()
            < 1e-5 * np.abs(expected).max()
        )


def test_a_triangle_behind_the_camera_misses_no_pixel_of_the_others(problem):
    known = data_of(problem)
    vertices = problem.template.vertices.copy()
    vertices[0, 2] = -0.5
    view = known.view(vertices, LEVEL)
    ones = [
        mi.Vector4f(*(dr.select(view.hit, mi.Float(x), 0) for x in (0.0, 0.0, 0.0, 1.0)))
    ] * 2 + [mi.Vector4f(dr.select(view.hit, mi.Float(1), 0))]
    _, figures = pixels.by_triangle(view.seen(), known.sheet, ones)
    seen = np.bincount(np.array(view.triangle) + 1, minlength=len(known.faces) + 1)[1:]
    assert seen.any() and np.array_equal(np.array(figures).reshape(-1, 4)[:, 0], seen)


def test_what_is_recorded_is_what_is_traced(problem):
    """Of regions, frames and outlines of any size, by the same record."""
    known = data_of(problem)
    levels = LEVEL, Level(2.0, 2, 8.0)
    sizes = set()
    for (k, vertices), level in itertools.product(enumerate(surfaces(problem)), levels):
        appearance = known.appearance(vertices + [0.003, 0, 0], level) if k else None
        with dr.suspend_grad():
            view = known.view(vertices, level)
            sizes.add(view.size)
            at, crossings = (
                known._frames.level(1, level),
                known._raster.crossings(view, outline=True),
            )
            given = *known._residual_arguments(view, 1, level, appearance), dr.opaque(mi.Float, 0.3)
            outline = view.seen(), crossings, at.mask, at.distance, known._corner_of
            table, figures = known._sums(*given)
            _, pairs = known._outline(*outline)
            numbers = on_device([1.0, 0.3, at.area, 1 / level.stride], mi.Float64)
            at_vertices = (
                known.gather.tables,
                table,
                figures,
                on_device(vertices, mi.Float64),
                known.gather.camera,
                numbers,
                pairs,
            )
            for recorded, arguments in (
                (known._sums, given),
                (known._outline, outline),
                (known.gather._at_vertices, at_vertices),
            ):
                for a, b in zip(
                    flat(recorded(*arguments)), flat(recorded.__wrapped__(*arguments)), strict=True
                ):
                    assert np.array_equal(a, b, equal_nan=True), (recorded, level)
    assert len(sizes) == 2 * len(surfaces(problem))
    # with and without excess, or where sizes of other arrays agree: never once a call
    assert all(
        1 <= f.recorded.n_recordings <= 3
        for f in (known._sums, known._outline, known.gather._at_vertices)
    )


def flat(found):
    """The arrays of a tree, as NumPy's."""
    if found is None:
        return []
    if dataclasses.is_dataclass(found):
        found = tuple(getattr(found, field.name) for field in dataclasses.fields(found))
    return (
        [x for part in found for x in flat(part)] if isinstance(found, tuple) else [np.array(found)]
    )


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


def test_beyond_the_surroundings_of_the_mask_a_silhouette_is_as_far_as_counts(problem):
    known, mask = (
        data_of(problem),
        pixels.Image.of(on_device(np.zeros(400), mi.Float), (20, 20), (2, 3)),
    )
    with dr.suspend_grad():
        view = known.view(problem.template.vertices, LEVEL)
        crossings, distance = (
            known._raster.crossings(view, outline=True),
            on_device(np.full(400, 2.0), mi.Float),
        )
        _, (*_, ci, cj, _excess, share) = pixels.silhouette_terms(
            view.seen(), crossings, mask, distance, known._corner_of
        )
    assert int(view.region[0][0]) > 2 + 20
    slope = np.linalg.norm(np.array(ci + cj), axis=0)
    assert (
        np.allclose(np.array(share), 1 / np.maximum(1, MAX_CONTOUR_DISTANCE * slope), rtol=1e-5)
        and (np.array(share) < 0.1).any()
    )
