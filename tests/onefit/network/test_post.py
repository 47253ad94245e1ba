"""Post-processing of drapes, on balls: cloth keeps its motion, lengths come back, and nothing is
left inside.
"""

import numpy as np
import pytest
import torch
from surfaces import ball

from onefit.body import ClosestSurface
from onefit.contact.points import samples
from onefit.draping import post
from onefit.draping.post import CONTACT, DRAG, NEAR, PULL, RADIUS, TOUCHING, PostProcessing
from polyfit.mesh import edges_of


def lengths_of(x, faces):
    """Edges (E, 2) and their lengths (E,)."""
    edges = edges_of(faces.numpy())[0]
    return edges, (x[edges[:, 0]] - x[edges[:, 1]]).norm(dim=-1)


def processing(x, faces, pull=0.0, surfaces=()):
    return PostProcessing(x, faces, *lengths_of(x, faces), np.full(len(x), pull), surfaces)


def push_out(process, x, goal, surface):
    """Vertices ``x`` (N, 3) are pushed out of a body's surface, as :class:`PostProcessing` does."""
    process.skin.look(x, surface, goal)
    process.skin.push_out(x, surface)


def pushed_out(x, cloth, body, faces):
    """The same of a body (V, 3)."""
    x = x.clone()
    push_out(processing(x, cloth), x, x.clone(), ClosestSurface(body, faces))
    return x


@pytest.mark.parametrize("radius", [0.01, 0.098])
def test_lengths_come_back_as_in_a_slow_reference(radius):
    """Beside a body far away, and around one."""
    rng = np.random.default_rng(0)
    x, faces = ball(0.1, 2)
    (body, body_faces), (edges, lengths) = ball(radius), lengths_of(x, faces)
    degree = np.bincount(edges.ravel())[:, None]
    given = x + torch.as_tensor(rng.normal(size=x.shape) * 2e-3).float()
    surface, process, found = ClosestSurface(body, body_faces), processing(x, faces), given.clone()
    process.skin.look(found, surface, found.clone())
    touched = surface(given, TOUCHING).face
    assert (touched >= 0).any() == (radius > 0.05)
    first, second, third = body[body_faces[touched]].double().unbind(1)
    normal = torch.linalg.cross(second - first, third - first)
    normal /= normal.norm(dim=-1, keepdim=True)
    before, now, ahead = given.double().numpy(), given.double().numpy(), 1.0
    for turn in range(6):
        pull = np.zeros_like(now)
        for (a, b), rest in zip(edges, lengths.numpy()):
            edge = now[b] - now[a]
            too_long = (edge @ edge - rest**2) / (edge @ edge + rest**2)
            pull[a] += too_long * edge
            pull[b] -= too_long * edge
        if turn:
            ahead = 1 / (1 - RADIUS**2 / 2) if turn == 1 else 1 / (1 - RADIUS**2 * ahead / 4)
        before, now = now, before + ahead * (now + pull / degree - before)
        height = ((torch.as_tensor(now) - first) * normal).sum(-1)
        missing = (CONTACT.clearance - height).clamp(min=0) * (touched >= 0)
        now = now + (missing[:, None] * normal).numpy()
    process.restore_lengths(found, surface, rounds=6)
    assert np.abs(now - found.numpy()).max() < 1e-6
    far, same = ClosestSurface(body + 1, body_faces), x.clone()
    process.skin.look(same, far, same.clone())
    process.restore_lengths(same, far)
    assert torch.allclose(same, x, atol=1e-6)


def test_tight_cloth_stays_in_front_of_the_skin_and_goes_with_it():
    """Cloth around a ball, too narrow for it by a tenth, while the ball moves."""
    way = torch.tensor([0.02, 0.0, 0.0])
    (body, faces), (x, cloth) = ball(0.1, 4), ball(0.102, 4)
    edges, lengths = lengths_of(x, cloth)
    process = PostProcessing(x, cloth, edges, 0.9 * lengths, np.zeros(len(x)))
    surface, held, free = ClosestSurface(body, faces), x + way, x + way
    for other, found in ((surface, held), (ClosestSurface(body + 1, faces), free)):
        process.skin.look(x, other, x.clone())  # it touches the one, and not the other
        surface.follow(body + way)
        process.restore_lengths(found, surface)
    assert surface(held, 0.1).distance.min() > 0.9 * CONTACT.clearance
    assert surface(free, 0.1).distance.max() < 0


def test_cloth_keeps_its_motion_and_is_pulled_to_the_drape():
    x, faces = ball(0.1, 1)
    before, was = x + torch.tensor([0.03, 0.0, 0.0]), x
    slowed = torch.tensor([0.03 / (1 + DRAG * 0.03), 0.0, 0.0])
    free, drawn = x + 0.5, x + 0.5
    processing(x, faces).move(free, before, was, 1 / 30)
    assert torch.allclose(free, before + slowed, atol=1e-6)
    processing(x, faces, pull=200.0).move(drawn, before, was, 1 / 30)
    acceleration = (drawn - before - slowed) * 900
    assert torch.allclose(acceleration, 200 * (x + 0.5 - drawn), rtol=1e-3)


def test_a_swing_makes_no_wrinkles_and_a_drape_keeps_its_own():
    x, faces = ball(0.1, 3)
    rough = torch.as_tensor(np.random.default_rng(0).normal(size=x.shape) * 1e-3).float()
    smooth, wrinkled = x.clone(), x + rough
    processing(x, faces).move(smooth, x + rough, x + rough, 1 / 30)
    processing(x, faces).move(wrinkled, x + rough, x + rough, 1 / 30)
    assert (smooth - x).norm() < 0.4 * rough.norm()
    assert torch.allclose(wrinkled, x + rough, atol=1e-7)


def test_cloth_stays_on_the_side_of_the_body_on_which_the_drape_is():
    (body, faces), (x, cloth) = ball(0.05), ball(0.02, 1)
    goal = x + torch.tensor([0.2, 0.0, 0.0])
    behind = x - torch.tensor([0.2, 0.0, 0.0])  # the body has passed through the cloth
    process, surface = processing(x, cloth), ClosestSurface(body, faces)
    push_out(process, behind, goal, surface)
    assert (behind[:, 0] > 0.03).all() and surface(behind, 0.1).distance.min() > 0.002
    before = goal - torch.tensor([0.1, 0.0, 0.0])  # nothing lies between
    same = before.clone()
    push_out(process, same, goal, surface)
    assert torch.equal(same, before)


def test_a_drape_swings_on_and_comes_to_rest():
    (body, faces), (x, cloth) = ball(0.02), ball(0.1, 2)
    guide = x[None].repeat(120, 1, 1)
    guide[:15, :, 0] += torch.linspace(-0.3, 0, 15)[:, None]  # it comes, and stops
    surfaces = [ClosestSurface(body - 1, faces) for _ in range(2)]  # far away
    process = processing(x, cloth, PULL, surfaces)
    bodies = body[None].expand(120, -1, -1) - 1
    whole = process(guide, bodies, 30.0)
    out = whole.mean(1)[:, 0]
    assert out[14] < -0.02 and out.max() > 0.02  # late, then beyond
    assert abs(out[-1]) < 0.005
    firm = processing(x, cloth, 1e6, surfaces)(guide, bodies, 30.0)
    assert torch.allclose(firm, guide, atol=1e-4)
    first = process(guide[:20], bodies[:20], 30.0)  # in two parts
    second = process(guide[20:], bodies[20:], 30.0, first[-2:])
    assert torch.equal(torch.cat([first, second]), whole)


def test_skin_and_waistband_hold_the_cloth():
    (body, faces), (x, _) = ball(0.1), ball(0.1, 3)
    where = torch.stack([x[0] * (1 + NEAR / 0.1), x[0] * 9, x[0], x[0] * 1.5])
    found = post.pull(where.numpy(), Standard(body, faces), np.array([0, 0, 0, 1]))
    assert found[0] == pytest.approx(2 * PULL, rel=0.05)
    assert found[1] == pytest.approx(PULL, rel=0.05)
    assert found[2] == pytest.approx(PULL * (1 + (NEAR / CONTACT.clearance) ** 2), rel=0.05)
    assert found[3] > 1e5


class Standard:
    def __init__(self, vertices, faces):
        self.vertices, self.faces = vertices, faces


def test_pushing_out_of_a_sphere():
    (body, faces), (x, cloth) = ball(0.1), ball(0.1, 3)
    x[::7] *= 0.95
    out = pushed_out(x, cloth, body, faces)
    distance = ClosestSurface(body, faces)(out, 0.1).distance
    assert distance.min() > 0.0025 and distance.max() < 0.02


def test_pushing_out_finds_deep_vertices_from_their_neighbours():
    (body, faces), (x, cloth) = ball(0.1), ball(0.103, 5)
    x = x - 0.4 * x * torch.exp(
        -((x / 0.103 - torch.tensor([0, 0, 1.0])).square().sum(-1, keepdim=True) / 0.5**2)
    )
    surface = ClosestSurface(body, faces)
    assert surface(x, 0.1).distance.min() < -0.03
    out = pushed_out(x, cloth, body, faces)
    assert surface(out, 0.1).distance.min() > 0


def test_large_faces_are_pushed_out_of_what_passes_between_their_vertices():
    body, faces = ball(0.05)
    x = torch.tensor([[-0.2, -0.2, 0.04], [0.2, -0.2, 0.04], [0.0, 0.2, 0.04]])
    out = pushed_out(x, torch.tensor([[0, 1, 2]]), body, faces)
    shares = torch.as_tensor(np.random.default_rng(0).dirichlet(np.ones(3), 2000)).float()
    distance = ClosestSurface(body, faces)
    assert distance(shares @ x, 0.1).distance.min() < -0.009
    assert distance(shares @ out, 0.1).distance.min() > 0


def test_what_a_push_brings_to_the_body_is_looked_at_again():
    (one, faces), (x, cloth) = ball(0.1), ball(0.102, 3)
    body = torch.cat([one, one + torch.tensor([0.0, 0.0, 0.208])])  # 8 mm between two balls
    surface = ClosestSurface(body, torch.cat([faces, faces + len(one)]))
    x[x[:, 2].argmax(), 2] = 0.05  # its push takes its neighbours along, into the other ball
    process = processing(x, cloth)
    at = samples(x.numpy(), cloth.numpy(), CONTACT.spacing)
    corners, weights = (torch.as_tensor(a) for a in at)
    points = lambda: surface((weights[..., None] * x[corners]).sum(1), CONTACT.reach).distance
    assert points().min() < -0.01
    push_out(process, x, x.clone(), surface)
    assert points().min() > 0


def test_a_point_of_an_edge_is_looked_at_once():
    x = 0.04 * torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    corners, weights = samples(x.numpy(), faces, 0.03)
    points = (weights[..., None] * x.numpy()[corners]).sum(1)
    known = {tuple(point) for point in np.round(points, 6)}
    assert len(known) == len(points) and (0.02, 0.02, 0.0) in {tuple(k) for k in known}
