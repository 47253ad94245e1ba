"""What the camera's blur makes of a sheet: frames of slanted, lit sheets, rendered with many
samples, are explained by it.
"""

import numpy as np
import pytest
import synthetic
from problems import data_of, problem_of

from polysft_mi.images.pyramid import Level
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
