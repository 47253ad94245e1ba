"""The networks that PolyFit is compared with, each against a slow reference."""

import pytest
import torch
from scipy.spatial import cKDTree

from polyfit import InputError
from polyfit.baselines import DGCNN, AtlasNet, PointNet, chamfer, normalised
from polyfit.baselines.regressors import edge_convolution, nearest
from polyfit.jets import rotation_matrix
from polyfit.network import write_weights


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def lively(network):
    with torch.no_grad():
        for p in network.parameters():
            p.add_(0.1 * torch.randn_like(p))
    return network.eval()


def test_edge_convolution_is_that_of_the_paper():
    centre, edge = torch.nn.Linear(5, 7), torch.nn.Linear(5, 7)
    x = torch.randn(2, 12, 5)
    neighbours = nearest(x, 4)
    with torch.no_grad():
        got = edge_convolution(x, neighbours, centre, edge)
        for b in range(2):
            for i in range(12):
                distances = (x[b] - x[b, i]).norm(dim=1)
                near = distances.argsort()[:4]
                assert set(neighbours[b, i].tolist()) == set(near.tolist())
                edges = torch.stack(
                    [torch.relu(centre(x[b, i]) + edge(x[b, j] - x[b, i])) for j in near]
                )
                assert got[b, i].numpy() == pytest.approx(edges.amax(0).numpy(), abs=1e-5)


@pytest.mark.parametrize("kind", [PointNet, DGCNN])
def test_regressors_do_not_see_the_order_of_points(kind):
    network = lively(kind(3))
    x = torch.randn(4, 50, 3)
    with torch.no_grad():
        a, b = network.alpha(x), network.alpha(x[:, torch.randperm(50)])
    assert a.shape == (4, 10) and a.std(0).min() > 1e-3
    assert b.numpy() == pytest.approx(a.numpy(), abs=1e-5)


@pytest.mark.parametrize("kind", [PointNet, DGCNN])
def test_regressors_see_patches_in_their_frames(kind):
    network = lively(kind(3)).double()
    points = torch.randn(6, 40, 3, dtype=torch.float64) * torch.tensor([1, 0.6, 0.2])
    Q = rotation_matrix(torch.randn(6, 4, dtype=torch.float64))
    with torch.no_grad():
        a, b = network(points), network(2 * points @ Q.mT + 3)
    assert b.jet.alpha.numpy() == pytest.approx(a.jet.alpha.numpy(), abs=1e-8)


def test_charts_are_networks_of_their_own():
    network = lively(AtlasNet(charts=3, latent=6, widths=(8, 5)))
    points, uv = torch.randn(2, 30, 3), torch.rand(3, 4, 2)
    with torch.no_grad():
        code = network.encode(points)
        got = network.decode(code, uv)
        assert got.shape == (2, 3, 4, 3)
        for k in range(3):
            for b in range(2):
                x = torch.cat([code[b].expand(4, 6), uv[k]], 1)
                for i in range(3):
                    x = x @ network.weights[i][k] + network.biases[i][k]
                    x = torch.relu(x) if i < 2 else x
                assert got[b, k].numpy() == pytest.approx(x.numpy(), abs=1e-5)
        corners = network.grid(code, 3)[:, :, [0, 8]]
        assert corners.numpy() == pytest.approx(
            network.decode(code, torch.tensor([[0.0, 0], [1, 1]]).expand(3, 2, 2)).numpy(), abs=1e-6
        )


def test_chamfer_is_that_of_a_tree_and_its_gradient_that_of_differences():
    a, b = torch.rand(2, 40, 3, dtype=torch.float64), torch.rand(2, 30, 3, dtype=torch.float64)
    for k in range(2):
        to_b, to_a = cKDTree(b[k]).query(a[k])[0], cKDTree(a[k]).query(b[k])[0]
        assert chamfer(a, b)[k].item() == pytest.approx(
            (to_b**2).mean() + (to_a**2).mean(), rel=1e-9
        )
    assert torch.autograd.gradcheck(chamfer, (a.requires_grad_(), b.requires_grad_()))
    assert chamfer(a, a).detach().numpy() == pytest.approx(0, abs=1e-12)


def test_normalised_points_touch_the_unit_sphere():
    points = 5 * torch.rand(3, 50, 3) + 2
    x, centre, scale = normalised(points)
    assert x.norm(dim=-1).amax(1).numpy() == pytest.approx(1, abs=1e-6)
    assert (x.amax(1) + x.amin(1)).numpy() == pytest.approx(0, abs=1e-5)
    assert (x * scale + centre).numpy() == pytest.approx(points.numpy(), abs=1e-5)
    with pytest.raises(InputError, match="not finite"):
        normalised(points * torch.nan)


def test_weights_come_back_and_others_are_refused(tmp_path):
    x = torch.randn(3, 40, 3)
    for network in (lively(PointNet(2)), lively(DGCNN(2))):
        network.save(tmp_path / "w.safetensors")
        with torch.no_grad():
            assert torch.equal(
                type(network).load(tmp_path / "w.safetensors", 2).alpha(x), network.alpha(x)
            )
        with pytest.raises(InputError, match="for jets of order 2, not 4"):
            type(network).load(tmp_path / "w.safetensors", 4)
        with pytest.raises(InputError, match="not of atlasnet"):
            AtlasNet.load(tmp_path / "w.safetensors")
    network = lively(AtlasNet(charts=2, latent=8, widths=(8,)))
    network.save(tmp_path / "a.safetensors")
    with torch.no_grad():
        assert torch.equal(AtlasNet.load(tmp_path / "a.safetensors").encode(x), network.encode(x))
    write_weights(
        tmp_path / "old.safetensors",
        network.state_dict(),
        dict(model="atlasnet", version=0, network=network.shape),
    )
    with pytest.raises(InputError, match="version 0"):
        AtlasNet.load(tmp_path / "old.safetensors")
