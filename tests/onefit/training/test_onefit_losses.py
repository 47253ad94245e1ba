import pytest
import torch

from onefit.objective import Weights, losses
from polyfit.errors import InputError

G = torch.Generator().manual_seed(3)


def random(*shape):
    return torch.randn(*shape, generator=G, dtype=torch.float64)


def gradient_agrees(function, x, tolerance=1e-6):
    """The gradient of ``function`` at x against central finite differences, entry by entry."""
    x = x.clone().requires_grad_()
    (found,) = torch.autograd.grad(function(x), x)
    step, flat = 1e-6, x.detach().flatten()
    expected = torch.empty_like(flat)
    for k in range(len(flat)):
        ends = []
        for sign in (1, -1):
            moved = flat.clone()
            moved[k] += sign * step
            ends.append(function(moved.view_as(x)))
        expected[k] = (ends[0] - ends[1]) / (2 * step)
    error = (found.flatten() - expected).abs().max()
    assert error <= tolerance * max(1.0, float(expected.abs().max())), (error, expected.abs().max())
    assert expected.abs().max() > 0


def test_collision_counts_depth_below_epsilon():
    # three points for 1e-5 m^2 each: 1 cm away, on the surface, 6 mm inside; epsilon 4 mm
    distance = torch.tensor([[0.01], [0.0], [-0.006]])
    area = torch.full((3,), losses.POINT_AREA)
    assert float(losses.collision(distance, area, 0.004)) == pytest.approx(0.004**2 + 0.01**2)
    # twice the points for half the area each are the same cloth
    assert float(
        losses.collision(distance.repeat(2, 1), area.repeat(2) / 2, 0.004)
    ) == pytest.approx(0.004**2 + 0.01**2)
    gradient_agrees(
        lambda d: losses.collision(d, torch.ones(6, dtype=torch.float64), 0.3), random(6, 2)
    )


def test_extension_grows_with_the_epochs_and_where_the_body_is():
    distance = torch.tensor([0.02, 0.0, -1.0])
    assert losses.extension(distance, 0, 0.004).tolist() == [1, 1, 1]
    assert losses.extension(distance, 50, 0.004).tolist() == pytest.approx(
        [1, 1 + 0.004 * 50, 1 + 0.01 * 50]
    )
    assert torch.equal(
        losses.extension(distance, 100, 0.004), losses.extension(distance, 1000, 0.004)
    )


def test_inextensibility_of_an_isometry_and_of_a_stretch():
    u, v = torch.tensor([[[1.0, 0, 0]]]), torch.tensor([[[0.0, 2, 0]]])
    turn = torch.linalg.qr(random(3, 3).float())[0]
    rest, one, s = losses.metric((u, v)), torch.ones(1, 1), torch.ones(1)
    assert float(
        losses.inextensibility(rest, losses.metric((u @ turn, v @ turn)), one, s)
    ) == pytest.approx(0, abs=1e-5)
    # 10 % along u: E from 1 to 1.21
    assert float(
        losses.inextensibility(rest, losses.metric((1.1 * u, v)), one, s)
    ) == pytest.approx(losses.METRIC_FACTOR * (0.21), rel=1e-4)
    # shear: F from 0 to 0.2, and it stands twice in the matrix
    assert float(
        losses.inextensibility(rest, losses.metric((u, v + 0.2 * u)), one, s)
    ) == pytest.approx(losses.METRIC_FACTOR * (0.4 + 0.04), rel=1e-4)
    # where the metric may be larger by k_ext, that much costs nothing
    assert float(losses.inextensibility(rest, 1.3 * rest, 1.3 * one, s)) == pytest.approx(
        0, abs=1e-6
    )
    assert float(
        losses.inextensibility(rest, losses.metric((1.1 * u, v)), one, 2 * s)
    ) == pytest.approx(losses.METRIC_FACTOR * (0.21 / 4), rel=1e-4)
    T = losses.metric((random(4, 2, 3), random(4, 2, 3)))
    weights = random(4, 2).abs() + 1
    gradient_agrees(
        lambda x: losses.inextensibility(
            T, losses.metric(x.unbind(0)), weights, torch.full((4,), 0.7, dtype=torch.float64)
        ),
        random(2, 4, 2, 3),
    )


def test_skinned_tangents_are_derivatives_of_skinned_points():
    # a curve through the rest space with blend weights that change along it, posed: its derivative
    # by finite differences
    transforms = random(2, 3, 3, 4)
    a, b = random(3), random(3)
    point = lambda t: a * torch.sin(t) + b * t * t
    weight = lambda t: torch.softmax(torch.stack([t, t * t, torch.sin(t)]), 0)
    t = torch.tensor(0.4, dtype=torch.float64)

    def posed(t):
        x, w = point(t), weight(t)
        maps = (w[:, None, None] * transforms).sum(1)
        return (maps[..., :3] @ x) + maps[..., 3]

    step = 1e-6
    slope = lambda f: (f(t + step) - f(t - step)) / (2 * step)
    w = torch.stack([weight(t), slope(weight), 2 * slope(weight)])[None]
    points = point(t).expand(1, 2, 3)
    tangent = slope(point).expand(1, 2, 3)
    u, v = losses.skinned_tangents(points, (tangent, 2 * tangent), w, transforms)
    assert torch.allclose(u[0], slope(posed), atol=1e-8)
    assert torch.allclose(v[0], 2 * slope(posed), atol=1e-8)
    gradient_agrees(
        lambda x: losses.skinned_tangents(x[:1], (x[1:2], x[2:]), w, transforms)[0].square().sum(),
        random(3, 2, 3),
    )


def test_mesh_inextensibility():
    rest = torch.full((4, 1), 0.01)
    assert float(
        losses.mesh_inextensibility(rest * torch.tensor([[1.0], [1.1], [0.9], [1.0]]), rest)
    ) == pytest.approx(2e-6, rel=1e-4)
    gradient_agrees(
        lambda x: losses.mesh_inextensibility(x, torch.ones(5, 2, dtype=torch.float64)),
        random(5, 2).abs() + 0.5,
    )


def test_boundary_of_positions_and_normals():
    apart = torch.zeros(2, 1, 1, 3)
    apart[0, 0, 0, 0] = 0.002
    up, side = torch.tensor([0.0, 0, 1]), torch.tensor([1.0, 0, 0])
    same = torch.stack([up, up])[:, None, None]
    assert float(losses.boundary(apart, same, 5e3, 7.0)) == pytest.approx(5e3 * 4e-6)
    assert float(
        losses.boundary(0 * apart, torch.stack([up, side])[:, None, None], 5e3, 7.0)
    ) == pytest.approx(7.0)
    n = torch.nn.functional.normalize(random(2, 3, 2, 3), dim=-1)
    gradient_agrees(lambda x: losses.boundary(x, n, 1.0, 1.0), random(2, 3, 2, 3))
    gradient_agrees(
        lambda x: losses.boundary(n, losses.normals((x[:2], x[2:])), 0.0, 1.0), random(4, 3, 2, 3)
    )


def test_gravity_and_inertia():
    mass = torch.tensor([0.1, 0.3])
    height = torch.tensor([[1.0], [2.0]])
    assert float(losses.gravity(height, mass)) == pytest.approx(9.81 * 0.7)
    # 1 m/s^2 for 1/30 s: half m a^2 dt^2
    x = lambda t: torch.tensor([0.5 * t * t, 0.0, 0.0]).expand(2, 1, 3)
    dt = 1 / 30
    assert float(losses.inertia(x(2 * dt), x(dt), x(0.0), mass, dt)) == pytest.approx(
        0.5 * 0.4 * dt * dt, rel=1e-4
    )
    # at constant velocity there is none
    move = torch.tensor([0.1, 0.2, 0.3]).expand(2, 1, 3)
    assert float(losses.inertia(2 * move, move, 0 * move, mass, dt)) == pytest.approx(0, abs=1e-9)
    frames = [random(3, 2, 3) for _ in range(3)]
    for k in range(3):  # of the frame itself, and of those before it
        at = lambda x: losses.inertia(
            *frames[:k], x, *frames[k + 1 :], torch.ones(3, dtype=torch.float64), 0.5
        )
        gradient_agrees(at, frames[k])


def test_a_swing_does_not_grow_by_its_inertia():
    # cloth that follows a body's motion of three a second by a fifth: following it further costs
    # more, for the past moves along
    t = torch.arange(300, dtype=torch.float64) / 30
    motion = (2 * torch.pi * 3 * t).sin()[:, None, None].expand(-1, 1, 3)
    size = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    x = (size * motion).transpose(0, 1)  # (1, T, 3)
    value = losses.inertia(
        x[:, 2:], x[:, 1:-1], x[:, :-2], torch.ones(1, dtype=torch.float64), 1 / 30
    )
    assert float(torch.autograd.grad(value, size)[0]) > 0


def test_weights_are_checked():
    with pytest.raises(InputError, match="k_c = -1"):
        Weights(k_c=-1.0)
    with pytest.raises(InputError, match="epsilon = nan"):
        Weights(epsilon=float("nan"))
