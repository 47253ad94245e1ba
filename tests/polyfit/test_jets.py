"""Jets in NumPy, torch and Dr.Jit."""

import mitsuba as mi
import numpy as np
import pytest
import torch

from polyfit import jets
from polyfit.errors import InputError

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


def test_second_derivatives_against_finite_differences():
    uv, alpha, h = chart(50), random_alpha(5), 1e-5
    zu, zv = jets.height_derivatives(alpha, uv)
    n = (1 + zu * zu + zv * zv).sqrt()
    form = jets.second_fundamental_form(alpha, uv)
    for k, step in enumerate((torch.tensor([h, 0.0]), torch.tensor([0.0, h]))):
        ends = [jets.height_derivatives(alpha, uv + sign * step) for sign in (1, -1)]
        for m in (0, 1):
            numeric = (ends[0][m] - ends[1][m]) / (2 * h) / n
            assert (form[:, k, m] - numeric).abs().max() < 1e-6 * numeric.abs().max()


def test_a_batch_of_jets_is_its_jets():
    uv = torch.stack([chart(30) for _ in range(6)]).reshape(2, 3, 30, 2)
    alpha = torch.stack([random_alpha(4) for _ in range(6)]).reshape(2, 3, 15)
    for function in (
        jets.height,
        jets.point,
        jets.normal,
        jets.metric,
        jets.second_fundamental_form,
        jets.principal_curvatures,
    ):
        together = function(alpha, uv)
        for k in np.ndindex(2, 3):
            assert (together[k] - function(alpha[k], uv[k])).abs().max() < 1e-12
    assert (
        jets.height(alpha, uv[0, 0]) - (jets.basis(uv[0, 0], 4) * alpha[..., None, :]).sum(-1)
    ).abs().max() < 1e-12


def fitted(height, extent=0.3, order=8):
    x, y = np.meshgrid(*[np.linspace(-extent, extent, 40)] * 2)
    points = torch.as_tensor(np.stack([x, y, height(x, y)], -1).reshape(-1, 3))
    return jets.fit(points, order).alpha, points[:, :2] * 0.7


def test_curvatures_of_a_sphere_a_cylinder_and_a_saddle():
    alpha, uv = fitted(lambda x, y: 2 - np.sqrt(4 - x**2 - y**2))
    assert (jets.principal_curvatures(alpha, uv) - 0.5).abs().max() < 1e-5
    alpha, uv = fitted(lambda x, y: np.sqrt(2.25 - (0.8 * x + 0.6 * y) ** 2))
    assert (jets.principal_curvatures(alpha, uv) - torch.tensor([-1 / 1.5, 0])).abs().max() < 1e-5
    alpha, uv = fitted(lambda x, y: x * y)
    n = (1 + (uv**2).sum(-1)).sqrt()  # of z = u v: E G - F^2 = n^2, mean -u v / n^3, Gauss -1 / n^4
    found, mean = jets.principal_curvatures(alpha, uv), -uv.prod(-1) / n**3
    assert (found.mean(-1) - mean).abs().max() < 1e-9
    assert (found.prod(-1) + n**-4).abs().max() < 1e-9
    assert (found[:, 0] <= found[:, 1]).all()


def test_gradient_of_curvatures():
    alpha, uv = random_alpha(4).requires_grad_(), chart(5).requires_grad_()
    assert torch.autograd.gradcheck(jets.principal_curvatures, (alpha, uv))
    flat = torch.zeros(15, dtype=torch.float64, requires_grad=True)
    jets.principal_curvatures(flat, uv).sum().backward()
    assert flat.grad.isfinite().all() and flat.grad[3] == pytest.approx(
        2 * 5
    )  # of the mean curvature, at an umbilic


def test_nearest_points_are_feet_of_normals():
    alpha, uv = 0.2 * random_alpha(4), chart(100)
    x = jets.point(alpha, uv) + 0.05 * torch.as_tensor(RNG.normal(size=(100, 1))) * jets.normal(
        alpha, uv
    )
    found = jets.nearest(alpha, x, steps=30)
    off = x - jets.point(alpha, found)
    assert (torch.linalg.cross(off, jets.normal(alpha, found)).norm(dim=-1) < 1e-6).all()
    before = (x[:, 2] - jets.height(alpha, x[:, :2])).abs()
    assert (off.norm(dim=-1) <= before + 1e-12).all()
    assert (jets.nearest(alpha, jets.point(alpha, uv)) - uv).abs().max() < 1e-12


def test_a_jet_turned_over_is_the_same_surface():
    alpha, uv = random_alpha(5), chart(20)
    over = jets.point(jets.turned_over(alpha), uv * torch.tensor([1, -1])) * torch.tensor(
        [1, -1, -1]
    )
    assert (over - jets.point(alpha, uv)).abs().max() < 1e-12


def in_numpy(x):
    """Numbers, vectors and matrices of Dr.Jit, the points along the first axis."""
    if isinstance(x, tuple):
        return np.stack(np.broadcast_arrays(*map(in_numpy, x)), 1)
    return np.array(x)


@pytest.mark.parametrize("order", [1, 4, 10])
def test_numpy_torch_and_drjit_agree(order):
    uv, alpha = chart(), random_alpha(order)
    rounding = 1e-14 * (max(1, order) * alpha.abs().sum().item()) ** 2
    in_drjit = (
        tuple(mi.Float64(a) for a in alpha.tolist()),
        tuple(mi.Float64(x.numpy()) for x in uv.T.contiguous()),
    )
    everywhere = (
        *(jets.height, jets.point, jets.normal, jets.metric),
        *(lambda *at, k=k: jets.tangents(*at)[k] for k in (0, 1)),
    )
    for function in everywhere:
        expected = function(alpha, uv).numpy()
        assert np.abs(in_numpy(function(*in_drjit)) - expected).max() < rounding
    for function in (*everywhere, jets.second_fundamental_form, jets.mean_curvature):
        found, expected = function(alpha.numpy(), uv.numpy()), function(alpha, uv).numpy()
        assert found.dtype == np.float64 and np.abs(found - expected).max() < rounding


def test_numpy_and_torch_have_the_same_frames_and_feet():
    points = RNG.normal(size=(3, 50, 3)) * (3, 2, 1)
    weights, mask = RNG.random((3, 50)), RNG.random((3, 50)) < 0.8
    q = RNG.normal(size=(3, 4))
    for options in ({}, {"mask": mask}, {"mask": mask, "weights": weights}):
        a = jets.CanonicalFrame.from_points(points, **options)
        b = jets.CanonicalFrame.from_points(
            torch.tensor(points), **{name: torch.tensor(x) for name, x in options.items()}
        )
        for name in ("s", "R", "T"):
            assert np.abs(getattr(a, name) - getattr(b, name).numpy()).max() < 1e-12
        turned = a.rotated(q).turned_over().to_chart(points)
        expected = b.rotated(torch.tensor(q)).turned_over().to_chart(torch.tensor(points))
        assert np.abs(turned - expected.numpy()).max() < 1e-12
        assert np.abs(a.from_chart(a.to_chart(points)) - points).max() < 1e-12
    alpha = 0.2 * RNG.normal(size=15)
    found = jets.nearest(torch.tensor(alpha), torch.tensor(points / 5)).numpy()
    assert np.abs(jets.nearest(alpha, points / 5) - found).max() < 1e-8  # both have converged
    over = jets.turned_over(torch.tensor(alpha)).numpy()
    assert np.array_equal(jets.turned_over(alpha), over)


def test_other_shapes_are_named():
    with pytest.raises(InputError, match="14 is not the number of coefficients of a jet"):
        jets.height(np.zeros(14), np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"uv of 3 coordinates; \(..., points, 2\) is needed"):
        jets.point(torch.zeros(15), torch.zeros(2, 3))
