"""What images say of a surface: gradients against autodiff through the renderer."""

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from problems import data_of

from polysft_mi import prepare
from polysft_mi.images import pixels, pyramid
from polysft_mi.images.pyramid import MAX_CONTOUR_DISTANCE, Level, level_image
from polysft_mi.objective.problem import Problem
from polysft_mi.objective.terms.photometric import interior as filled
from polysft_mi.scene import experiment as scene

RNG = np.random.default_rng(4)


def displaced(problem, amount=1.0):
    """A surface near the template, away from the image."""
    x = problem.template.vertices
    return x + amount * (0.002 * np.sin(20 * x[:, [1, 2, 0]]) + np.array([0.002, -0.0015, 0.004]))


@pytest.fixture(scope="module")
def twin(truth, problem, tmp_path_factory):
    """A problem whose texture is the one that the level compares with, so that the renderer's
    autodiff sees the same objective.
    """
    blur = 0.0
    first = data_of(problem)
    level = first.level(blur)
    texture = first.texture.level(level)
    width, height = int(texture.width[0]), int(texture.height[0])
    folder = tmp_path_factory.mktemp("twin")
    image = np.array(texture.texels).reshape(height, width, 4)[..., :3]
    mi.Bitmap(np.ascontiguousarray(image)).write(str(folder / "texture.pfm"))
    synthetic.write_image(folder / "texture.png", synthetic.texture_image())
    at = first.texture.texels()
    uv = np.empty((len(truth.uv), 2))
    uv[problem.experiment.corner] = (at + 0.5) / (width, height)
    uv[:, 1] = 1 - uv[:, 1]
    for name in ("frames", "masks", "camera.json"):
        (folder / name).symlink_to(truth.folder / name)
    synthetic.write_obj(folder / "template.obj", truth.vertices[0], uv, truth.faces)
    prepare.main([str(folder)])
    text = (folder / "scene.xml").read_text()
    (folder / "scene.xml").write_text(text.replace("texture.png", "texture.pfm"))
    experiment = scene.load(str(folder / "scene.xml"), {"brightness": "none"})
    return Problem(experiment, problem.sequence), first, blur


def attached(problem, vertices):
    """(flat positions with gradients, image tensor (H, W, 3), alpha, Float of H W) of a surface
    through ``raster``.
    """
    flat = mi.Float(vertices.astype(np.float32).ravel())
    dr.enable_grad(flat)
    rgb, alpha = problem.placed.image(dr.unravel(mi.Point3f, flat))
    return flat, rgb, alpha.array


@pytest.mark.parametrize("scale", [0.2, 1.0])
def test_photometric_gradient_is_that_of_autodiff_through_raster(problem, twin, scale):
    reference, first, blur = twin
    level = first.level(blur)
    vertices = displaced(problem)
    flat, rgb, alpha = attached(reference, vertices)
    interior = np.array(filled(alpha)).reshape(problem.height, problem.width)
    image = level_image(problem.sequence.frame(2), problem.sequence.mask(2), level, False)
    part = tuple(slice(k, k + n) for k, n in zip(image.corner[::-1], image.inside.shape))
    image.inside = (
        image.inside * interior[part]
    )  # where raster blends no silhouette into the colour
    first._frames._kept[2, level] = _Ready(image)
    mine = first.evaluate(vertices, 2, blur, scale)
    whole = np.zeros((problem.height, problem.width, 4), np.float32)
    whole[part] = np.concatenate([image.colour, image.inside[..., None]], -1)
    weight, area = mi.Float(whole[..., 3].ravel()), float(image.mask.sum())
    squared = 0
    for c in range(3):
        k = dr.arange(mi.UInt32, problem.width * problem.height) * 3 + c
        squared += (
            dr.square(dr.gather(mi.Float, rgb.array, k) - mi.Float(whole[..., c].ravel())) / 3
        )
    energy = dr.sum(weight * scale**2 * dr.log(1 + squared / scale**2)) / area
    dr.backward(energy)
    expected = np.array(dr.grad(flat)).reshape(-1, 3)
    assert mine.photometric == pytest.approx(energy[0], rel=1e-4)
    gradient = slope(mine) - _silhouette_gradient(first, vertices, blur)
    assert np.abs(gradient - expected).max() < 1e-3 * np.abs(expected).max()
    first._frames._kept.clear()


class _Ready:
    """A level image that needs no reading."""

    def __init__(self, image):
        self.image = image

    def result(self):
        return self.image


def _silhouette_gradient(first, vertices, blur):
    return slope(first.evaluate(vertices, 2, blur, 1e-6))  # at this scale no residual pulls


def slope(evaluation):
    """The images' gradient (N, 3)."""
    return np.array(evaluation.images.gradient).reshape(-1, 3)


@pytest.mark.parametrize("level", [Level(0.0), Level(2.5, 2), Level(3.8, 3, 10.0)])
def test_a_masked_image_is_that_of_the_whole_where_the_mask_has_a_say(monkeypatch, level):
    image = cv2.GaussianBlur(RNG.random((360, 480, 3)).astype(np.float32), (0, 0), 2)
    mask = np.zeros((360, 480), np.float32)
    cv2.ellipse(mask, (320, 200), (30, 20), 20, 0, 360, 1, -1)
    part = level_image(image, mask, level)
    monkeypatch.setattr(
        pyramid, "_slices_around", lambda mask, level: ((0, 0), (slice(None), slice(None)))
    )
    whole = level_image(image, mask, level)
    (rows, columns), (x, y) = part.inside.shape, part.corner
    assert part.inside.size < 0.8 * whole.inside.size and (x > 0 or y > 0)
    here = np.s_[y : y + rows, x : x + columns]
    for name in ("inside", "mask"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[here])
        outside = getattr(whole, name).copy()
        outside[here] = 0
        assert not outside.any()
    assert np.abs(part.colour - whole.colour[here])[part.inside > 0].max() < 1e-5
    near = whole.distance < MAX_CONTOUR_DISTANCE
    assert np.abs(part.distance - whole.distance[here])[near[here]].max() < 1e-5
    near[here] = False
    assert not near.any()


@pytest.mark.parametrize("amount", [0.5, 1.0])
def test_silhouette_gradient_is_that_of_autodiff_through_raster(problem, amount):
    first, blur = data_of(problem), 0.0
    vertices = displaced(problem, amount)
    flat, _, alpha = attached(problem, vertices)
    mask = problem.sequence.mask(2)
    energy = dr.sum(dr.square(alpha - mi.Float(mask.ravel()))) / float(mask.sum())
    dr.backward(energy)
    expected = np.array(dr.grad(flat)).reshape(-1, 3)
    mine = first.evaluate(vertices, 2, blur, 1e-6)
    assert mine.silhouette == pytest.approx(energy[0], rel=1e-4)
    assert np.abs(slope(mine) - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("shift", [(0.0, 0.0, -3.0), (5.0, 0.0, 0.0)])
def test_a_sheet_out_of_view_explains_nothing(problem, shift):
    """Behind the camera, or beside the image: no pixel is compared, which must not look like a
    perfect match.
    """
    vertices = problem.template.vertices + shift
    found = data_of(problem).evaluate(vertices, 1, 1.0, 0.3)
    assert (found.misfit, found.outlier_share, found.photometric) == (1, 1, 0)


def test_what_is_fainter_than_the_floor_stays_faint():
    faint = 0.5 + 0.1 * pyramid.FLOOR * RNG.standard_normal((120, 160, 3)).astype(np.float32)
    strong = 0.5 + 20 * (faint - 0.5)
    for image, least, most in ((faint, 0.08, 0.12), (strong, 0.85, 0.95)):
        spread = pyramid.normalised(image, 8.0).std()
        assert least < spread < most


def test_numbers_count_as_one_as_their_residuals_are_alike(problem):
    data, blur, vertices = data_of(problem), 1.0, displaced(problem, 0.2)
    level, view = data.level(blur), data.view(vertices, data.level(blur))
    arguments = data._residual_arguments(view, 2, level)
    residual, weight = (np.array(x) for x in pixels.residuals(*arguments)[:2])
    height, width = view.size[::-1]
    known = (weight > 0).reshape(height, width)
    most = 2.5 * np.median(np.abs(residual[:3, weight > 0])) / 0.6745
    residual = np.clip(residual[:3], -most, most).reshape(3, height, width) * known
    reach, alike, together, pairs = round(level.window / level.stride), 0.0, 0.0, 0
    for dy in range(-reach, reach + 1):  # the slow way: of each offset the mean product
        for dx in range(-reach, reach + 1):
            a = tuple(slice(max(0, -k), n - max(0, k)) for k, n in ((dy, height), (dx, width)))
            b = tuple(slice(max(0, k), n - max(0, -k)) for k, n in ((dy, height), (dx, width)))
            alike += sum((x[a] * x[b]).sum() for x in residual)
            together += (residual.sum(0)[a] * residual.sum(0)[b]).sum()
            pairs += (known[a] & known[b]).sum()
    power = (residual**2).sum() / known.sum()
    expected = (2 * reach + 1) ** 2 * alike / pairs / power * level.stride**2
    assert expected > 2 * np.pi * level.sigma**2  # blur alone makes 4 pi sigma^2
    found, colours = data.numbers_as_one(vertices, 2, blur)
    assert abs(found / expected - 1) < 1e-3
    assert 1 < colours < 3 and abs(colours / (together / alike) - 1) < 1e-3
