"""The figures of folds, on sheets that are bent, waved and moved by known amounts."""

import numpy as np
import pytest
import torch
from surfaces import ball

from onefit.objective import crossings
from onefit.objective.folds import angles, folds, inner_edges
from polyfit import mesh


def strip(nx=40, nz=25, spacing=0.01):
    """An upright sheet in the plane y = 0: vertices (N, 3) [m], faces (F, 3) seen from -y, its grid
    (nx, nz).
    """
    x, z = np.meshgrid(spacing * np.arange(nx), spacing * np.arange(nz), indexing="ij")
    V = np.stack([x, 0 * x, z], -1).reshape(-1, 3)
    a = (np.arange(nx - 1)[:, None] * nz + np.arange(nz - 1)).ravel()
    F = np.concatenate([np.stack([a, a + nz, a + nz + 1], 1), np.stack([a, a + nz + 1, a + 1], 1)])
    return torch.as_tensor(V), torch.as_tensor(F)


def test_inner_edges_are_those_of_two_faces():
    _, F = strip(5, 4)
    edges, sides = inner_edges(F)
    every, side = mesh.edges_of(F.numpy())
    assert len(edges) == (np.bincount(side.ravel()) == 2).sum() < len(every)
    for (a, b), pair in zip(edges.tolist(), sides.tolist()):
        assert pair[0] != pair[1]
        assert all({a, b} <= set(F[f].tolist()) for f in pair)


def test_a_sheet_bent_along_one_line_has_that_angle_with_its_sign():
    V, F = strip(5, 4)
    edges, sides = inner_edges(F)
    fold = 0.02  # x of the line
    for turn in (0.3, -0.3):
        bent = V.clone()
        far = V[:, 0] > fold
        bent[far, 0] = fold + (V[far, 0] - fold) * np.cos(turn)
        bent[far, 1] = -(V[far, 0] - fold) * np.sin(turn)  # turn > 0: towards the outer side
        found = angles(bent[None], F, sides)[0]
        on = (V[edges][:, :, 0] == fold).all(1)
        assert on.sum() == 3
        assert found[on].numpy() == pytest.approx(turn, abs=1e-9)
        assert found[~on].abs().max() < 1e-6


def test_waves_are_told_from_noise_and_both_from_none():
    V, F = strip()
    still = V.expand(3, -1, -1)
    x = V[:, 0]
    wave, noise = still.clone(), still.clone()
    wave[:, :, 1] += 0.012 * torch.sin(2 * np.pi * x / 0.10)  # 10 cm long
    grain = torch.randn(len(V), generator=torch.Generator().manual_seed(0), dtype=V.dtype)
    noise[:, :, 1] += 0.0008 * grain
    none, waved, noisy = (folds(v, still, F, rest=V) for v in (still, wave, noise))
    assert none.fold < 1e-3 and none.wave < 1e-3
    assert waved.fold > 2 and waved.wave > 0.8 * waved.fold
    assert noisy.fold > 2 and noisy.wave < 0.25 * noisy.fold


def test_swing_and_hang_are_displacements_of_the_lowest_third_alone():
    V, F = strip()
    T = 12
    still = V.expand(T, -1, -1)
    moved = still.clone()
    low = V[:, 2] < torch.quantile(V[:, 2], 1 / 3)
    time = 2 * np.pi * torch.arange(T, dtype=V.dtype) / T
    moved[:, low, 0] += 0.03 * torch.sin(time)[:, None] + 0.04
    moved[:, ~low, 0] += 1.0  # not looked at
    found = folds(moved, still, F, rest=V)
    assert found.hang == pytest.approx(40, rel=1e-6)
    assert found.swing == pytest.approx(30 / np.sqrt(2), rel=1e-6)


def test_strain_is_against_the_lengths_at_rest():
    V, F = strip(6, 5)
    stretched = 1.02 * V.expand(2, -1, -1)
    assert folds(stretched, V.expand(2, -1, -1), F, rest=V).strain == pytest.approx(2, rel=1e-6)
    edges = inner_edges(F)[0]
    lengths = 1.02 * (V[edges[:, 0]] - V[edges[:, 1]]).norm(dim=-1)
    assert folds(stretched, V.expand(2, -1, -1), F, lengths).strain < 1e-6


def test_crossings_are_pairs_of_faces_that_pass_through_each_other():
    (a, F), (b, _) = ball(0.1, 1), ball(0.1, 1)
    both = np.concatenate([F.numpy(), F.numpy() + len(a)])
    at = lambda x: np.concatenate([a.numpy(), (b + torch.tensor([x, 0.013, 0.007])).numpy()])
    assert crossings(at(0.25), both) == 0  # beside
    assert crossings(a.numpy(), F.numpy()) == 0
    vertices, slow = at(0.15), 0
    for f in F.numpy():
        for g in F.numpy() + len(a):
            slow += pierces(vertices[f], vertices[g]) or pierces(vertices[g], vertices[f])
    assert crossings(vertices, both) == slow > 10


def pierces(one, two):
    """Whether a side of triangle ``one`` (3, 3) passes through triangle ``two``, by solving for the
    point.
    """
    for k in range(3):
        p, q = one[k], one[(k + 1) % 3]
        sides = np.stack([q - p, two[0] - two[1], two[0] - two[2]], 1)
        if abs(np.linalg.det(sides)) < 1e-15:  # parallel
            continue
        t, u, v = np.linalg.solve(sides, two[0] - p)
        if 0 < t < 1 and u > 0 and v > 0 and u + v < 1:
            return True
    return False
