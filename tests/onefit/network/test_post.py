"""Post-processing of drapes, on balls: lengths come back, and nothing is left inside."""

import numpy as np
import torch
from surfaces import ball

from onefit.body import ClosestSurface
from onefit.draping.post import DEEPEST, RADIUS, STEP, pushed_out, with_lengths
from polyfit.mesh import edges_of


def test_lengths_come_back_as_in_a_slow_reference():
    rng = np.random.default_rng(0)
    x, faces = ball(0.1, 2)
    edges = edges_of(faces.numpy())[0]
    lengths = (x[edges[:, 0]] - x[edges[:, 1]]).norm(dim=-1)
    given = x + torch.as_tensor(rng.normal(size=(3, *x.shape)) * 2e-3).float()
    found = with_lengths(given, edges, lengths, rounds=6)
    degree = np.bincount(edges.ravel())[:, None]
    for frame, after in zip(given.double().numpy(), found.numpy()):
        before, now, ahead = frame, frame, 1.0
        for turn in range(6):
            pull = np.zeros_like(now)
            for (a, b), rest in zip(edges, lengths.numpy()):
                edge = now[b] - now[a]
                pull[a] += (1 - rest / np.linalg.norm(edge)) * edge
                pull[b] -= (1 - rest / np.linalg.norm(edge)) * edge
            if turn:
                ahead = 1 / (1 - RADIUS**2 / 2) if turn == 1 else 1 / (1 - RADIUS**2 * ahead / 4)
            before, now = now, before + ahead * (now + STEP * pull / degree - before)
        assert np.abs(now - after).max() < 1e-6
    assert torch.allclose(with_lengths(x[None], edges, lengths)[0], x, atol=1e-6)


def test_pushing_out_of_a_sphere():
    (body, faces), (x, cloth) = ball(0.1), ball(0.1, 3)
    body, x = body[None], x[None]
    x[:, ::7] *= 0.95
    out = pushed_out(x, cloth, body, faces)
    distance = ClosestSurface(body[0], faces).distances(out, body)
    assert distance.min() > 0.0025 and distance.max() < 0.02


def test_pushing_out_finds_deep_vertices_from_their_neighbours():
    (body, faces), (x, cloth) = ball(0.1), ball(0.103, 5)
    body, x = body[None], x[None]
    x = x - 0.4 * x * torch.exp(
        -((x / 0.103 - torch.tensor([0, 0, 1.0])).square().sum(-1, keepdim=True) / 0.5**2)
    )
    surface = ClosestSurface(body[0], faces)
    before = surface.distances(x, body)
    assert before.min() < -0.03
    out = pushed_out(x, cloth, body, faces)
    assert surface.distances(out, body).min() > 0
    # as when every vertex is asked how deep it is
    asked = pushed_out(x, cloth, body, faces, reach=DEEPEST)
    assert torch.allclose(asked, out, atol=1e-5)


def test_large_faces_are_pushed_out_of_what_passes_between_their_vertices():
    body, faces = ball(0.05)
    x = torch.tensor([[-0.2, -0.2, 0.04], [0.2, -0.2, 0.04], [0.0, 0.2, 0.04]])
    out = pushed_out(x[None], torch.tensor([[0, 1, 2]]), body[None], faces)[0]
    shares = torch.as_tensor(np.random.default_rng(0).dirichlet(np.ones(3), 2000)).float()
    distance = ClosestSurface(body, faces)
    assert distance(shares @ x, 0.1).distance.min() < -0.009
    assert distance(shares @ out, 0.1).distance.min() > -0.002
