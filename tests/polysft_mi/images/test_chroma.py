"""Chromaticity as a cue: what changes it and what does not, and its derivatives against finite
differences.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import synthetic

from polyfit.mesh import edges_of
from polysft_mi.images.chroma import Chroma, colour_cast
from polysft_mi.images.triangles import TriangleColours, luminance
from polysft_mi.scene.rules import Rules
from polysft_mi.surface.pattern import Pattern

ROWS, COLUMNS = 13, 17
FACES = synthetic.grid_faces(ROWS, COLUMNS)
FLAT = synthetic.sheet(0, ROWS, COLUMNS)
SCALE = 0.02
SEEN = np.full(len(FACES), 9)
Y, X = np.mgrid[:120, :160] / (120.0, 160.0)[0]


class Camera:
    """Of 160 x 120 pixels, at the origin."""

    inverse = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])

    def project(self, points):
        x = points @ self.inverse.T
        return x[:, :2] / x[:, 2:], x[:, 2] > 0

    def derivatives(self, points):
        x = points @ self.inverse.T
        at = x[:, :2] / x[:, 2:]
        return (self.inverse[:2] - at[:, :, None] * self.inverse[2]) / x[:, 2, None, None]


def hues(x, y):
    """An image whose colour changes slowly, of pixels (h, w), over the image's height."""
    waves = [0.2 * np.sin(7 * x + 2 * y), 0.2 * np.sin(5 * y - 3 * x + 1), 0.2 * np.cos(6 * x * y)]
    return (0.5 + np.stack(waves, -1)).astype(np.float32)


@pytest.fixture(scope="module")
def colours():
    """Those of the flat sheet under an image of such colours, a texel a pixel."""
    place, _ = Camera().project(FLAT)
    texture = SimpleNamespace(
        image=hues(X, Y),
        inside=np.ones((120, 160), np.float32),
        density=1.0,
        centroids=lambda: place[FACES].mean(1) - 0.5,
    )
    return TriangleColours(FACES, place, texture, True, Rules())


def chroma(colours, image, vertices=FLAT, cast=1.0, seen=SEEN):
    prepared = colours.of_frame(image.astype(np.float32), np.ones((120, 160), np.float32))
    return Chroma.of(colours, prepared, vertices, Camera(), seen, cast, SCALE)


def size(found):
    return np.linalg.norm(found.residual, axis=1)[found.area > 0]


@pytest.mark.parametrize("light", ["brighter", "a shade", "a shadow's edge", "white balance"])
def test_light_changes_no_chromaticity(colours, light):
    factor = {
        "brighter": 1.7,
        "a shade": (0.4 + 0.8 * X + 0.3 * Y)[..., None],
        "a shadow's edge": np.where(X + Y < 0.9, 1.0, 0.5)[..., None],
        "white balance": np.array([1.1, 1.0, 0.8]),
    }[light]
    assert np.median(size(chroma(colours, hues(X, Y) * factor))) < 2e-3
    moved = chroma(colours, hues(X + 0.05, Y) * factor)
    assert np.median(size(moved)) > 2e-2


def test_residuals_tell_the_way_back(colours):
    """Gauss-Newton's step by them, of a sheet that slid in the image."""
    found = chroma(colours, hues(X - 3 / 120, Y + 2 / 120))
    counts = found.area > 0
    a, b = found.slope[counts].reshape(-1, 2), found.residual[counts].reshape(-1)
    step = np.linalg.lstsq(a, -b, rcond=None)[0]
    assert step == pytest.approx([3, -2], abs=0.35)


def test_forms_at_the_vertices(colours):
    """Slope and curvature along a motion, against finite differences; the white balance follows."""
    rng = np.random.default_rng(2)
    vertices = FLAT + rng.normal(0, 2e-3, FLAT.shape)
    image, h = hues(X - 0.02, Y) * (1.1, 1, 0.9), 1e-4
    found = chroma(colours, image, vertices)
    over = lambda at: (at.residual**2).sum(1) / SCALE**2
    factor = 2 * found.area / (1 + over(found))
    pattern = Pattern(FACES, edges_of(FACES)[0], len(FLAT))
    gradient, second = found.at_vertices(factor, pattern)
    slopes = []
    for direction in rng.normal(size=(8, *FLAT.shape)):
        ahead, behind = (
            found.area @ np.log1p(over(chroma(colours, image, vertices + k * h * direction)))
            for k in (1, -1)
        )
        slopes.append(((gradient * direction).sum(), SCALE**2 * (ahead - behind) / (2 * h)))
        moved = np.einsum("npk,nk->np", found.by_vertex, direction)
        rows = np.einsum("fep,fp->fe", found.slope, moved[FACES].mean(1))
        promised = sum(
            (1 + (i != j)) * moved[i] @ block @ moved[j]
            for i, j, block in zip(
                pattern.row[pattern.upper], pattern.column[pattern.upper], second
            )
        )
        assert promised == pytest.approx(factor @ (rows**2).sum(1), rel=1e-9)
    mine, theirs = np.array(slopes).T  # those of an image are over a block
    assert np.linalg.norm(mine - theirs) < 0.1 * np.linalg.norm(theirs)


def test_what_counts(colours):
    rng = np.random.default_rng(0)
    seen = rng.integers(0, 2, len(FACES))
    found = chroma(colours, hues(X, Y), seen=seen)
    assert ((found.area > 0) == (seen > 0)).all()
    assert found.area[seen > 0].mean() == pytest.approx(1)
    assert chroma(colours, hues(X, Y), cast=np.array([1.0, 0, 0])).area.all()  # a pure colour
    black = chroma(colours, hues(X, Y), cast=0.0)
    assert not black.area.any() and np.isfinite(black.residual).all()


def test_a_cast_that_the_first_frame_shows_is_the_textures(colours):
    """A camera's curve changes chromaticity, in all frames alike."""
    curved = hues(X, Y) ** 0.8
    place, _ = Camera().project(FLAT)
    prepared = colours.of_frame(curved, np.ones((120, 160), np.float32))
    shown = colours.shown(prepared, place[FACES].mean(1))
    known = colour_cast(colours, shown, SEEN)
    assert np.median(known) == pytest.approx(1)
    assert 5 * np.median(size(chroma(colours, curved, cast=known))) < np.median(
        size(chroma(colours, curved))
    )
    dark = colour_cast(colours, np.zeros((len(FACES), 3)), SEEN)
    assert dark.min() >= 0.5 and dark.max() <= 2
    # what another layer hides has the usual one
    shown[:5] = (1, 0, 0)
    hidden = colour_cast(colours, shown, np.where(np.arange(len(FACES)) < 5, 0, 9))
    assert np.allclose(hidden[:5], np.median(known[5:], axis=0), rtol=0.02)
    assert np.allclose(hidden[5:], known[5:], rtol=0.02)
    assert (colour_cast(colours, shown, 0 * SEEN) == 1).all()


def test_colours_of_the_texture_where_an_image_shows_none(colours):
    image = np.zeros_like(colours.colour)
    image[3] = 0.7
    known = colours.known(image)
    assert (known[3] == 0.7).all() and np.array_equal(known[4:], colours.colour[4:])
    assert colours.known(None) is colours.colour and luminance(np.ones(3)) == pytest.approx(1)
