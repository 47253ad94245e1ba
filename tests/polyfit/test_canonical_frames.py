"""Canonical frames: that they turn, grow and move with their points, in batches of patches of any
size.
"""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from polyfit import CanonicalFrame, InputError, jets, rotation_matrix

RNG = np.random.default_rng(5)


def patches(counts=(300, 150, 40)):
    """Bent patches (B, P, 3) in general position and which points exist."""
    x = (
        RNG.normal(size=(len(counts), max(counts), 2)) * (1.0, 0.6)
        + RNG.random((len(counts), max(counts), 2)) ** 2
    )
    z = 0.2 * x[..., :1] ** 2 - 0.1 * x[..., 1:] * x[..., :1]
    turn = Rotation.random(len(counts), random_state=1).as_matrix()
    points = torch.as_tensor(np.concatenate([x, z], -1) @ turn)
    return points, torch.arange(max(counts)) < torch.tensor(counts)[:, None]


def similarity(count, seed=2):
    R = torch.as_tensor(Rotation.random(count, random_state=seed).as_matrix())
    s = torch.as_tensor(RNG.uniform(0.1, 9, size=count))
    T = torch.as_tensor(RNG.normal(size=(count, 3)))
    return lambda x: s[:, None, None] * x @ R.mT + T[:, None]


def test_chart_does_not_change_when_the_points_move():
    points, mask = patches()
    move = similarity(3)
    frame, moved = (
        CanonicalFrame.from_points(points, mask),
        CanonicalFrame.from_points(move(points), mask),
    )
    x = frame.to_chart(points)
    assert (x - moved.to_chart(move(points)))[mask].abs().max() < 1e-9
    assert (frame.from_chart(x) - points).abs().max() < 1e-12
    assert torch.linalg.det(frame.R).numpy() == pytest.approx(1)
    assert torch.where(mask, x.norm(dim=-1), 0).amax(1).numpy() == pytest.approx(1)
    spread = torch.where(mask[..., None], x, 0).square().sum(1)
    assert (spread[:, 0] >= spread[:, 1]).all() and (spread[:, 1] >= spread[:, 2]).all()


def test_coefficients_do_not_change_when_the_points_move():
    points, mask = patches()
    move = similarity(3)
    found = [
        jets.fit(CanonicalFrame.from_points(p, mask).to_chart(p), 4, mask=mask).alpha
        for p in (points, move(points))
    ]
    assert (found[0] - found[1]).abs().max() < 1e-8


def test_a_batch_of_frames_is_its_frames():
    points, mask = patches()
    weights = torch.as_tensor(RNG.random(mask.shape))
    together = CanonicalFrame.from_points(points, mask, weights=weights)
    for k in range(3):
        alone = CanonicalFrame.from_points(points[k, mask[k]], weights=weights[k, mask[k]])
        for name in ("s", "R", "T"):
            assert (getattr(together[k], name) - getattr(alone, name)).abs().max() < 1e-12


def test_weights_are_repeated_points():
    points, _ = patches((50,))
    weights = torch.ones(1, 50, dtype=torch.float64)
    weights[:, :20] = 2
    repeated = torch.cat([points, points[:, :20]], 1)
    a, b = CanonicalFrame.from_points(points, weights=weights), CanonicalFrame.from_points(repeated)
    assert (a.R - b.R).abs().max() < 1e-9 and (a.T - b.T).abs().max() < 1e-12


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_symmetric_patch_keeps_its_signs(dtype):
    y, x = np.meshgrid(np.linspace(-0.7, 0.7, 8), np.linspace(-1, 1, 12), indexing="ij")
    grid = torch.as_tensor(np.stack([x, y, 0.3 * x * x], -1).reshape(1, -1, 3))
    still = CanonicalFrame.from_points(grid).to_chart(grid)
    for seed in range(10):
        moved = similarity(1, seed)(grid).to(dtype)
        assert (CanonicalFrame.from_points(moved).to_chart(moved) - still).abs().max() < (
            1e-4 if dtype == torch.float32 else 1e-9
        )


def test_rotated_frame():
    points, mask = patches()
    q = torch.as_tensor(Rotation.random(3, random_state=4).as_quat())
    assert (
        rotation_matrix(2 * q) - torch.as_tensor(Rotation.from_quat(q.numpy()).as_matrix())
    ).abs().max() < 1e-12
    frame = CanonicalFrame.from_points(points, mask)
    turned = frame.rotated(q)
    assert (
        turned.to_chart(points) - frame.to_chart(points) @ rotation_matrix(q)
    ).abs().max() < 1e-12
    assert (turned.from_chart(turned.to_chart(points)) - points).abs().max() < 1e-12
    q.requires_grad_()
    assert torch.autograd.gradcheck(lambda q: frame.rotated(q).to_chart(points[:, :3]), (q,))


def test_frame_turned_over():
    points, mask = patches()
    frame = CanonicalFrame.from_points(points, mask)
    over = frame.turned_over()
    assert (
        over.to_chart(points) - frame.to_chart(points) * torch.tensor([1, -1, -1])
    ).abs().max() < 1e-12
    assert torch.linalg.det(over.R).numpy() == pytest.approx(1)


def test_what_has_no_frame_is_named():
    points, mask = patches()
    for message, change in {
        "patch 1 has no points": lambda p, m: (p, m & torch.tensor([[True], [False], [True]])),
        "patch 2 has points that are not finite": lambda p, m: (
            torch.where(torch.arange(3)[:, None, None] == 2, np.inf, p),
            m,
        ),
        "patch 0: its 300 points coincide": lambda p, m: (
            torch.where(torch.arange(3)[:, None, None] == 0, 1.0, p),
            m,
        ),
    }.items():
        with pytest.raises(InputError, match=message):
            CanonicalFrame.from_points(*change(points, mask))
    with pytest.raises(InputError, match="the patch: its 4 points coincide"):
        CanonicalFrame.from_points(torch.ones(4, 3))
    for wrong in torch.arange(12).reshape(4, 3), torch.rand(4, 2), [[0.0, 1.0, 2.0]] * 4:
        with pytest.raises(InputError, match=r"\(..., points, 3\) of floats is needed"):
            CanonicalFrame.from_points(wrong)
    with pytest.raises(InputError, match=r"\(0, 20, 3\); one patch or more is needed"):
        CanonicalFrame.from_points(torch.rand(0, 20, 3))


@pytest.mark.parametrize("kind", [torch.as_tensor, np.asarray])
def test_masks_and_weights_that_do_not_fit_are_named(kind):
    points, mask = (kind(x) for x in patches())
    for how, message in (
        (dict(weights=-1.0), "patch 0 has weights that are negative, not finite, or all 0"),
        (dict(weights=0), "patch 0 has weights that are negative, not finite, or all 0"),
        (dict(weights=[np.nan]), "patch 0 has weights that are negative, not finite, or all 0"),
        (dict(weights=np.ones(7)), r"weights of shape \(7,\), .*; \(3, 300\) of float is needed"),
        (dict(mask=np.ones((3, 300), int)), r"mask of shape .*int64; \(3, 300\) of bool is needed"),
        (dict(mask="all"), r"; \(3, 300\) of bool is needed"),
    ):
        with pytest.raises(InputError, match=message):
            CanonicalFrame.from_points(points, **how)
    found = CanonicalFrame.from_points(points, mask.tolist(), weights=np.ones((3, 300)))
    assert abs(found.R - CanonicalFrame.from_points(points, mask).R).max() < 1e-9
