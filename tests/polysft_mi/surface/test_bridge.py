"""torch and Dr.Jit joined: PolyFit's template, and gradients across the bridge in both directions
against finite differences.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
import torch

import polyfit
from polyfit import jets
from polyfit.network import PolyFit, SpatialTransformer
from polysft_mi import bridge, capture
from polysft_mi.errors import InputError
from polysft_mi.objective.problem import Problem
from polysft_mi.scene import experiment as scene
from polysft_mi.surface.patch import JetAtlas

RNG = np.random.default_rng(2)


@pytest.fixture(scope="module")
def network():
    """PolyFit whose turns are slight, so that one of them, and not the PCA frame, is kept for the
    sheet.
    """
    torch.manual_seed(0)
    model = PolyFit(4, SpatialTransformer(widths=(8, 16), hidden=8, points=64)).eval()
    with torch.no_grad():
        model.stn.head[-1].bias.mul_(torch.tensor([0.3, 0.3, 0.3, 1]).repeat(5))
    return model


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """A small scene whose rendering is a problem's, and a bent sheet in it: points (N, 3)
    float32.
    """
    folder = tmp_path_factory.mktemp("bridge")
    truth = synthetic.cloth(folder / "sequence", frames=2, bend=6.0)
    path, _ = capture.prepare_folder(str(truth.folder), out=str(folder / "scene"))
    experiment = scene.load(path, {})
    sequence = experiment.sequence()
    return Problem(experiment, sequence), torch.as_tensor(truth.vertices[1], dtype=torch.float32)


def weights_of(network):
    return torch.nn.utils.parameters_to_vector(network.parameters()).detach()


def gradient_and_numeric(loss, network, direction, h):
    """The derivative of ``loss()`` along ``direction`` in the network's weights, by autograd and by
    central differences.
    """
    start = weights_of(network)
    network.zero_grad()
    loss().backward()
    gradient = torch.cat(
        [
            (torch.zeros_like(p) if p.grad is None else p.grad).flatten()
            for p in network.parameters()
        ]
    )
    ends = []
    with torch.no_grad():
        for sign in (1, -1):
            torch.nn.utils.vector_to_parameters(start + sign * h * direction, network.parameters())
            ends.append(float(loss()))
        torch.nn.utils.vector_to_parameters(start, network.parameters())
    return float(gradient @ direction), (ends[0] - ends[1]) / (2 * h)


def test_polyfit_sets_up_the_template(bent, network):
    problem, points = bent
    t = problem.template
    made = bridge.template(network, points.numpy(), t.faces, t.texcoords)
    (turn,) = made.rotation
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    frame = network(points[None]).frame[0]
    assert turn == pytest.approx(frame.R.detach().numpy(), abs=1e-5)
    patch = JetAtlas(made)
    assert np.abs(np.array(patch.vertices(patch.rest())).T - points.numpy()).max() < 2e-4
    assert made.residual_max < 2e-4


def test_a_rendering_loss_reaches_the_network(bent, network):
    problem, points = bent
    render = bridge.rendering(problem)
    beyond = (points[:, 0] - 0.03).clamp(
        min=0
    )  # bent up there by 80 degrees: its jet depends on the frame, and so on the network
    rough = points + beyond[:, None] * torch.tensor(
        [np.cos(1.4) - 1, 0, -np.sin(1.4)], dtype=torch.float32
    )
    weight = torch.as_tensor(
        synthetic.to_linear(255 * RNG.random((problem.height, problem.width, 3))),
        dtype=torch.float32,
    )

    def loss():
        rgb, alpha = render(bridge.surface(network, rough[None])[0])
        return (weight * rgb).sum() + (weight[..., 0] * alpha).sum()

    pca = polyfit.CanonicalFrame.from_points(rough)
    assert (network.frame(rough[None])[0].R - pca.R).abs().max() > 1e-3
    network.zero_grad()
    loss().backward()
    direction = torch.cat(
        [
            (torch.zeros_like(p) if p.grad is None else p.grad).flatten()
            for p in network.parameters()
        ]
    )
    direction /= direction.norm()
    found, numeric = gradient_and_numeric(loss, network, direction, 3e-3)
    assert found > 1 and found == pytest.approx(numeric, rel=0.05)


def test_rendering_in_torch_is_the_problems(bent):
    problem, points = bent
    rgb, alpha = bridge.rendering(problem)(points)
    expected, mask = problem.placed.image(mi.Point3f(points.numpy().T))
    assert np.abs(rgb.numpy() - np.array(expected)).max() == 0
    assert np.abs(alpha.numpy() - np.array(mask)[..., 0]).max() == 0
    assert alpha.sum() > 100


def test_a_torch_loss_reaches_alpha(bent, network):
    """The loss is one of coefficients that torch fits to the surface that Dr.Jit makes of alpha."""
    problem, points = bent
    patch = JetAtlas(
        bridge.template(network, points.numpy(), problem.template.faces, problem.template.texcoords)
    )
    weight = torch.as_tensor(RNG.normal(size=(2, 15)), dtype=torch.float32)

    @bridge.in_torch
    def loss(vertices):
        frame = polyfit.CanonicalFrame.from_points(points.to(vertices.device))
        alpha, w = jets.fit(frame.to_chart(vertices), 4).alpha, weight.to(vertices.device)
        return (w[0] * alpha).sum() + 0.1 * (w[1] * alpha**2).sum()

    def value(delta):
        unknowns = patch.rest()
        unknowns.delta_alpha = delta
        placed = patch.vertices(unknowns)
        return loss(mi.TensorXf(dr.ravel(placed), (dr.width(placed), 3)))

    start = 0.05 * RNG.normal(size=15)
    delta = mi.Float(start.astype(np.float32))
    dr.enable_grad(delta)
    dr.backward(value(delta))
    gradient, direction, h = np.array(dr.grad(delta)), RNG.normal(size=15), 1e-2
    ends = [
        float(
            np.ravel(np.array(value(mi.Float((start + sign * h * direction).astype(np.float32)))))[
                0
            ]
        )
        for sign in (1, -1)
    ]
    assert np.linalg.norm(gradient) > 0.1
    assert gradient @ direction == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=0.01)


def test_gradient_of_the_deformed_patch_in_torch(bent, network):
    problem, points = bent
    patch = JetAtlas(
        bridge.template(network, points.numpy(), problem.template.faces, problem.template.texcoords)
    )
    vertices, N = bridge.deformed(patch), len(points)
    unknowns = [
        0.05 * torch.randn(n, generator=torch.Generator().manual_seed(k))
        for k, n in enumerate((15, N, N, N, 4, 3))
    ]
    unknowns[4] = unknowns[4] + torch.tensor([0, 0, 0, 1.0])
    weight = torch.as_tensor(RNG.normal(size=(N, 3)), dtype=torch.float32)
    unknowns = [x.requires_grad_() for x in unknowns]
    (weight * vertices(*unknowns)).sum().backward()
    for k, x in enumerate(unknowns):
        direction, h = torch.as_tensor(RNG.normal(size=x.shape), dtype=torch.float32), 1e-2
        ends = []
        for sign in (1, -1):
            moved = [y.detach() for y in unknowns]
            moved[k] = moved[k] + sign * h * direction
            ends.append(float((weight * vertices(*moved)).sum()))
        assert float(x.grad @ direction) == pytest.approx(
            (ends[0] - ends[1]) / (2 * h), rel=0.02, abs=2e-3
        ), k


def test_other_shapes_are_named(bent, network):
    """Mitsuba reads a transposed array as it comes, and past the end of a short one."""
    problem, points = bent
    N, t = len(points), problem.template
    render, deformed = bridge.rendering(problem), bridge.deformed(problem.patch)
    for wrong in points[:-1], points.T, points[None], points.flatten(), points.numpy():
        with pytest.raises(InputError, match=rf"vertices: .*of shape \({N}, 3\) is needed"):
            render(wrong)
    rest = [torch.as_tensor(np.array(x)) for name, x in problem.patch.rest().items()][:6]
    assert deformed(*rest).shape == (N, 3)
    with pytest.raises(InputError, match="5 unknowns; delta_alpha, .*, translation are needed"):
        deformed(*rest[:5])
    with pytest.raises(InputError, match=r"rotation: .*\(3,\); a tensor of torch of shape \(4,\)"):
        deformed(*rest[:4], rest[5], rest[5])
    for wrong in points, points.numpy()[None]:
        with pytest.raises(InputError, match=r"a tensor of torch \(patches, points, 3\) is needed"):
            bridge.surface(network, wrong)
    with pytest.raises(InputError, match=rf"uv of shape \(5, 2\); \({N}, 2\) is needed"):
        bridge.template(network, points.numpy(), t.faces, np.zeros((5, 2)))
    with pytest.raises(InputError, match="template: faces name vertices 1 to"):
        bridge.template(network, points.numpy(), t.faces + 1, t.texcoords)
