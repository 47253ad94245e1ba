"""Jets in torch and in Dr.Jit, canonical frames, and the deforming patch."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from polyfit import jets
from polyfit.frames import CanonicalFrame

RNG = np.random.default_rng(7)


def chart(count=400):
    r, a = np.sqrt(RNG.random(count)), 2 * np.pi * RNG.random(count)
    return torch.as_tensor(np.stack([r * np.cos(a), r * np.sin(a)], 1))


def random_alpha(order):
    return torch.as_tensor(RNG.normal(size=(order + 1) * (order + 2) // 2))


def test_coefficients_are_in_the_papers_order():
    assert jets.exponents(2).tolist() == [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]
    uv = torch.tensor([[2.0, 3.0]], dtype=torch.float64)
    alpha = torch.zeros(10, dtype=torch.float64)
    alpha[7] = 1  # i = 3, j = 1: u^2 v
    assert jets.height(alpha, uv).item() == 12


@pytest.mark.parametrize("order", range(1, 11))
def test_fit_recovers_a_jet_of_its_order(order):
    uv, alpha = chart(), random_alpha(order)
    z = jets.height(alpha, uv)
    found = jets.fit(torch.cat([uv, z[:, None]], 1), order)
    assert (jets.height(found, uv) - z).abs().max() < 1e-9 * z.abs().max()
    assert (found - alpha).abs().max() < 1e-6 * alpha.abs().max()


def test_fit_is_the_least_squares_solution():
    uv = chart()
    z = torch.sin(3 * uv[:, 0]) * torch.cos(2 * uv[:, 1])
    alpha = jets.fit(torch.cat([uv, z[:, None]], 1), 4)
    reference = np.linalg.lstsq(jets.basis(uv, 4).numpy(), z.numpy(), rcond=None)[0]
    assert np.abs(alpha.numpy() - reference).max() < 1e-8


def test_fit_refuses_what_does_not_determine_the_jet():
    uv = chart(14)
    with pytest.raises(ValueError, match="15 coefficients, more than the 14 points"):
        jets.fit(torch.cat([uv, uv[:, :1]], 1), 4)
    line = torch.stack([torch.linspace(-1, 1, 50, dtype=torch.float64)] * 3, 1)
    with pytest.raises(ValueError, match="determine only"):
        jets.fit(line, 2)


def test_derivatives_against_finite_differences():
    uv, alpha, h = chart(), random_alpha(5), 1e-6
    zu, zv = jets.height_derivatives(alpha, uv)
    for derivative, step in ((zu, torch.tensor([h, 0.0])), (zv, torch.tensor([0.0, h]))):
        numeric = (jets.height(alpha, uv + step) - jets.height(alpha, uv - step)) / (2 * h)
        assert (derivative - numeric).abs().max() < 1e-6 * numeric.abs().max()


def test_tangents_normal_and_metric_belong_together():
    uv, alpha = chart(), random_alpha(4)
    tu, tv = jets.tangents(alpha, uv)
    n, g = jets.normal(alpha, uv), jets.metric(alpha, uv)
    assert ((n * tu).sum(-1).abs().max(), (n * tv).sum(-1).abs().max()) < (1e-12, 1e-12)
    assert (n.norm(dim=-1) - 1).abs().max() < 1e-12
    J = torch.stack([tu, tv], -1)
    assert (J.transpose(-1, -2) @ J - g).abs().max() < 1e-12


def test_canonical_frame_moves_with_the_points():
    points = torch.as_tensor(RNG.normal(size=(300, 3)) * (1.0, 0.6, 0.1) + RNG.random((300, 3)) ** 2)
    frame = CanonicalFrame.from_points(points)
    R, s, t = torch.as_tensor(Rotation.random(random_state=3).as_matrix()), 2.7, torch.tensor([0.3, -1.0, 4.0], dtype=torch.float64)
    moved = CanonicalFrame.from_points(s * points @ R.T + t)
    assert (frame.to_chart(points) - moved.to_chart(s * points @ R.T + t)).abs().max() < 1e-9
    assert (frame.from_chart(frame.to_chart(points)) - points).abs().max() < 1e-12
    assert torch.linalg.det(frame.R).item() == pytest.approx(1)
    assert frame.to_chart(points).norm(dim=1).max().item() == pytest.approx(1)


@pytest.mark.parametrize("order", [1, 4, 10])
def test_drjit_and_torch_agree(order):
    from polysft_mi import jet

    uv, alpha = chart(), random_alpha(order)
    u, v = (mi.Float(uv[:, k].numpy().astype(np.float32)) for k in (0, 1))
    a = mi.Float(alpha.numpy().astype(np.float32))
    scale = alpha.abs().sum().item()

    def close(x, y):
        assert np.abs(np.array(x).T - y.numpy()).max() < 3e-6 * max(1, order) * scale**2

    close(jet.height(a, u, v), jets.height(alpha, uv))
    close(jet.point(a, u, v), jets.point(alpha, uv))
    for x, y in zip(jet.tangents(a, u, v), jets.tangents(alpha, uv)):
        close(x, y)
    close(jet.normal(a, u, v), jets.normal(alpha, uv))
    g = jets.metric(alpha, uv)
    for x, y in zip(jet.metric(a, u, v), (g[:, 0, 0], g[:, 0, 1], g[:, 1, 1])):
        close(x, y)


@pytest.fixture
def patch():
    """A bent sheet as a patch, and unknowns away from rest."""
    from polysft_mi.patch import JetPatch, Unknowns
    from polysft_mi.template import Template

    y, x = np.meshgrid(np.linspace(-0.1, 0.1, 7), np.linspace(-0.15, 0.15, 9), indexing="ij")
    vertices = np.stack([x, y, 0.6 + 1.5 * x**2 + x * y], -1).reshape(-1, 3)
    i = np.arange(63).reshape(7, 9)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    template = Template.fit(vertices, faces, vertices[:, :2], 4)
    arrays = {
        "delta_alpha": 0.1 * RNG.normal(size=15),
        "delta_u": 0.02 * RNG.normal(size=63),
        "delta_v": 0.02 * RNG.normal(size=63),
        "rotation": np.array([0.1, -0.2, 0.3, 0.9]),
        "translation": 0.1 * RNG.normal(size=3),
    }
    return JetPatch(template), Unknowns.from_numpy(arrays), arrays


def test_patch_at_rest_is_the_template(patch):
    patch, _, _ = patch
    assert np.abs(np.array(patch.vertices(patch.rest())).T - patch.template.vertices).max() < 1e-6
    assert patch.template.residual_max < 1e-3


def test_patch_against_plain_numpy(patch):
    patch, unknowns, x = patch
    t = patch.template
    uv = torch.as_tensor(t.chart + np.stack([x["delta_u"], x["delta_v"]], 1))
    canonical = jets.point(torch.as_tensor(t.alpha + x["delta_alpha"]), uv).numpy()
    R = Rotation.from_quat(x["rotation"]).as_matrix()
    expected = t.scale * (canonical @ R.T + x["translation"]) @ t.rotation.T + t.origin
    assert np.abs(np.array(patch.vertices(unknowns)).T - expected).max() < 1e-6
    normal = jets.normal(torch.as_tensor(t.alpha + x["delta_alpha"]), uv).numpy() @ R.T @ t.rotation.T
    assert np.abs(np.array(patch.normals(unknowns)).T - normal).max() < 1e-5


def test_patch_tangents_and_metric_against_finite_differences(patch):
    patch, unknowns, x = patch
    tangents = [np.array(t).T for t in patch.tangents(unknowns)]
    h = 1e-2
    for k, name in enumerate(("delta_u", "delta_v")):
        ends = []
        for sign in (1, -1):
            moved = dict(x)
            moved[name] = x[name] + sign * h
            ends.append(np.array(patch.vertices(type(unknowns).from_numpy(moved))).T)
        assert np.abs((ends[0] - ends[1]) / (2 * h) - tangents[k]).max() < 1e-3 * np.abs(tangents[k]).max()
    E, F, G = (np.array(g) for g in patch.metric(unknowns))
    for value, (a, b) in ((E, (0, 0)), (F, (0, 1)), (G, (1, 1))):
        expected = (tangents[a] * tangents[b]).sum(1)
        assert np.abs(value - expected).max() < 1e-5 * np.abs(E).max()


def test_gradient_of_vertices_to_every_unknown(patch):
    from polysft_mi.patch import Unknowns

    patch, _, x = patch
    weight = mi.Vector3f(RNG.normal(size=(3, 63)).astype(np.float32))

    def value(arrays):
        return dr.sum(dr.dot(weight, patch.vertices(Unknowns.from_numpy(arrays))))

    unknowns = Unknowns.from_numpy(x)
    for _, v in unknowns.items():
        dr.enable_grad(v)
    dr.backward(dr.sum(dr.dot(weight, patch.vertices(unknowns))))
    for name, v in unknowns.items():
        gradient, h = np.array(dr.grad(v)), 1e-2
        direction = RNG.normal(size=gradient.shape)
        ends = [value({**x, name: x[name] + sign * h * direction})[0] for sign in (1, -1)]
        assert gradient @ direction == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=0.02, abs=2e-3), name
