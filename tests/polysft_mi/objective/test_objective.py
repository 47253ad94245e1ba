"""Each term of the objective: its value on a case worked out by hand, and its gradient against
finite differences.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from problems import replay_paths

from polysft_mi import capture
from polysft_mi.objective import terms as objective
from polysft_mi.objective.problem import Problem
from polysft_mi.scene import experiment as scene
from polysft_mi.surface.patch import Unknowns

RNG = np.random.default_rng(1)


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
        ("l2", (0.09 + 0.36) / 2),
        ("l1", (0.3 + 0.6) / 2),
        ("charbonnier", 0.02 * (10**0.5 - 1 + 37**0.5 - 1) / 2),
    ],
)
def test_photometric_value_and_gradient(norm, expected):
    target = [floats([0.1, 0.2, 0.9])] * 3
    render = [floats([0.4, 0.8, 0.9])] * 3
    weight, area = floats([1, 1, 0]), mi.Float(2)
    value = objective.photometric(render, target, weight, area, norm=norm, scale=0.1)
    assert value[0] == pytest.approx(expected, rel=1e-4)
    x = RNG.random(12)
    goal = [floats(RNG.random(4)) for _ in range(3)]
    index = dr.arange(mi.UInt32, 4)

    def f(v):
        channels = [dr.gather(mi.Float, v, 3 * index + c) for c in range(3)]
        return objective.photometric(
            channels, goal, floats([1, 0.5, 0, 1]), mi.Float(2.5), norm=norm, scale=0.1
        )

    check_gradient(f, x, h=1e-3, rel=0.02)


def test_silhouette_value_and_gradient():
    mask = floats([1, 1, 0, 0])
    assert objective.silhouette(floats([1, 0.5, 0.5, 0]), mask, mi.Float(2))[0] == pytest.approx(
        0.25
    )
    check_gradient(lambda v: objective.silhouette(v, mask, mi.Float(2)), RNG.random(4))


def test_inextensibility_value_and_gradient():
    # a unit square's diagonal pulled from sqrt(2) to 2, one side from 1 to sqrt(2) and one to
    # sqrt(2): points (0,0), (1,0), (1+a, 1+b)
    edges = (mi.UInt32([0, 1, 0]), mi.UInt32([1, 2, 2]))
    rest = floats([1, 1, 2**0.5])
    points = mi.Point3f([0, 1, 2], [0, 0, 1], [0, 0, 0])
    expected = (2**0.5 - 1) ** 2 + (5**0.5 - 2**0.5) ** 2
    assert objective.inextensibility(points, edges, rest, mi.Float(1))[0] == pytest.approx(
        expected, rel=1e-5
    )
    assert objective.inextensibility(points, edges, rest, mi.Float(2))[0] == pytest.approx(
        expected / 4, rel=1e-5
    )

    def f(v):
        return objective.inextensibility(
            dr.gather(mi.Point3f, v, dr.arange(mi.UInt32, 3)), edges, rest, mi.Float(0.7)
        )

    check_gradient(f, [0, 0, 0, 1.1, 0.2, 0, 1.3, 0.9, 0.4], h=1e-3)


def test_isometries_are_free():
    edges = (mi.UInt32([0, 1]), mi.UInt32([1, 2]))
    flat = mi.Point3f([0, 1, 2], [0, 0, 0], [1, 1, 1])
    bent = mi.Point3f([0, 1, 1], [0, 0, 0], [1, 1, 2])
    rest = objective.edge_lengths(flat, edges)
    assert objective.inextensibility(bent, edges, rest, mi.Float(1))[0] == pytest.approx(
        0, abs=1e-12
    )


def window_of(values):
    rows = values.reshape(3, 7)
    return [
        Unknowns(
            floats(r[:3]),
            floats(r[3:5]),
            floats(r[5:7]),
            floats([0, 0]),
            floats([0, 0, 0, 1]),
            floats([0, 0, 0]),
        )
        for r in rows
    ]


def test_temporal_value_and_gradient():
    x = RNG.normal(size=21)
    rows = x.reshape(3, 7)
    assert objective.temporal(window_of(x))[0] == pytest.approx(
        (np.diff(rows, axis=0) ** 2).sum() / 2, rel=1e-5
    )
    assert objective.temporal(window_of(x)[:1])[0] == 0
    index = dr.arange(mi.UInt32, 7)

    def f(v):
        rows = [dr.gather(mi.Float, v, 7 * k + index) for k in range(3)]
        zero = floats([0, 0, 0])  # relief, rotation and translation do not count
        part = lambda r, a, n: dr.gather(mi.Float, r, a + dr.arange(mi.UInt32, n))
        return objective.temporal(
            [Unknowns(part(r, 0, 3), part(r, 3, 2), part(r, 5, 2), zero, zero, zero) for r in rows]
        )

    check_gradient(f, x)


def test_gain_is_the_least_squares_one():
    render, target, weight = (
        RNG.random((3, 50)),
        RNG.random((3, 50)),
        (RNG.random(50) > 0.3).astype(float),
    )
    found = objective.gain(
        [floats(c) for c in render], [floats(c) for c in target], floats(weight)
    )[0]
    assert found == pytest.approx(
        (weight * render * target).sum() / (weight * render**2).sum(), rel=1e-4
    )


def test_blur_keeps_the_sum_and_its_width():
    image = np.zeros((41, 41, 2), np.float32)
    image[20, 20] = 1, 2
    out = np.array(objective.blur(mi.TensorXf(image), 1.5))
    assert out.sum((0, 1)) == pytest.approx([1, 2], rel=1e-4)
    x = np.arange(41) - 20
    assert (out[..., 0].sum(0) * x**2).sum() == pytest.approx(
        1.5**2, rel=0.06
    )  # the Gaussian is cut off
    assert objective.blur(mi.TensorXf(image), 0).array is not None


def test_gradient_of_local_normalisation():
    weight = mi.TensorXf(RNG.random((24, 32, 1)).astype(np.float32))
    goal = floats(RNG.normal(size=24 * 32 * 3))
    check_gradient(
        lambda v: dr.sum(
            goal * objective.normalise_locally(mi.TensorXf(v, (24, 32, 3)), weight).array
        ),
        RNG.random(24 * 32 * 3),
        h=2e-3,
    )


def test_local_normalisation_takes_out_gain_and_offset():
    y, x = np.mgrid[:48, :64] / 10
    image = 0.5 + 0.2 * np.stack([np.sin(3 * x + y), np.cos(4 * y), np.sin(2 * x * y)], -1)
    weight = mi.TensorXf(np.ones((48, 64, 1), np.float32))
    lit = image * (0.6 + 0.004 * x[..., None]) + 0.1
    a, b = (
        np.array(objective.normalise_locally(mi.TensorXf(i.astype(np.float32)), weight))
        for i in (image, lit)
    )
    assert np.abs(a).mean() > 0.5
    assert np.abs(a - b)[8:-8, 8:-8].mean() < 0.03 * np.abs(a).mean()


# ---- the objective of a frame --------------------------------------------------------------------


def problem(folder, masks=True, replayed=False, **overrides):
    truth = synthetic.cloth(folder / "sequence", masks=masks)
    layout = capture.recognise(str(truth.folder))
    path = folder / "scene.xml"
    path.write_text(capture.scene_xml(layout, str(truth.folder)))
    if replayed:
        replay_paths(path)
    experiment = scene.load(path, {"solver": "adam", **overrides})
    return (
        Problem(experiment, experiment.sequence()),
        truth,
    )


@pytest.mark.parametrize(
    "overrides",
    [
        {"k_mi": 0},
        {"k_mi": 0, "blur": 1.0, "rgb_norm": "charbonnier"},
        {"k_mi": 0, "brightness": "gain"},
        {"k_mi": 0, "brightness": "local"},
        {"k_rgb": 0, "k_silhouette": 0},
        {"k_mi": 0, "integrator": "raster", "spp": 4},
    ],
)
@pytest.mark.parametrize("masks", [True, False])
def test_gradient_of_the_whole_objective(tmp_path, masks, overrides):
    if not masks and overrides.get("brightness") == "local":
        pytest.skip("the window of the local statistics jumps with the interior, which is detached")
    p, _ = problem(tmp_path, masks, **overrides)
    rest = p.patch.rest().to_numpy()
    rest["delta_alpha"] = (0.02 * np.sin(np.arange(15))).astype(np.float32)[None]
    rest["translation"] = np.array([[0.01, -0.013, 0.02]], np.float32)
    unknowns = Unknowns.from_numpy(rest)
    for _, value in unknowns.items():
        dr.enable_grad(value)
    total, terms = p.evaluate([unknowns], [2], backward=True)
    assert total == pytest.approx(sum(terms.values())) and total > 0
    assert (terms["silhouette"] > 0) == (masks and overrides.get("k_silhouette", 1) > 0)
    for name, size in (("delta_alpha", 15), ("translation", 3)):
        direction = RNG.normal(size=(1, size))
        direction /= np.linalg.norm(direction)
        ad = float(np.array(dr.grad(getattr(unknowns, name))) @ direction[0])
        slopes = []
        for h in (1e-3, 2e-3, 4e-3):
            ends = [
                p.evaluate(
                    [Unknowns.from_numpy({**rest, name: rest[name] + s * h * direction})], [2]
                )[0]
                for s in (1, -1)
            ]
            slopes.append((ends[0] - ends[1]) / (2 * h))
        # 96x72 pixels leave kinks at every pixel that changes sheets, and without masks the
        # interior jumps by whole pixels
        assert ad == pytest.approx(np.median(slopes), rel=0.15, abs=0.03 * max(1, total)), (
            name,
            slopes,
        )


def test_truth_is_nearly_a_minimum(tmp_path):
    """The bent sheet's own surface explains the image better than the flat template and than its
    mirror image in depth.
    """
    from polysft_mi.surface.template import Template

    p, truth = problem(tmp_path)

    def loss(vertices):
        rgb, _alpha = p.image(mi.Point3f(np.ascontiguousarray(vertices.T, dtype=np.float32)))
        target = p.target(4)
        return float(np.mean((np.array(rgb) - np.array(target.rgb)) ** 2))

    bent = truth.vertices[4]
    mirrored = bent * (1, 1, -1) + (0, 0, 2 * bent[:, 2].mean())
    assert loss(bent) < 0.1 * loss(truth.vertices[0]) and loss(bent) < 0.1 * loss(mirrored)
    assert isinstance(p.template, Template)


def test_without_masks_the_background_does_not_matter(tmp_path):
    p, _ = problem(tmp_path, masks=False)
    before = p.evaluate([p.patch.rest()], [0])[0]
    target = p.target(0)
    alpha = np.array(p.image(p.patch.vertices(p.patch.rest()))[1]).reshape(p.height, p.width)
    image = np.array(target.rgb)
    image[alpha == 0] = 1
    target.rgb = mi.TensorXf(image)
    assert p.evaluate([p.patch.rest()], [0])[0] == pytest.approx(before, rel=1e-6)


def test_padding_does_not_change_the_loss(tmp_path):
    """The same sheet in a larger film: neither background nor resolution of the empty part weighs
    in.
    """
    totals = []
    for name, _size in (("small", (96, 72)), ("large", (160, 120))):
        truth = synthetic.cloth(tmp_path / name, size=(96, 72))
        if name == "large":
            import cv2

            for kind in ("frames", "masks"):
                for f in sorted((truth.folder / kind).iterdir()):
                    image = cv2.imread(str(f), cv2.IMREAD_UNCHANGED)
                    big = np.full(
                        (120, 160, *image.shape[2:]), 0 if kind == "masks" else 40, np.uint8
                    )
                    big[24:96, 32:128] = image
                    cv2.imwrite(str(f), big)
            K = truth.K
            import json

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
        experiment = scene.load(path, {"solver": "adam"})
        p = Problem(experiment, experiment.sequence())
        totals.append(p.evaluate([p.patch.rest()], [4])[0])
    assert totals[1] == pytest.approx(totals[0], rel=1e-3)


def test_path_replay_gives_the_gradient_of_raster(tmp_path):
    """On an unshadowed sheet under light from everywhere both integrators render the texture, so
    their gradients are the same but for noise.
    """
    gradients = {}
    for integrator, spp in (("raster", 1), ("prb_projective", 64)):
        folder = tmp_path / integrator
        folder.mkdir()
        p, _ = problem(folder, replayed=integrator != "raster", spp=spp, k_mi=0)
        rest = p.patch.rest().to_numpy()
        rest["translation"] = np.array([[0.02, -0.03, 0.05]], np.float32)
        unknowns = Unknowns.from_numpy(rest)
        dr.enable_grad(unknowns.translation)
        gradients[integrator] = {}
        for name in ("rgb", "silhouette"):
            dr.backward(p.frame_terms(unknowns, 2)[name])
            gradients[integrator][name] = np.array(dr.grad(unknowns.translation))
            dr.clear_grad(unknowns.translation)
    for name in ("rgb", "silhouette"):
        a, b = gradients["raster"][name], gradients["prb_projective"][name]
        assert np.linalg.norm(a - b) < 0.25 * np.linalg.norm(a), (name, a, b)


@pytest.mark.parametrize("integrator", ["raster", "prb_projective"])
def test_gradients_of_several_patches(tmp_path, integrator):
    """Of a tube, whose texture has a seam: by the jets and the motions of its patches, against
    finite differences; path replay's against those of raster, which has no noise.
    """
    from polysft_mi import prepare

    truth = synthetic.cloth(tmp_path / "tube", rows=13, columns=24, frames=2, shape=synthetic.tube)
    prepare.main([str(truth.folder), "-q"])

    def of(spp):
        settings = {"solver": "adam", "k_mi": 0, "order": 3, "spp": spp}
        experiment = scene.load(truth.folder / "scene.xml", settings)
        return Problem(experiment, experiment.sequence())

    sharp = of(4)
    if integrator == "prb_projective":
        replay_paths(truth.folder / "scene.xml")
    p = of(1 if integrator == "raster" else 64)
    assert len(p.template) >= 3
    rest = p.patch.rest().to_numpy()
    rest["delta_alpha"] += (0.02 * RNG.normal(size=rest["delta_alpha"].shape)).astype(np.float32)
    rest["translation"] += np.float32([0.02, -0.03, 0.05])
    unknowns = Unknowns.from_numpy(rest)
    for _, value in unknowns.items():
        dr.enable_grad(value)
    p.evaluate([unknowns], [1], backward=True)
    for name in ("delta_alpha", "translation"):
        gradient = np.array(dr.grad(getattr(unknowns, name))).reshape(rest[name].shape)
        assert (np.abs(gradient).max(1) > 0).sum() >= 2  # the patches that are in view
        direction = gradient / np.linalg.norm(gradient)
        slopes = []
        for h in (1e-3, 2e-3, 4e-3):
            ends = [
                sharp.evaluate([Unknowns.from_numpy({**rest, name: x})], [1])[0]
                for x in (rest[name] + h * direction, rest[name] - h * direction)
            ]
            slopes.append((ends[0] - ends[1]) / (2 * h))
        assert np.linalg.norm(gradient) == pytest.approx(np.median(slopes), rel=0.2), (name, slopes)
