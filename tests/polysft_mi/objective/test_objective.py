"""The objective by automatic differentiation: its norms and comparisons on cases worked out by
hand, and its gradient through Mitsuba's renderer against finite differences.
"""

import itertools
import json

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from per_vertex import OVER_SHEET
from scipy.ndimage import gaussian_filter

from polyfit.colours import srgb
from polysft_mi import capture, prepare
from polysft_mi.errors import InputError
from polysft_mi.images import differentiable, pyramid
from polysft_mi.images.pyramid import Level
from polysft_mi.objective import FrameContext, Objective, Problem
from polysft_mi.objective.terms.inextensibility import edge_lengths
from polysft_mi.objective.terms.photometric import gain, robust
from polysft_mi.scene import experiment as scene
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import FrameTracker

RNG = np.random.default_rng(1)
PAPER = {"preset": "paper", "canonical_frame": "pca", "patches": 0}
PHI_SFT = {"rgb_norm": "phi-sft", "silhouette_norm": "phi-sft"}  # the preset's own


def floats(x):
    return mi.Float(np.asarray(x, np.float32).ravel())


def numeric(f, x, direction, h=1e-2):
    return (f(floats(x + h * direction))[0] - f(floats(x - h * direction))[0]) / (2 * h)


def check_gradient(f, x, h=1e-2, rel=0.01):
    x = np.asarray(x, np.float32).ravel()
    v = floats(x)
    dr.enable_grad(v)
    dr.backward(f(v))
    direction = RNG.normal(size=x.shape)
    assert np.array(dr.grad(v)) @ direction == pytest.approx(
        numeric(f, x, direction, h), rel=rel, abs=1e-3
    )


@pytest.mark.parametrize(
    "norm, expected",
    [
        ("l2", [0.09, 0.36, 0]),
        ("l1", [0.3, 0.6, 0]),
        ("charbonnier", [0.02 * (10**0.5 - 1), 0.02 * (37**0.5 - 1), 0]),
        ("cauchy", [0.01 * np.log(10), 0.01 * np.log(37), 0]),
    ],
)
def test_norms_of_residuals(norm, expected):
    squared = floats([0.09, 0.36, 0])
    assert np.allclose(np.array(robust(squared, norm, 0.1)), expected, rtol=1e-4, atol=2e-6)
    goal = floats(RNG.random(12))
    check_gradient(
        lambda v: dr.sum(robust(dr.square(v - goal), norm, 0.1)), RNG.random(12), h=1e-3, rel=0.02
    )


def test_lengths_of_edges_and_their_gradient():
    edges = mi.UInt32([0, 1, 0]), mi.UInt32([1, 2, 2])
    points = mi.Point3f([0, 1, 2], [0, 0, 1], [0, 0, 0])
    assert np.allclose(np.array(edge_lengths(points, edges)), [1, 2**0.5, 5**0.5], rtol=1e-6)

    def f(v):
        found = edge_lengths(dr.gather(mi.Point3f, v, dr.arange(mi.UInt32, 3)), edges)
        return mi.Float(dr.sum(dr.square(found - 1)))

    check_gradient(f, [0, 0, 0, 1.1, 0.2, 0, 1.3, 0.9, 0.4], h=1e-3)


def test_gain_is_the_least_squares_one():
    render, target = RNG.random((3, 50)), RNG.random((3, 50))
    weight = (RNG.random(50) > 0.3).astype(float)
    found = gain([floats(c) for c in render], [floats(c) for c in target], floats(weight))[0]
    expected = (weight * render * target).sum() / (weight * render**2).sum()
    assert found == pytest.approx(expected, rel=1e-4)


def test_blur_keeps_the_sum_and_its_width():
    image = np.zeros((41, 41, 2), np.float32)
    image[20, 20] = 1, 2
    out = np.array(differentiable.blur(mi.TensorXf(image), 1.5))
    assert out.sum((0, 1)) == pytest.approx([1, 2], rel=1e-4)
    x = np.arange(41) - 20
    width = (out[..., 0].sum(0) * x**2).sum()
    assert width == pytest.approx(1.5**2, rel=0.06)  # the Gaussian is cut off


@pytest.mark.parametrize("level", [Level(0.0), Level(1.5)])
def test_images_are_compared_alike_on_the_device_and_on_the_host(level):
    """Inside a mask, away from the image's border; with its gradient."""
    y, x = np.mgrid[:48, :64] / 10
    image = 0.5 + 0.2 * np.stack([np.sin(3 * x + y), np.cos(4 * y), np.sin(2 * x * y)], -1)
    mask = np.zeros((48, 64), np.float32)
    mask[10:40, 12:50] = 1
    image = (image * mask[..., None]).astype(np.float32)
    found, weight = mi.TensorXf(image), mi.TensorXf(mask[..., None])
    mine = np.array(differentiable.compared(found, weight, level, True))
    host = pyramid.compared(image, mask, level.sigma, level.window, True)
    inside = mask > 0
    assert np.abs(host[inside]).mean() > 0.5 and not mine[~inside].any()
    assert np.abs(mine - host)[inside].mean() < 0.03 * np.abs(host[inside]).mean()
    goal = floats(RNG.normal(size=image.size))
    check_gradient(
        lambda v: dr.sum(
            goal * differentiable.compared(mi.TensorXf(v, image.shape), weight, level, True).array
        ),
        image + 0.05 * RNG.random(image.shape) * mask[..., None],
        h=2e-3,
    )


# ---- the objective of a frame --------------------------------------------------------------------


def problem(folder, masks=True, **overrides):
    truth = synthetic.cloth(folder / "sequence", masks=masks)
    layout = capture.recognise(str(truth.folder))
    path = folder / "scene.xml"
    path.write_text(capture.scene_xml(layout, str(truth.folder)))
    experiment = scene.load(path, {**PAPER, **OVER_SHEET, **overrides})
    return Problem(experiment, experiment.sequence()), truth


def frozen_of(problem, *frames):
    """The objective of frames of which nothing is known before."""
    objective = Objective(problem)
    rest = problem.atlas.state(problem.patch.rest().to_numpy())
    contexts = [FrameContext(frame) for frame in frames]
    return objective.frozen(contexts, objective.usual[-1], [rest] * len(frames))


def energy(problem, unknowns, frame, **options):
    return frozen_of(problem, frame).evaluate([unknowns], **options)


@pytest.mark.parametrize(
    "overrides",
    [
        {"k_mi": 0},
        {"k_mi": 0, "blur": 1.0, "rgb_norm": "charbonnier"},
        {"k_mi": 0, "brightness": "gain"},
        {"k_mi": 0, "brightness": "local"},
        {"k_mi": 0, "brightness": "local", "rgb_norm": "cauchy", "rgb_region": "sheet", "blur": 1},
        {"k_rgb": 0, "k_silhouette": 0},
        {"k_mi": 0, "integrator": "raster", "spp": 4},
        {"k_mi": 0, "k_rgb": 5, "k_silhouette": 5, "mask_blur": 1.5, **PHI_SFT},
    ],
)
@pytest.mark.parametrize("masks", [True, False])
def test_gradient_of_the_whole_objective(tmp_path, masks, overrides):
    if not masks and overrides.get("brightness") == "local":
        pytest.skip("the window of the local statistics jumps with the interior, which is detached")
    p, _ = problem(tmp_path, masks, **overrides)
    rng = np.random.default_rng(2)
    rest = p.patch.rest().to_numpy()
    rest["delta_alpha"] = (0.02 * np.sin(np.arange(15))).astype(np.float32)[None]
    rest["translation"] = np.array([[0.01, -0.013, 0.02]], np.float32)
    unknowns = Unknowns.from_numpy(rest)
    for _, value in unknowns.items():
        dr.enable_grad(value)
    total, terms = energy(p, unknowns, 2, backward=True)
    assert total == pytest.approx(sum(terms.values())) and total > 0
    assert (terms.get("silhouette", 0) > 0) == (masks and overrides.get("k_silhouette", 1) > 0)
    for name, size in (("delta_alpha", 15), ("translation", 3)):
        direction = rng.normal(size=(1, size))
        direction /= np.linalg.norm(direction)
        ad = float(np.array(dr.grad(getattr(unknowns, name))) @ direction[0])
        slopes = []
        for h in (1e-3, 2e-3, 4e-3):
            ends = [
                energy(p, Unknowns.from_numpy({**rest, name: rest[name] + s * h * direction}), 2)[0]
                for s in (1, -1)
            ]
            slopes.append((ends[0] - ends[1]) / (2 * h))
        # 96x72 pixels leave kinks at every pixel that changes sheets, and without masks the
        # interior jumps by whole pixels
        near = dict(rel=0.15, abs=0.03) if masks else dict(rel=0.3, abs=0.05)
        assert ad == pytest.approx(np.median(slopes), **near), (
            name,
            slopes,
        )


def test_a_windows_terms_are_means_and_the_frames_are_tied(tmp_path):
    """The mean over frames of their terms; k_tc times the mean over pairs of |δα|^2 + |δuv|^2 in
    the paper's coefficients (eq. tc), and its gradient.
    """
    p, _ = problem(tmp_path, k_tc=0.7, k_silhouette=0, k_rgb=0)
    rows = [p.patch.rest().to_numpy() for _ in range(3)]
    for row in rows:
        for name in ("delta_alpha", "delta_u", "delta_v"):
            row[name] += (0.05 * RNG.normal(size=row[name].shape)).astype(np.float32)
    window = [Unknowns.from_numpy(row) for row in rows]
    for unknowns in window:
        dr.enable_grad(unknowns)
    frozen = frozen_of(p, 0, 1, 2)
    _, terms = frozen.evaluate(window, backward=True)
    names = "delta_alpha", "delta_u", "delta_v"
    ties = [sum(((b[n] - a[n]) ** 2).sum() for n in names) for a, b in itertools.pairwise(rows)]
    assert terms["temporal"] == pytest.approx(0.7 * sum(ties) / 2, rel=1e-4)
    alone = [energy(p, unknowns, k)[1]["inextensibility"] for k, unknowns in enumerate(window)]
    assert terms["inextensibility"] == pytest.approx(np.mean(alone), rel=1e-5)
    direction = RNG.normal(size=rows[1]["delta_u"].shape)

    def total(h):
        moved = {**rows[1], "delta_u": (rows[1]["delta_u"] + h * direction).astype(np.float32)}
        return frozen.evaluate([window[0], Unknowns.from_numpy(moved), window[2]])[0]

    slope = (total(1e-3) - total(-1e-3)) / 2e-3
    assert np.array(dr.grad(window[1].delta_u)) @ direction == pytest.approx(slope, rel=0.01)
    assert energy(p, window[0], 0)[1]["temporal"] == 0


def test_truth_is_nearly_a_minimum(tmp_path):
    """The bent sheet's own surface explains the image better than the flat template and than its
    mirror image in depth.
    """
    p, truth = problem(tmp_path)
    target = p.sequence.frame(4) * p.sequence.mask(4)[..., None]

    def loss(vertices):
        rgb, _ = p.placed.image(mi.Point3f(np.ascontiguousarray(vertices.T, dtype=np.float32)))
        return float(np.mean((np.array(rgb) - target) ** 2))

    bent = truth.vertices[4]
    mirrored = bent * (1, 1, -1) + (0, 0, 2 * bent[:, 2].mean())
    assert loss(bent) < 0.1 * loss(truth.vertices[0]) and loss(bent) < 0.1 * loss(mirrored)


def test_without_masks_the_background_does_not_matter(tmp_path):
    p, truth = problem(tmp_path, masks=False)
    rest = p.patch.rest()
    before = energy(p, rest, 0)[0]
    alpha = np.array(p.placed.image(p.patch.vertices(rest))[1])[..., 0]
    path = sorted((truth.folder / "frames").iterdir())[0]
    image = cv2.imread(str(path))
    image[alpha == 0] = 255
    cv2.imwrite(str(path), image)
    again = Problem(p.experiment, p.experiment.sequence())
    assert energy(again, rest, 0)[0] == pytest.approx(before, rel=1e-6)


def test_padding_does_not_change_the_loss(tmp_path):
    """The same sheet in a larger film: neither background nor resolution of the empty part weighs
    in.
    """
    totals = []
    for name, _size in (("small", (96, 72)), ("large", (160, 120))):
        truth = synthetic.cloth(tmp_path / name, size=(96, 72))
        if name == "large":
            for kind in ("frames", "masks"):
                for f in sorted((truth.folder / kind).iterdir()):
                    image = cv2.imread(str(f), cv2.IMREAD_UNCHANGED)
                    big = np.full(
                        (120, 160, *image.shape[2:]), 0 if kind == "masks" else 40, np.uint8
                    )
                    big[24:96, 32:128] = image
                    cv2.imwrite(str(f), big)
            K = truth.K
            (truth.folder / "camera.json").write_text(
                json.dumps(
                    {
                        "width": 160,
                        "height": 120,
                        "fx": K[0, 0],
                        "fy": K[1, 1],
                        "cx": K[0, 2] + 32,
                        "cy": K[1, 2] + 24,
                    }
                )
            )
        path = tmp_path / f"{name}.xml"
        path.write_text(capture.scene_xml(capture.recognise(str(truth.folder)), str(truth.folder)))
        experiment = scene.load(path, {**PAPER, **OVER_SHEET})
        p = Problem(experiment, experiment.sequence())
        totals.append(energy(p, p.patch.rest(), 4)[0])
    assert totals[1] == pytest.approx(totals[0], rel=1e-3)


def test_losses_of_phi_sft_are_means_over_the_image(tmp_path):
    """Absolute differences of each channel as it is stored, and of blurred masks."""
    settings = {**PHI_SFT, "k_silhouette": 0.5, "mask_blur": 2, "k_mi": 0}
    p, _ = problem(tmp_path, **settings)
    rest = p.patch.rest()
    terms = energy(p, rest, 3)[1]
    rgb, alpha = (np.array(x) for x in p.placed.image(p.patch.vertices(rest)))
    mask = p.sequence.mask(3)
    stored = [srgb(x) for x in (rgb, p.sequence.frame(3) * mask[..., None])]
    assert terms["rgb"] == pytest.approx(np.abs(stored[0] - stored[1]).mean(), rel=1e-3)
    difference = gaussian_filter(alpha[..., 0] - mask, 2, mode="constant", truncate=2.5)
    assert terms["silhouette"] == pytest.approx(0.5 * np.abs(difference).mean(), rel=0.01)
    for name, value in {"silhouette_norm": "phi-sft", "mask_blur": 2}.items():
        with pytest.raises(InputError, match=f"silhouette has {name} = .* is needed"):
            usual = {"preset": "none", "solver": "gauss-newton", "rgb_norm": "cauchy"}
            FrameTracker(problem(tmp_path / name, **{**usual, name: value})[0])


def test_the_preset_compares_images_as_phi_sft_does(tmp_path):
    truth = synthetic.cloth(tmp_path / "a", frames=2)
    (tmp_path / "scene.xml").write_text(
        capture.scene_xml(capture.recognise(str(truth.folder)), str(truth.folder))
    )
    totals = []
    for settings in ({}, {**PHI_SFT, "k_silhouette": 0.5, "mask_blur": 5}, OVER_SHEET):
        experiment = scene.load(tmp_path / "scene.xml", {**PAPER, **settings})
        p = Problem(experiment, experiment.sequence())
        totals.append(energy(p, p.patch.rest(), 1)[0])
    assert totals[0] == totals[1] and abs(totals[2] / totals[0] - 1) > 0.1


def test_path_replay_gives_the_gradient_of_raster(tmp_path):
    """On an unshadowed sheet under light from everywhere both integrators render the texture, so
    their gradients are the same but for noise.
    """
    gradients = {}
    for integrator, spp in (("raster", 1), ("prb_projective", 64)):
        folder = tmp_path / integrator
        folder.mkdir()
        p, _ = problem(folder, integrator=integrator, spp=spp, k_mi=0)
        rest = p.patch.rest().to_numpy()
        rest["translation"] = np.array([[0.02, -0.03, 0.05]], np.float32)
        unknowns = Unknowns.from_numpy(rest)
        dr.enable_grad(unknowns.translation)
        gradients[integrator] = {}
        for name in ("rgb", "silhouette"):
            frozen = frozen_of(p, 2)
            frozen.objective.terms = [t for t in frozen.objective.terms if t.name == name]
            frozen.evaluate([unknowns], backward=True)
            gradients[integrator][name] = np.array(dr.grad(unknowns.translation))
            dr.clear_grad(unknowns.translation)
    for name in ("rgb", "silhouette"):
        a, b = gradients["raster"][name], gradients["prb_projective"][name]
        assert np.linalg.norm(a - b) < 0.25 * np.linalg.norm(a), (name, a, b)


def test_path_replay_has_a_gradient_beside_depth(tmp_path):
    """The depth term looks for what rays meet, in the scene that path replay goes through again."""
    (tmp_path / "depth").mkdir()
    for k in range(5):
        cv2.imwrite(str(tmp_path / "depth" / f"{k}.png"), np.full((72, 96), 510, np.uint16))
    gradients = []
    for depth in ("", str(tmp_path / "depth")):
        (folder := tmp_path / f"with{depth[-5:]}").mkdir()
        p, _ = problem(folder, integrator="prb_projective", k_mi=0, depth=depth, k_depth=1e-9)
        unknowns = p.patch.rest()
        dr.enable_grad(unknowns.translation)
        energy(p, unknowns, 2, backward=True)
        gradients.append(np.array(dr.grad(unknowns.translation)))
    assert np.linalg.norm(gradients[0]) > 0
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("integrator", ["raster", "prb_projective"])
def test_gradients_of_several_patches(tmp_path, integrator):
    """Of a tube, whose texture has a seam: by the jets and the motions of its patches, against
    finite differences; path replay's against those of raster, which has no noise.
    """
    truth = synthetic.cloth(tmp_path / "tube", rows=13, columns=24, frames=2, shape=synthetic.tube)
    prepare.main([str(truth.folder), "-q"])

    def of(integrator, spp):
        settings = {
            **PAPER,
            **OVER_SHEET,
            "k_mi": 0,
            "order": 3,
            "integrator": integrator,
            "spp": spp,
        }
        experiment = scene.load(truth.folder / "scene.xml", settings)
        return Problem(experiment, experiment.sequence())

    sharp, p = of("raster", 4), of(integrator, 1 if integrator == "raster" else 64)
    assert len(p.template) >= 3
    rest = p.patch.rest().to_numpy()
    rest["delta_alpha"] += (0.02 * RNG.normal(size=rest["delta_alpha"].shape)).astype(np.float32)
    rest["translation"] += np.float32([0.02, -0.03, 0.05])
    unknowns = Unknowns.from_numpy(rest)
    for _, value in unknowns.items():
        dr.enable_grad(value)
    energy(p, unknowns, 1, backward=True)
    for name in ("delta_alpha", "translation"):
        gradient = np.array(dr.grad(getattr(unknowns, name))).reshape(rest[name].shape)
        assert (np.abs(gradient).max(1) > 0).sum() >= 2  # the patches that are in view
        direction = gradient / np.linalg.norm(gradient)
        slopes = []
        for h in (1e-3, 2e-3, 4e-3):
            ends = [
                energy(sharp, Unknowns.from_numpy({**rest, name: x}), 1)[0]
                for x in (rest[name] + h * direction, rest[name] - h * direction)
            ]
            slopes.append((ends[0] - ends[1]) / (2 * h))
        assert np.linalg.norm(gradient) == pytest.approx(np.median(slopes), rel=0.2), (name, slopes)
