"""Least-squares jets of batches of patches, against exact jets, NumPy's least squares and finite
differences.
"""

import numpy as np
import pytest
import torch

from polyfit import InputError, jets

RNG = np.random.default_rng(11)


def disc(count):
    r, a = np.sqrt(RNG.random(count)), 2 * np.pi * RNG.random(count)
    return np.stack([r * np.cos(a), r * np.sin(a)], 1)


def patches(order, counts=(400, 120, 90), dtype=torch.float64):
    """Points (B, P, 3) on random jets, padded; the jets; which points exist."""
    alpha = torch.as_tensor(RNG.normal(size=(len(counts), jets.size_of(order))))
    uv = torch.as_tensor(np.stack([disc(max(counts)) for _ in counts]))
    mask = torch.arange(max(counts)) < torch.tensor(counts)[:, None]
    return jets.point(alpha, uv).to(dtype), alpha, mask


@pytest.mark.parametrize("order", range(1, 11))
def test_recovers_jets_of_its_order(order):
    points, alpha, mask = patches(order)
    found = jets.fit(points, order, mask=mask)
    assert (found.order == order).all()
    scale = points[..., 2].abs().max()
    assert (jets.height(found.alpha, points[..., :2]) - points[..., 2])[
        mask
    ].abs().max() < 1e-8 * scale
    assert (found.alpha - alpha).abs().max() < 1e-6 * alpha.abs().max()


def test_single_precision_at_order_8():
    points, _alpha, mask = patches(8, dtype=torch.float32)
    found = jets.fit(points, 8, mask=mask)
    assert found.alpha.dtype == torch.float32 and (found.order == 8).all()
    z = points[..., 2]
    assert (jets.height(found.alpha, points[..., :2]) - z)[mask].abs().max() < 1e-5 * z.abs().max()


def test_is_numpys_least_squares():
    points, _, mask = patches(3)
    points[..., 2] += torch.sin(3 * points[..., 0]) * torch.cos(2 * points[..., 1])
    weights = torch.as_tensor(RNG.random(mask.shape))
    found = jets.fit(points, 4, weights=weights, mask=mask).alpha
    for p, w, m, alpha in zip(points, weights, mask, found):
        root = w[m, None].sqrt()
        reference = np.linalg.lstsq(
            (jets.basis(p[m, :2], 4) * root).numpy(), (p[m, 2:] * root).numpy(), rcond=None
        )[0]
        assert np.abs(alpha.numpy() - reference[:, 0]).max() < 1e-9


def test_narrow_and_remote_patches_are_fitted_as_well():
    uv = torch.as_tensor(disc(300) * (0.9, 0.02) + (0.0, 0.8))
    z = 3 * uv[:, 0] ** 3 + (uv[:, 1] - 0.8) ** 2 * 40 - uv[:, 0] * uv[:, 1]
    found = jets.fit(torch.cat([uv, z[:, None]], 1), 4)
    assert found.order == 4
    assert (jets.height(found.alpha, uv) - z).abs().max() < 1e-9


def test_padding_is_not_looked_at():
    points, _, mask = patches(4)
    expected = jets.fit(points, 4, mask=mask).alpha
    for value in (float("nan"), float("inf"), 1e30):
        assert torch.equal(
            jets.fit(torch.where(mask[..., None], points, value), 4, mask=mask).alpha, expected
        )
    alone = jets.fit(points[1, :120], 4)
    assert alone.alpha.shape == (15,) and alone.order.shape == ()
    assert (alone.alpha - expected[1]).abs().max() < 1e-9


def test_weights_of_zero_and_repeated_points():
    points, _, _ = patches(4, counts=(60,))
    points[..., 2] += 0.1 * torch.as_tensor(RNG.normal(size=(1, 60)))
    weights = torch.ones(1, 60)
    weights[:, 40:] = 0
    weights[:, :5] = 3
    repeated = torch.cat([points[:, :5]] * 2 + [points[:, :40]], 1)
    assert (
        jets.fit(points, 3, weights=weights).alpha - jets.fit(repeated, 3).alpha
    ).abs().max() < 1e-9


@pytest.mark.parametrize("count, order", [(1, 0), (2, 0), (3, 1), (5, 1), (6, 2), (14, 3), (18, 4)])
def test_few_points_lower_the_order(count, order):
    points = torch.as_tensor(np.concatenate([disc(20), RNG.normal(size=(20, 1))], 1))
    batch = torch.stack([points, points])
    mask = torch.arange(20) < torch.tensor([[count], [20]])
    found = jets.fit(batch, 4, mask=mask)
    assert found.order.tolist() == [order, 4]
    assert (found.alpha[0, jets.size_of(order) :] == 0).all()
    if order:
        alone = jets.fit(points[:count], order).alpha
        assert (found.alpha[0, : len(alone)] - alone).abs().max() < 1e-9
    else:
        assert found.alpha[0, 0].item() == pytest.approx(points[:count, 2].mean().item())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_that_lie_badly_lower_the_order(dtype):
    t = torch.linspace(-1, 1, 64, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(t[::8], t[::8], indexing="ij"), -1).reshape(-1, 2)
    parabola = torch.stack([t, t * t], 1)
    line = torch.stack([0.6 * t, 0.8 * t], 1)
    along_u = torch.stack([t, 1e-8 * torch.as_tensor(RNG.normal(size=64))], 1)
    point = torch.zeros(64, 2, dtype=torch.float64)
    uv = torch.stack([grid, parabola, line, along_u, point])
    points = torch.cat([uv, torch.as_tensor(RNG.normal(size=(5, 64, 1)))], -1).to(dtype)
    found = jets.fit(points, 8)
    # a grid of 8 x 8 holds degree 7 in each direction; a conic tells lines apart, not conics
    assert found.order.tolist() == [7, 1, 0, 0, 0]
    assert found.alpha.isfinite().all()


def test_gradient_against_finite_differences():
    points, _, mask = patches(4, counts=(30, 22, 8))
    points = points.requires_grad_()
    weights = torch.as_tensor(0.5 + RNG.random(mask.shape)).requires_grad_()
    assert jets.fit(points, 4, mask=mask).order.tolist() == [4, 4, 2]
    assert torch.autograd.gradcheck(
        lambda p, w: jets.fit(p, 4, weights=w, mask=mask).alpha, (points, weights), fast_mode=True
    )
    assert torch.autograd.gradcheck(lambda p: jets.fit(p, 2).alpha, (points,), fast_mode=True)


def test_gradient_in_single_precision_at_order_8():
    points, _, mask = patches(8, counts=(200, 100))
    points[..., 2] += 0.1 * torch.as_tensor(RNG.normal(size=mask.shape))
    uv = torch.as_tensor(disc(50))
    gradients = []
    for dtype in (torch.float64, torch.float32):
        p = points.to(dtype, copy=True).requires_grad_()
        jets.height(jets.fit(p, 8, mask=mask).alpha, 0.8 * uv.to(dtype)).square().sum().backward()
        gradients.append(p.grad.double())
    assert (gradients[0] - gradients[1]).abs().max() < 1e-3 * gradients[0].abs().max()
    assert (gradients[0][~mask] == 0).all()


@pytest.mark.parametrize("loss", [torch.Tensor.sum, lambda alpha: alpha.square().sum()])
def test_a_second_derivative_is_refused_rather_than_wrong(loss):
    points, _, mask = patches(3)
    points, weights = points.requires_grad_(), torch.ones(mask.shape).double().requires_grad_()
    alpha = jets.fit(points, 3, weights=weights).alpha
    for gradient in torch.autograd.grad(loss(alpha), (points, weights), create_graph=True):
        with pytest.raises(RuntimeError, match="differentiable once"):
            (gradient.sum() + points.sum()).backward(retain_graph=True)


def test_what_cannot_be_fitted_is_named():
    points, _, _mask = patches(2, counts=(20, 20))
    empty = torch.tensor([[True], [False]]).expand(2, 20)
    for message, call in {
        "patch 1 has no points": lambda: jets.fit(points, 2, mask=empty),
        "patch 0 has no points": lambda: jets.fit(points[:, :0], 2),
        "patch 1 has points that are not finite": lambda: jets.fit(
            points * torch.tensor([[[1.0]], [[float("nan")]]]), 2
        ),
        "patch 0 has weights that are negative": lambda: jets.fit(
            points, 2, weights=torch.tensor([[-1.0], [1.0]]).expand(2, 20)
        ),
        "order = 11; the order of a jet is 1 to 10": lambda: jets.fit(points, 11),
        "(..., points, 3) of floats is needed": lambda: jets.fit(points[..., :2], 2),
        "torch.int32; (..., points, 3) of floats": lambda: jets.fit(points.int(), 2),
        "a tensor of torch is needed": lambda: jets.fit(points.numpy(), 2),
        "order = 2.5; the order of a jet is 1 to 10": lambda: jets.fit(points, 2.5),
        "order = '4'; the order of a jet is 1 to 10": lambda: jets.fit(points, "4"),
        "(0, 20, 3); one patch or more is needed": lambda: jets.fit(points[:0], 2),
        "mask of shape (2, 20), torch.int64; (2, 20) of bool": lambda: jets.fit(
            points, 2, mask=torch.ones(2, 20).long()
        ),
        "mask of shape (7,), torch.bool; (2, 20) of bool": lambda: jets.fit(
            points, 2, mask=torch.ones(7).bool()
        ),
        "weights of shape (), <class 'list'>; (2, 20) of float": lambda: jets.fit(
            points, 2, weights=["a"]
        ),
        "patch 0 has weights that": lambda: jets.fit(points, 2, weights=torch.tensor(-1.0)),
        "patch 0 has weights that are negative or not": lambda: jets.fit(
            points, 2, weights=torch.full((2, 20), float("nan"))
        ),
    }.items():
        with pytest.raises(InputError) as error:
            call()
        assert message in str(error.value)


def test_masks_weights_and_orders_that_are_plainly_meant():
    points, _, mask = patches(3)
    weights = torch.rand(mask.shape)
    found = jets.fit(points, 3, weights=weights, mask=mask).alpha
    given = dict(weights=weights.numpy(), mask=mask.tolist())
    assert torch.equal(jets.fit(points, 3.0, **given).alpha, found)
    twice = jets.fit(points, 3, weights=torch.tensor(2.0)).alpha
    assert torch.allclose(twice, jets.fit(points, 3).alpha)
