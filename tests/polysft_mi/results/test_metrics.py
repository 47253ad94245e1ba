"""Figures against slow readable references, and against values known by construction."""

import numpy as np
import pytest

from polyfit.mesh import vertex_normals
from polysft_mi.errors import InputError
from polysft_mi.results import evaluation, metrics
from polysft_mi.results.truth import Truth


def grid(n=9, m=7, size=0.3, depth=0.6):
    """A bent sheet: vertices (n m, 3), faces."""
    x, y = np.meshgrid(np.linspace(-size / 2, size / 2, n), np.linspace(-size / 2, size / 2, m))
    V = np.stack([x, y, depth + 0.04 * np.sin(9 * x) + 0.03 * np.cos(8 * y)], -1).reshape(-1, 3)
    k = np.arange(n * m).reshape(m, n)
    a, b, c, d = (i.ravel() for i in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    return V, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def rotation(rng):
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def slow_ray_depth(V, F, points):
    """One ray and one triangle after the other: solve p0 + b1 e1 + b2 e2 = t r."""
    out = []
    for q in points:
        ray, hits = q / q[2], []
        for a, b, c in V[F]:
            system = np.stack([b - a, c - a, -ray], axis=1)
            if abs(np.linalg.det(system)) < 1e-18:
                continue
            b1, b2, t = np.linalg.solve(system, -a)
            if b1 >= -1e-6 and b2 >= -1e-6 and b1 + b2 <= 1 + 1e-6 and t > 0:
                hits.append(t)
        out.append(min(hits) if hits else np.nan)
    return np.array(out)


def test_errors_of_a_known_displacement():
    G, _ = grid()
    V = G + (0.003, -0.004, 0.0)
    assert metrics.rmse(V, G) == pytest.approx(0.005)
    assert metrics.e3d(V, G) == pytest.approx(0.005 * np.sqrt(len(G)) / np.sqrt((G**2).sum()))
    assert metrics.e3d_procrustes(V, G) < 1e-12


def test_alignment_finds_a_similarity_and_refuses_a_reflection():
    rng = np.random.default_rng(1)
    G, _ = grid()
    V = 1.7 * G @ rotation(rng).T + (0.2, -0.1, 0.4)
    np.testing.assert_allclose(metrics.align_similarity(V, G), G, atol=1e-12)
    assert metrics.e3d_procrustes(V * (-1, 1, 1), G) > 0.01  # what a reflection would take to 0


def test_alignment_is_the_best_one():
    rng = np.random.default_rng(2)
    G, _ = grid()
    V = G + 0.01 * rng.normal(size=G.shape)
    best = metrics.align_similarity(V, G)
    error = ((best - G) ** 2).sum()
    mean = best.mean(0)
    for _ in range(20):
        w = 1e-3 * rng.normal(size=3)
        turn = np.eye(3) + np.cross(np.eye(3), w)
        turn = np.linalg.qr(turn)[0] * np.sign(np.diag(np.linalg.qr(turn)[1]))
        other = (1 + 1e-3 * rng.normal()) * (best - mean) @ turn + mean + 1e-4 * rng.normal(size=3)
        assert ((other - G) ** 2).sum() > error


def test_normals_of_a_cylinder_and_of_a_tilt():
    theta, y = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(0, 1, 11))
    V = np.stack([np.sin(theta), y, 2 - np.cos(theta)], -1).reshape(-1, 3)
    _, F = grid(41, 11)
    n = vertex_normals(V, F).reshape(11, 41, 3)[2:-2, 2:-2]
    want = np.stack([np.sin(theta), 0 * theta, -np.cos(theta)], -1)[2:-2, 2:-2]
    assert np.abs(np.abs((n * want).sum(-1)) - 1).max() < 1e-3
    G, F = grid()
    a = np.radians(12)
    tilt = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    flat = G * (1, 1, 0) + (0, 0, 0.6)
    assert metrics.normal_angle(flat @ tilt.T, flat, F) == pytest.approx(12)
    assert metrics.normal_angle(flat, flat, F[:, ::-1]) == pytest.approx(0)
    assert metrics.normal_angle(flat * (1, 1, -1), flat * (1, 1, -1), F) == pytest.approx(0)


def test_ray_depth_agrees_with_the_slow_reference():
    rng = np.random.default_rng(3)
    V, F = grid()
    V2 = np.concatenate([V, V * (0.5, 0.5, 0.7)])  # a second sheet in front of part of the first
    F2 = np.concatenate([F, (F + len(V))[:, ::-1]])  # seen from behind
    points = rng.uniform((-0.2, -0.2, 0.4), (0.2, 0.2, 0.8), size=(120, 3))
    points[:20] = V[rng.integers(len(V), size=20)] * rng.uniform(
        0.5, 2, size=(20, 1)
    )  # rays through vertices
    want = slow_ray_depth(V2, F2, points)
    assert 20 < np.isnan(want).sum() < 100
    np.testing.assert_allclose(metrics.ray_depth(V2, F2, points), want, rtol=1e-9)
    large = np.array(
        [[-5, -4, -0.3], [5, -4, 0.9], [0, 6, 1.2], [0, 0.1, 0.5]]
    )  # a triangle that passes beside the camera, a sliver
    V3, F3 = (
        np.concatenate([V2, large]),
        np.concatenate([F2, len(V2) + np.array([[0, 1, 2], [3, 1, 2]])]),
    )
    want = slow_ray_depth(V3, F3, points)
    np.testing.assert_allclose(metrics.ray_depth(V3, F3, points), want, rtol=1e-9)
    assert np.isnan(
        metrics.ray_depth(V2 * (1, 1, -1), F2, points)
    ).all()  # a mesh behind the camera
    assert np.isnan(metrics.ray_depth(V2, F2[:0], points)).all() and metrics.ray_depth(
        V2, F2, points[:0]
    ).shape == (0,)
    broken = np.concatenate([points, [[0.1, 0, 0], [np.nan, 0, 1]]])
    np.testing.assert_allclose(
        metrics.ray_depth(V3, F3, broken), [*want, np.nan, np.nan], rtol=1e-9
    )


def test_depth_rmse_of_a_shifted_plane_and_its_hits():
    V, F = grid()
    V[:, 2] = 0.6
    rng = np.random.default_rng(4)
    inside = np.column_stack([rng.uniform(-0.1, 0.1, (50, 2)), np.full(50, 0.61)])
    outside = np.column_stack([rng.uniform(0.2, 0.3, (25, 2)), np.full(25, 0.61)])
    error, share = metrics.depth_rmse(V, F, np.concatenate([inside, outside]))
    assert error == pytest.approx(0.01) and share == pytest.approx(2 / 3)
    assert metrics.depth_rmse(V, F, outside) == (np.inf, 0)


def test_image_share_of_a_fronto_parallel_sheet():
    V, F = grid(size=0.3)
    V[:, 2] = 0.6
    K = np.array([[500, 0, 320], [0, 400, 240], [0, 0, 1.0]])
    assert metrics.image_share(V, F, K) == pytest.approx((0.3 / 0.6) ** 2 * 500 * 400 / (640 * 480))


def test_chamfer_agrees_with_all_pairs():
    rng = np.random.default_rng(5)
    A, B = rng.normal(size=(60, 3)), rng.normal(size=(45, 3)) + 0.3
    pairs = ((A[:, None] - B[None]) ** 2).sum(-1)
    assert metrics.chamfer(A, B) == pytest.approx(pairs.min(1).mean() + pairs.min(0).mean())


def test_samples_lie_on_the_surface_and_are_even():
    V = np.array(
        [[0, 0, 1], [3, 0, 1], [3, 1, 1], [0, 1, 1], [-1, 0, 1], [-1, 1, 1.0]]
    )  # areas 3/2, 3/2, 1/2, 1/2
    F = np.array([[0, 1, 2], [0, 2, 3], [4, 0, 5], [0, 3, 5]])
    S = metrics.sample_surface(V, F, 40000, np.random.default_rng(6))
    assert np.abs(S[:, 2] - 1).max() < 1e-12 and S[:, 0].min() >= -1 and S[:, 0].max() <= 3
    count, _ = np.histogram(S[:, 0], bins=8, range=(-1, 3))
    assert np.abs(count / 5000 - 1).max() < 0.07
    count, _ = np.histogram(S[:, 1], bins=4, range=(0, 1))
    assert np.abs(count / 10000 - 1).max() < 0.05


def test_psnr_inside_and_outside_a_mask():
    target = np.full((20, 30, 3), 0.5)
    image = target.copy()
    image[:, 15:] += 0.1
    mask = np.zeros((20, 30))
    mask[:, 15:] = 1
    assert metrics.psnr(image, target, mask) == pytest.approx(20)
    assert metrics.psnr(image, target) == pytest.approx(20 + 10 * np.log10(2))
    assert metrics.psnr(image, target, 1 - mask) == np.inf
    assert np.isnan(metrics.psnr(image, target, 0 * mask))


def test_ssim_is_scikit_images():
    skimage = pytest.importorskip("skimage.metrics", reason="needs scikit-image")
    rng = np.random.default_rng(7)
    x = rng.random((24, 27, 3))
    y = np.clip(x + 0.2 * rng.normal(size=x.shape), 0, 1)
    wang = dict(gaussian_weights=True, use_sample_covariance=False, data_range=1.0)
    _, field = skimage.structural_similarity(x, y, full=True, channel_axis=2, **wang)
    inner = field[5:-5, 5:-5]  # where the window lies within the image
    assert metrics.ssim(x, y) == pytest.approx(inner.mean(), rel=1e-6)
    mask = np.zeros((24, 27), bool)
    mask[3:12, 2:14] = True
    assert metrics.ssim(x, y, mask) == pytest.approx(inner[mask[5:-5, 5:-5]].mean(), rel=1e-6)
    assert metrics.ssim(x, x) == pytest.approx(1)
    assert np.isnan(metrics.ssim(x, y, 0 * mask)) and np.isnan(metrics.ssim(x[:10], y[:10]))


def test_score_refuses_what_cannot_be_compared(tmp_path):
    V, F = grid()
    surface = {"vertices": V[None], "faces": F, "frames": np.array([3])}
    np.savez(tmp_path / "short.npz", vertices=V[None], faces=F)
    np.savez(tmp_path / "small.npz", vertices=np.stack([V[:-1]] * 5), faces=F[:4])
    np.savez(tmp_path / "other.npz", colours=V)
    (tmp_path / "noise.npz").write_bytes(b"not a zip file")
    (tmp_path / "folder").mkdir()
    for name, words in {
        "short.npz": "no frame in common",
        "small.npz": "63 vertices, .* has 62",
        "other.npz": "vertices and faces, or points and frames",
        "noise.npz": "not a readable",
        "missing.npz": "no such file",
        "folder": "holds no ground truth",
    }.items():
        with pytest.raises(InputError, match=words):
            evaluation.score(surface, str(tmp_path / name))
    with pytest.raises(InputError, match="not finite"):
        evaluation.score(
            {**surface, "vertices": surface["vertices"] * np.nan}, str(tmp_path / "short.npz")
        )


def test_confidence_says_how_far_sigma_is_off():
    rng = np.random.default_rng(0)
    truth = np.tile([0.1, -0.05, 1.0], (4, 500, 1)) + 0.05 * rng.normal(size=(1, 500, 3))
    sigma = np.tile(10 ** rng.uniform(-4, -2, (1, 500)), (4, 1))
    ray = truth / np.linalg.norm(truth, axis=2, keepdims=True)
    found = truth + (3 * sigma * rng.normal(size=(4, 500)))[..., None] * ray
    surface = {"vertices": found, "frames": np.arange(4), "sigma": sigma}
    figures = evaluation.confidence(surface, Truth("", "mesh", dict(enumerate(truth))))
    assert (
        abs(figures["sigma_factor"] - 3) < 0.2
        and abs(figures["sigma_two"] - 0.495) < 0.04  # of a normal variable within 2/3
        and figures["sigma_rank"] > 0.7
    )
    assert (
        evaluation.confidence(
            {**surface, "sigma": np.full((4, 500), np.nan)},
            Truth("", "mesh", dict(enumerate(truth))),
        )
        == {}
    )
    assert (
        evaluation.confidence(
            {k: v for k, v in surface.items() if k != "sigma"},
            Truth("", "mesh", dict(enumerate(truth))),
        )
        == {}
    )
