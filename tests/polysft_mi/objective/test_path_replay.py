"""Path replay: its gradient, through light and reflections, against finite differences of the
rendering.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from places import ROOT

from polysft_mi.objective import FrameContext, Objective, Problem
from polysft_mi.scene import experiment as scene
from polysft_mi.surface.patch import Unknowns

SCENE = ROOT / "scenes" / "demo_lit.xml"
STEP, SEEDS = 4e-3, (3, 4, 5)  # in the template's scale; both ends see the same random numbers


def frozen_of(arrays, depth, **overrides):
    """The objective of frame 4 of the lit sheet, rendered with paths of so many segments."""
    overrides = {"order": 4, "spp": 36, "k_mi": 0, **overrides}
    experiment = scene.load(SCENE, overrides)
    experiment.renderer.max_depth = depth
    problem = Problem(experiment, experiment.sequence())
    objective, start = Objective(problem), problem.atlas.state(arrays(problem))
    return objective.frozen([FrameContext(4)], objective.usual[-1], [start])


def bent(problem):
    """A sheet that bends, away from where it was: light falls on it at another slant."""
    arrays = problem.patch.rest().to_numpy()
    arrays["delta_alpha"][0, 5:9] = 0.05, -0.08, 0.06, 0.04
    arrays["translation"] += np.float32([0.02, -0.015, 0.03])
    return arrays


def gradients(frozen, arrays, seed):
    unknowns = Unknowns.from_numpy(arrays)
    dr.enable_grad(unknowns)
    frozen.evaluate([unknowns], backward=True, seed=seed)
    return {
        name: np.array(dr.grad(getattr(unknowns, name))).reshape(arrays[name].shape)
        for name in ("delta_alpha", "delta_u", "delta_v", "rotation", "translation")
    }


@pytest.mark.parametrize(
    "depth, weights",
    [(2, {"k_silhouette": 0}), (3, {"k_silhouette": 0}), (2, {"k_rgb": 0})],
    ids=["lamp", "lamp and floor", "mask"],
)
def test_gradient_is_that_of_finite_differences(depth, weights):
    """Of the image under a lamp, and with a reflection from the floor, and of the mask: along a
    direction in which much changes, and one that says nothing of that.

    Shadows on the floor move, too, and carry no gradient (``sppi`` = 0): their share is small here.
    """
    frozen = frozen_of(bent, depth, **weights)
    arrays = bent(frozen.objective.problem)
    steep, found = (gradients(frozen, arrays, seed) for seed in (1, 2))
    k = np.arange(len(arrays["delta_u"]))
    other = {
        "delta_alpha": np.cos(np.arange(15.0))[None],
        "delta_u": np.sin(0.03 * k + 1),
        "delta_v": np.cos(0.02 * k),
        "rotation": np.array([[0.6, -0.5, 0.62, 0.0]]),
        "translation": np.array([[0.4, 0.5, -0.77]]),
    }
    for name, gradient in found.items():
        size = np.linalg.norm(gradient)
        direction = steep[name] / np.linalg.norm(steep[name])
        direction = direction + 0.5 * other[name] / np.linalg.norm(other[name])
        moved = [
            Unknowns.from_numpy({**arrays, name: np.float32(arrays[name] + h * direction)})
            for h in (STEP, -STEP)
        ]
        ahead, behind = (sum(frozen.evaluate([m], seed=k)[0] for k in SEEDS) for m in moved)
        slope = (ahead - behind) / (2 * STEP * len(SEEDS))
        error = abs((gradient * direction).sum() - slope) / max(abs(slope), 0.5 * size)
        assert error < 0.15, (name, slope, error)


def test_the_truth_explains_its_light():
    """The last frame, rendered from the true surface, and not so without the reflection."""
    experiment = scene.load(SCENE, {})
    placed, k = Problem(experiment, experiment.sequence()).placed, 5
    truth = np.load(ROOT / "scenes" / "demo_lit" / "gt.npz")["vertices"][k]
    frame, inside = experiment.sequence().frame(k), experiment.sequence().mask(k) > 0.5

    def error(depth):
        experiment.renderer.max_depth = depth
        rgb, _ = placed.image(mi.Point3f(np.ascontiguousarray(truth.T)), spp=128)
        return np.abs(np.array(rgb).reshape(frame.shape) - frame)[inside].mean()

    assert error(3) < 0.015 < 0.03 < error(2)
