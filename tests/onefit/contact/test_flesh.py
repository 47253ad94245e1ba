"""Flesh that yields: two balls as trunk and arm, and Anny's body."""

import numpy as np
import pytest
import torch
from surfaces import ball

from onefit.body import AnnyBody, Body, skinning
from onefit.body.skeleton import INDEX, JOINTS
from onefit.contact import Flesh
from onefit.contact.flesh import DEEPEST
from onefit.motion import Motion

ROOM = 0.003
TRUNK, ARM = 0.1, 0.05  # [m] radii of the balls


@pytest.fixture(scope="module")
def balls():
    (one, faces), (other, more) = ball(TRUNK), ball(ARM)
    weights = torch.zeros(len(one) + len(other), len(JOINTS))
    weights[: len(one), INDEX["spine2"]] = 1
    weights[len(one) :, INDEX["left_elbow"]] = 1
    joints = torch.zeros(len(JOINTS), 3)
    apart = torch.cat([one, other + torch.tensor([0.5, 0, 0])])
    return Body(
        apart, torch.cat([faces, more + len(one)]), weights, joints, joints, torch.zeros(0), "balls"
    )


def at(balls, distance):
    """The balls (V, 3) with their middles at a ``distance`` [m]."""
    arm = balls.blend_weights[:, INDEX["left_elbow"]] == 1
    return balls.vertices + arm[:, None] * torch.tensor([distance - 0.5, 0, 0]), arm


@pytest.mark.parametrize("overlap", [-0.002, 0.0, 0.006])
def test_both_skins_draw_back_by_half_of_what_is_missing(balls, overlap):
    x, arm = at(balls, TRUNK + ARM - overlap)
    flesh = Flesh(balls, ROOM)
    ways = torch.as_tensor(flesh.missing(x.double().numpy()))
    # the signed distance from the other ball, and the way from its middle
    away = x - torch.where(arm[:, None], 0, 1) * torch.tensor([TRUNK + ARM - overlap, 0, 0])
    gap = away.norm(dim=-1) - torch.where(arm, TRUNK, ARM)
    expected = 0.5 * (ROOM - gap).clamp(min=0)
    assert (ways.norm(dim=-1) - expected).abs().max() < 2e-4  # the balls have faces of 6 mm
    pushed = expected > 5e-4
    along = (torch.nn.functional.normalize(away, dim=-1) * ways).sum(-1) / ways.norm(dim=-1)
    assert pushed.any() and along[pushed].min() > 0.99

    out = flesh(x[None])[0]
    assert np.linalg.norm(flesh.missing(out.double().numpy()), axis=1).max() < 0.1 * expected.max()
    far = gap > 0.03
    assert torch.equal(out[far], x[far])


def test_what_has_room_does_not_move(balls):
    x = torch.stack([at(balls, TRUNK + ARM + gap)[0] for gap in (0.004, 0.3)])
    assert torch.equal(Flesh(balls, ROOM)(x), x)


def test_what_lies_too_deep_does_not_yield(balls):
    x = at(balls, 0.0)[0]  # the small ball in the middle of the large one
    assert TRUNK - ARM > DEEPEST
    assert torch.equal(Flesh(balls, ROOM)(x[None])[0], x)


def test_the_body_at_rest_is_one_skin_and_an_arm_at_the_side_gets_room():
    model = AnnyBody()
    body = model.body()
    flesh = Flesh(body, ROOM)
    assert torch.equal(flesh(body.vertices[None])[0], body.vertices)
    motion = Motion.generate("box", seconds=0.5, seed=1_000_005)
    transforms = skinning.transforms(body, motion.poses, motion.translation)
    bodies = skinning.skin(body.vertices, body.blend_weights, transforms)
    missing = lambda x: np.linalg.norm(flesh.missing(x.double().numpy()), axis=1).max()
    before = [missing(x) for x in bodies]
    last = int(np.argmax(before))
    out = flesh(bodies)
    assert before[last] > 0.001
    assert missing(out[last]) < 0.2 * before[last]
    assert (out - bodies).norm(dim=-1).max() < 0.01
