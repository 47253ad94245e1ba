"""What the camera's blur makes of a sheet: against a rendering of many samples, and frames of
slanted, lit sheets against their own images.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from problems import data_of, problem_of
from scipy.spatial.transform import Rotation

from polysft_mi.images import pixels
from polysft_mi.images.pyramid import Level, level_image
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import FrameTracker, track

LIGHT = np.array([0.6, 0.45, 0.0, -0.3])
LEVELS = [Level(1.0, 1, 8.0), Level(2.5, 2, 8.0)]


def chequers(size=192, across=16):
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:size, :size] * across // size
    return np.where(
        ((x + y) % 2)[..., None] > 0,
        rng.integers(30, 90, (across, across, 3))[y, x],
        rng.integers(150, 240, (across, across, 3))[y, x],
    ).astype(np.uint8)


def cloth(folder, **more):
    patch = pytest.MonkeyPatch()
    patch.setattr(synthetic, "texture_image", chequers)
    try:
        return synthetic.cloth(folder, size=(200, 150), rows=9, columns=12, **more)
    finally:
        patch.undo()


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return cloth(tmp_path_factory.mktemp("appearance") / "cloth", frames=4, bend=11.0, light=LIGHT)


@pytest.fixture(scope="module")
def unmasked(tmp_path_factory):
    return cloth(tmp_path_factory.mktemp("appearance") / "unmasked", frames=2, masks=False)


@pytest.fixture(scope="module")
def problem(truth):
    return problem_of(truth.folder)


def slanted(vertices, degrees=62.0):
    return Rotation.from_rotvec([0, math.radians(degrees), 0]).apply(
        vertices - vertices.mean(0)
    ) + vertices.mean(0)


def compared(known, vertices, frame, level, appearance):
    """(what is compared with a frame (h, w, 3), where (h, w)) of the level's grid of the whole
    image.
    """
    with dr.suspend_grad():
        view = known._view(vertices, level)
        at = known._frames.level(frame, level).image
        residual, weight, *_ = pixels.residuals(
            *known._residual_arguments(view, frame, level, appearance)
        )
        pixel, inside = at.at(*pixels.pixel_coordinates(view))
        seen = residual + dr.gather(mi.Vector4f, at.texels, pixel, inside)
    x0, y0, *_ = (int(k[0]) for k in view.region)
    w, h = view.size
    rows, columns = known.camera.height // level.stride, known.camera.width // level.stride
    colour, where = np.zeros((rows, columns, 3)), np.zeros((rows, columns), bool)
    colour[y0 : y0 + h, x0 : x0 + w] = np.array(seen).T[:, :3].reshape(h, w, 3)
    where[y0 : y0 + h, x0 : x0 + w] = np.array(weight).reshape(h, w) > 0
    return colour, where


@pytest.mark.parametrize("level", LEVELS)
def test_it_is_a_rendering_made_what_frames_are_made(problem, level):
    known = data_of(problem)
    vertices = slanted(problem.template.vertices)
    appearance = known.appearance(vertices, level)
    with dr.suspend_grad():
        known._view(vertices, Level(1.0))
        image = np.array(known._raster.image(problem.placed.scene, problem.placed.sensor, spp=36))
    cover = (image[..., 3] > 0.5).astype(np.float32)
    colour = (image[..., :3] / np.maximum(image[..., 3:], 1e-3) * cover[..., None]).astype(
        np.float32
    )
    reference = level_image(colour, cover, level)
    x, y = reference.corner
    rows, columns = reference.inside.shape
    found, where = compared(known, vertices, 0, level, appearance)
    plain, _ = compared(known, vertices, 0, level, None)
    here = where[y : y + rows, x : x + columns] & (
        reference.inside[: where.shape[0] - y, : where.shape[1] - x] > 0
    )
    error = [
        np.abs(
            k[y : y + rows, x : x + columns]
            - reference.colour[: where.shape[0] - y, : where.shape[1] - x]
        )[here].mean()
        for k in (found, plain)
    ]
    assert here.sum() > 500 // level.stride**2 and error[0] < 0.1 and error[0] < 0.35 * error[1], (
        error
    )


@pytest.mark.parametrize("level", LEVELS)
def test_a_frame_is_explained_by_the_surface_that_it_shows(problem, truth, level):
    known = data_of(problem)
    light = np.array([*LIGHT, 0, 0, 0])
    found = {}
    for name, appearance in (
        ("none", None),
        ("unlit", known.appearance(truth.vertices[3], level)),
        ("lit", known.appearance(truth.vertices[3], level, light)),
    ):
        found[name] = known.evaluate(truth.vertices[3], 3, level, 0.3, appearance).misfit
    assert found["lit"] < 0.75 * found["unlit"] < 0.6 * found["none"], found


def test_gradient_against_finite_differences(problem, truth):
    """Where a frame is compared with what the blur makes of the sheet."""
    level, known, vertices = LEVELS[0], data_of(problem), truth.vertices[2]
    appearance = known.appearance(vertices + [0.001, 0, 0.002], level)
    at = lambda x: known.evaluate(x, 2, level, 0.3, appearance)
    gradient = np.array(at(vertices).images.gradient).reshape(-1, 3)
    direction = np.array([0.0, 0.0, 1.0]) * np.sin(40 * vertices[:, :1])
    ends = [at(vertices + sign * 5e-5 * direction) for sign in (1, -1)]
    both = [x.photometric + x.silhouette for x in ends]
    assert (gradient * direction).sum() == pytest.approx((both[0] - both[1]) / 1e-4, rel=0.05)


def test_without_masks_only_what_is_far_from_the_border(unmasked):
    problem = problem_of(unmasked.folder)
    known, level = data_of(problem), Level(1.0, 1, 6.0)
    appearance = known.appearance(problem.template.vertices, level)
    extra = appearance.excess
    w, h, x, y = (int(k[0]) for k in (extra.width, extra.height, extra.x, extra.y))
    has = np.abs(np.array(extra.texels).reshape(h, w, 4)).max(-1) > 0
    position, _ = problem.camera.project(problem.template.vertices)
    (left, top), (right, bottom) = position.min(0) - (x, y), position.max(0) - (x, y)
    rows, columns = np.flatnonzero(has.any(1)), np.flatnonzero(has.any(0))
    for low, high, a, b in (
        (left, right, columns[0], columns[-1]),
        (top, bottom, rows[0], rows[-1]),
    ):
        assert a - low == pytest.approx(12, abs=2) and high - b == pytest.approx(
            12, abs=2
        )  # two windows


def test_a_surface_that_is_changed_in_place_is_seen_anew(problem, truth):
    known, moved = data_of(problem), truth.vertices[1].copy()
    before = known.evaluate(moved, 1, LEVELS[0], 0.3).photometric
    moved += 0.01
    assert known.evaluate(moved, 1, LEVELS[0], 0.3).photometric != before
    assert known.evaluate(truth.vertices[1], 1, LEVELS[0], 0.3).photometric == before


def test_slanted_and_lit_sheets_are_followed(truth, tmp_path):
    """A sheet rolled by up to 76 degrees at its ends, under a light from the side."""
    problem = problem_of(truth.folder)
    done = track(FrameTracker(problem), 4, str(tmp_path))
    error = np.linalg.norm(
        problem.surface(Unknowns.from_numpy(done.states[-1])) - truth.vertices[-1], axis=1
    )
    assert error.mean() < 0.002
