"""The part of an image that matters: cut out with its gradient, and no term sees a difference."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from problems import problem_of

from polysft_mi.objective import FrameContext, Objective
from polysft_mi.render import Crop, PlacedMesh
from polysft_mi.surface import Unknowns

READINGS = {  # of losses that reach beyond the surface
    "sharp": dict(rgb_norm="l1", rgb_region="image", brightness="none", blur=0.0),
    "as in φ-SfT": dict(
        rgb_norm="phi-sft", rgb_region="image", brightness="none", silhouette_norm="phi-sft"
    ),
    "blurred": dict(rgb_region="image", blur=3.0, mask_blur=5.0, silhouette_norm="phi-sft"),
    "default": {},
}


def test_a_cut_is_a_part_of_the_image_and_zero_beyond_it():
    rng = np.random.default_rng(1)
    image = rng.random((40, 60, 4)).astype(np.float32)
    crop = Crop(-8, 12, 48, 64)
    padded = np.zeros((200, 200, 4), np.float32)
    padded[50:90, 50:110] = image
    expected = padded[62 : 62 + 64, 42 : 42 + 48]
    given = mi.TensorXf(image)
    dr.enable_grad(given)
    whole, rgb, alpha = crop.cut(given), crop.cut(given, 0, 3), crop.cut(given, 3)
    assert np.array_equal(np.array(whole), expected)
    assert np.array_equal(np.array(rgb), expected[..., :3])
    assert np.array_equal(np.array(alpha), expected[..., 3:])
    weight = rng.random(expected.shape).astype(np.float32)
    dr.backward(dr.sum(whole.array * mi.TensorXf(weight).array))
    padded[:] = 0
    padded[62 : 62 + 64, 42 : 42 + 48] = weight
    assert np.allclose(np.array(dr.grad(given)), padded[50:90, 50:110])


def test_a_crop_holds_what_it_is_asked_for():
    rng = np.random.default_rng(2)
    for _ in range(50):
        size = tuple(rng.integers(20, 700, 2).tolist())
        boxes = [np.sort(rng.uniform(-50, 750, (2, 2)), axis=0).ravel() for _ in range(2)]
        grid = int(rng.integers(1, 6))
        crop = Crop.around(boxes, 3, size, grid)
        assert crop.x % grid == crop.y % grid == 0
        for low, high, begin, length, end in (
            (0, 2, crop.x, crop.width, size[0]),
            (1, 3, crop.y, crop.height, size[1]),
        ):
            first = min(box[low] for box in boxes) - 3
            last = max(box[high] for box in boxes) + 3
            assert begin <= max(first, 0) or first >= end
            assert begin + length >= min(last, end)


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("masks", [True, False])
def test_terms_do_not_see_what_is_cut_off(tmp_path, monkeypatch, reading, masks):
    """The sheet covers a twelfth of the image."""
    truth = synthetic.cloth(
        tmp_path / "cloth", frames=2, size=(320, 240), rows=7, columns=8, masks=masks, depth=1.0
    )
    problem = problem_of(truth.folder, **READINGS[reading])
    objective = Objective(problem)
    state = objective.atlas.state(problem.patch.rest().to_numpy())
    state.translation += 0.01
    sizes = []

    def evaluated():
        unknowns = Unknowns.from_numpy(objective.atlas.arrays(state))
        dr.enable_grad(unknowns)
        frozen = objective.frozen([FrameContext(1)], objective.usual[-1], [state])
        _, terms = frozen.evaluate([unknowns], backward=True)
        slopes = [np.array(dr.grad(x)) for name, x in unknowns.items() if name != "pose"]
        return terms, np.concatenate(slopes)

    crop = PlacedMesh.crop

    def seen(self, *arguments):
        found = crop(self, *arguments)
        sizes.append(found.width * found.height)
        return found

    monkeypatch.setattr(PlacedMesh, "crop", seen)
    terms, slopes = evaluated()
    monkeypatch.setattr(PlacedMesh, "crop", lambda *_: Crop(0, 0, 320, 240))
    all_terms, all_slopes = evaluated()
    assert max(sizes) < 0.6 * 320 * 240
    assert terms == pytest.approx(all_terms, rel=1e-5, abs=1e-9)
    assert np.abs(slopes - all_slopes).max() < 1e-3 * np.abs(all_slopes).max()
