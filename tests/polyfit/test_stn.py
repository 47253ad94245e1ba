"""PolyFit: the transformer of quaternions, the frames it makes, its files of weights."""

import json

import numpy as np
import pytest
import torch

from polyfit import InputError, PolyFit, jets
from polyfit.jets import CanonicalFrame, rotation_matrix
from polyfit.network import SpatialTransformer, read_weights, subsampled, write_weights
from polyfit.training import discrepancy, share_behind


def bent_sheets(count, points=200, dtype=torch.float64, depth=(0.9, 1.6), width=(0.5, 0.9)):
    """Narrow valleys z = depth |x / width|^3 in random positions: points and normals (B, P, 3). The
    deeper ones have their least spread across the valley.
    """
    g = torch.Generator().manual_seed(3)
    low, high = (torch.tensor(x, dtype=dtype) for x in zip(depth, width))
    d, w = (low + (high - low) * torch.rand(count, 2, generator=g, dtype=dtype)).unbind(-1)
    d, w = d[:, None], w[:, None] / 2
    x, y = (2 * torch.rand(count, points, 2, generator=g, dtype=dtype) - 1).unbind(-1)
    z, slope = d * x.abs() ** 3, 3 * d * x * x.abs() / w
    p = torch.stack([w * x, y, z], -1)
    n = torch.nn.functional.normalize(
        torch.stack([-slope, torch.zeros_like(slope), torch.ones_like(slope)], -1), dim=-1
    )
    q = torch.nn.functional.normalize(torch.randn(count, 4, generator=g, dtype=dtype), dim=-1)
    R = rotation_matrix(q)
    return p @ R.mT, n @ R.mT


@pytest.fixture(scope="module")
def model():
    return PolyFit.pretrained()


def random_network(**shape):
    torch.manual_seed(5)
    stn = SpatialTransformer(**shape)
    with torch.no_grad():
        stn.head[-1].weight.mul_(10)  # so that patches get turns of their own
    return stn


def test_answers_are_unit_quaternions_and_the_first_is_pca_s_frame():
    x = torch.randn(7, 100, 3)
    q = random_network()(x)
    assert q.shape == (7, 6, 4)
    assert q.norm(dim=-1).detach().numpy() == pytest.approx(1, abs=1e-6)
    assert torch.equal(q[:, 0], torch.tensor([0.0, 0, 0, 1]).expand(7, 4))
    assert q[:, 1:].std(0).min() > 1e-3


def test_the_paper_s_transformer_answers_with_one_quaternion(tmp_path):
    fresh = SpatialTransformer(turns=1, pca=False)
    with torch.no_grad():
        fresh.head[-1].weight.zero_()
    x = torch.randn(7, 100, 3)
    assert torch.allclose(fresh(x), torch.tensor([0.0, 0, 0, 1]).expand(7, 1, 4))
    model = PolyFit(3, random_network(turns=1, pca=False))
    points, _ = bent_sheets(7)
    frame, pca = model.frame(points), CanonicalFrame.from_points(points)
    turn = rotation_matrix(model.stn(pca.to_chart(points))[:, 0].double())
    assert torch.allclose(frame.R, pca.R @ turn, atol=1e-6)
    assert (turn - torch.eye(3)).abs().amax((1, 2)).min() > 1e-3
    model.save(tmp_path / "one.safetensors")
    again = PolyFit.load(tmp_path / "one.safetensors", 3)
    assert torch.allclose(again.frame(points).R, frame.R)


def test_thinned_takes_points_evenly_and_none_that_the_mask_leaves_out():
    x = torch.arange(2 * 11 * 3, dtype=torch.float32).reshape(2, 11, 3)
    assert torch.equal(subsampled(x, 20), x)
    assert torch.equal(subsampled(x, 4), x[:, [0, 2, 5, 8]])
    mask = torch.tensor(
        [[1, 0, 1, 1, 0, 1, 1, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0]], dtype=torch.bool
    )
    got = subsampled(x, 4, mask)
    for k in range(2):
        left = x[k][mask[k]]
        assert torch.equal(got[k], torch.stack([left[i * len(left) // 4] for i in range(4)]))


@pytest.mark.parametrize("shipped", [True, False])
def test_a_turned_scaled_moved_patch_has_the_same_alpha(model, shipped):
    """In float64, where a patch's own rounding does not stand in the way."""
    equivariant = (
        (PolyFit.pretrained() if shipped else PolyFit(4, random_network())).double().eval()
    )
    points, _ = bent_sheets(60)
    fit = equivariant(points)
    g = torch.Generator().manual_seed(9)
    Q = rotation_matrix(torch.randn(60, 4, generator=g, dtype=torch.float64))
    scale = 0.01 + 50 * torch.rand(60, 1, 1, generator=g, dtype=torch.float64)
    shift = 10 * torch.randn(60, 1, 3, generator=g, dtype=torch.float64)
    moved = equivariant(scale * points @ Q.mT + shift)
    assert moved.jet.alpha.detach().numpy() == pytest.approx(
        fit.jet.alpha.detach().numpy(), rel=1e-6, abs=1e-7
    )
    assert moved.frame.s.numpy() == pytest.approx((scale[:, 0, 0] * fit.frame.s).numpy(), rel=1e-9)
    assert moved.frame.R.detach().numpy() == pytest.approx(
        (Q @ fit.frame.R).detach().numpy(), abs=1e-8
    )
    uv = 0.3 * torch.randn(60, 5, 2, generator=g, dtype=torch.float64)
    surface = [f.frame.from_chart(jets.point(f.jet.alpha, uv)).detach() for f in (fit, moved)]
    assert surface[1].numpy() == pytest.approx(
        (scale * surface[0] @ Q.mT + shift).numpy(), abs=1e-5
    )


def test_float32_patches_keep_their_alpha_too(model):
    points, _ = bent_sheets(60, dtype=torch.float32)
    Q = rotation_matrix(torch.randn(60, 4, generator=torch.Generator().manual_seed(2)))
    with torch.no_grad():
        a, b = model(points), model(3 * points @ Q.mT + 1)
    assert (a.jet.alpha - b.jet.alpha).abs().amax(1).median() < 1e-3
    assert b.jet.alpha.dtype == torch.float32 and (b.jet.order == 4).all()


def test_padding_changes_nothing(model):
    points, _ = bent_sheets(12, points=90)
    padded = torch.full((12, 130, 3), torch.nan, dtype=torch.float64)
    mask = torch.zeros(12, 130, dtype=torch.bool)
    at = (
        torch.rand(12, 130, generator=torch.Generator().manual_seed(0))
        .argsort(1)[:, :90]
        .sort(1)
        .values
    )
    padded.scatter_(1, at[..., None].expand(-1, -1, 3), points)
    mask.scatter_(1, at, True)
    with torch.no_grad():
        a, b = model(points), model(padded, mask=mask)
    assert b.jet.alpha.numpy() == pytest.approx(a.jet.alpha.numpy(), rel=1e-6, abs=1e-9)


def test_points_of_no_weight_change_nothing_but_the_scale():
    """Without a transformer, which reads points whatever their weight: T, R and the jet are those
    of the points that have weight.
    """
    points, _ = bent_sheets(5, points=80)
    weights = torch.ones(5, 80, dtype=torch.float64)
    weights[:, 60:] = 0
    a, b = PolyFit(4)(points, weights=weights), PolyFit(4)(points[:, :60])
    assert a.frame.T.numpy() == pytest.approx(b.frame.T.numpy(), abs=1e-12)
    assert a.frame.R.abs().numpy() == pytest.approx(b.frame.R.abs().numpy(), abs=1e-9)
    x = [
        f.frame.from_chart(jets.point(f.jet.alpha, f.frame.to_chart(points[:, :60])[..., :2]))
        for f in (a, b)
    ]
    assert x[0].numpy() == pytest.approx(x[1].numpy(), abs=1e-8)


def test_never_worse_than_pca_at_the_points_that_are_read():
    points, _ = bent_sheets(200, points=60, depth=(0.1, 1.6))
    model = PolyFit(4, random_network()).eval()

    def height(fit):
        x = fit.frame.to_chart(points)
        return (jets.height(fit.jet.alpha, x[..., :2]) - x[..., 2]).square().mean(1).sqrt()

    with torch.no_grad():
        pca, turned = height(PolyFit(4)(points)), height(model(points))
    assert (turned <= pca + 1e-6).all()
    assert (turned < 0.9 * pca).sum() > 20


def test_the_turn_that_is_kept_is_the_one_of_least_height():
    points, _ = bent_sheets(20, points=50)
    model = PolyFit(4, random_network()).double().eval()
    x = CanonicalFrame.from_points(points).to_chart(points)
    turns = model.stn(x).detach()
    kept = model.least_height(x, turns)
    for b in range(20):
        heights = []
        for q in turns[b]:
            y = x[b] @ rotation_matrix(q)
            heights.append(
                (jets.height(jets.fit(y, 4).alpha, y[:, :2]) - y[:, 2]).square().mean().item()
            )
        assert kept[b] == int(np.argmin(heights))


def test_gradients_reach_the_network_s_weights():
    """Against finite differences, of a loss of the jets' coefficients and the frames."""
    points, _ = bent_sheets(6, points=60)
    model = PolyFit(3, random_network(widths=(8, 16), hidden=8, points=40, turns=3)).double()
    target = torch.randn(6, 60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss():
        fit = model(points)
        return (
            (
                fit.frame.from_chart(jets.point(fit.jet.alpha, fit.frame.to_chart(points)[..., :2]))
                - target
            )
            ** 2
        ).mean()

    loss().backward()
    weight = model.stn.head[-1].weight
    g = torch.Generator().manual_seed(4)
    for parameter in (weight, model.stn.local[0].weight):
        direction = torch.randn(parameter.shape, generator=g, dtype=torch.float64)
        expected = (parameter.grad * direction).sum().item()
        values = []
        for h in (1e-6, -1e-6):
            with torch.no_grad():
                parameter.add_(h * direction)
                values.append(loss().item())
                parameter.sub_(h * direction)
        assert abs(expected) > 1e-8
        assert (values[0] - values[1]) / 2e-6 == pytest.approx(expected, rel=1e-4, abs=1e-9)


def test_shipped_weights_turn_narrow_valleys_the_right_way_up(model):
    points, normals = bent_sheets(200, dtype=torch.float32, depth=(0.8, 1.2), width=(0.8, 1.2))
    found = {}
    for name, m in (("pca", PolyFit(4)), ("stn", model)):
        with torch.no_grad():
            fit = m(points)
            n = normals @ fit.frame.R
            found[name] = (
                share_behind(n).mean(),
                discrepancy(fit.jet.alpha, fit.frame.to_chart(points), n),
            )
    assert (
        found["pca"][0] > 0.2
    )  # PCA looks at about half of them from the edge, where half of the patch is seen from behind
    assert found["stn"][0] < 0.6 * found["pca"][0]
    for figure in ("height", "distance", "angle"):
        assert (
            getattr(found["stn"][1], figure).mean() < 0.7 * getattr(found["pca"][1], figure).mean()
        ), figure


@pytest.mark.parametrize("name", ["polyfit", "paper"])
def test_what_made_the_shipped_weights_is_beside_them(name):
    from polyfit.network import PRETRAINED

    model, path = PolyFit.pretrained(name=name), PRETRAINED[name]
    assert (model.stn.shape["turns"], model.stn.pca) == ((5, True) if name == "polyfit" else (1, 0))
    about = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert about["command"].startswith("python -m polyfit.train ")
    assert {"seed", "minutes", "machine", "meshes"} <= set(about)
    assert about["parameters"] == sum(p.numel() for p in model.parameters())
    assert path.stat().st_size < 1e6
    with pytest.raises(InputError, match="choose among polyfit, paper"):
        PolyFit.pretrained(name="deepfit")


def test_discrepancy_of_a_tilted_plane_is_its_distance_and_its_angle():
    uv = torch.rand(1, 50, 2, dtype=torch.float64)
    x = torch.cat([uv, 0 * uv[..., :1]], -1)  # the plane z = 0
    n = torch.tensor([0, 0, -1.0], dtype=torch.float64).expand(
        1, 50, 3
    )  # seen from below: which side is up is no error
    alpha = torch.tensor([[0.2, 0, 0]], dtype=torch.float64)
    flat = discrepancy(alpha, x, n)
    assert (flat.height.item(), flat.distance.item(), flat.angle.item()) == pytest.approx(
        (0.2, 0.2, 0), abs=1e-6
    )
    tilted = discrepancy(torch.tensor([[0.0, 1, 0]], dtype=torch.float64), x, n)
    assert tilted.angle.item() == pytest.approx(45, abs=1e-6)
    assert tilted.distance.item() == pytest.approx(tilted.height.item() / 2**0.5, rel=1e-6)
    half = (
        torch.where(torch.arange(50) < 20, -1.0, 1.0)[None, :, None] * n
    )  # 20 of 50 face the other way
    assert share_behind(half).item() == pytest.approx(0.4)
    assert discrepancy(alpha, x, half).angle.item() == pytest.approx(0.4 * 180, abs=1e-4)
    mask = torch.arange(50)[None] >= 20
    assert share_behind(half, mask).item() == 0
    assert discrepancy(alpha, x, half, mask).angle.item() == pytest.approx(0, abs=1e-4)


class TestWeights:
    def test_come_back_as_they_were_saved(self, tmp_path):
        model = PolyFit(3, random_network(widths=(8, 16), hidden=8, points=40, turns=2))
        model.save(tmp_path / "w.safetensors", seed=7)
        again = PolyFit.load(tmp_path / "w.safetensors", 3)
        assert again.order == 3 and again.stn.shape == model.stn.shape
        assert all(
            torch.equal(a, b)
            for a, b in zip(model.state_dict().values(), again.state_dict().values())
        )

    def test_of_another_order_are_refused(self):
        with pytest.raises(InputError, match="for jets of order 4, not 6"):
            PolyFit.pretrained(order=6)

    def test_of_another_version_are_refused(self, tmp_path):
        path = tmp_path / "w.safetensors"
        PolyFit(4, random_network()).save(path)
        tensors, about = read_weights(path, "polyfit", 1)
        write_weights(path, tensors, about | dict(version=99))
        with pytest.raises(InputError, match="weights of version 99, and this is version 1"):
            PolyFit.load(path)

    def test_of_another_model_or_shape_are_refused(self, tmp_path):
        path = tmp_path / "w.safetensors"
        write_weights(path, {"a": torch.zeros(2)}, dict(model="pointnet", version=1, order=4))
        with pytest.raises(InputError, match="weights of pointnet, not of polyfit"):
            PolyFit.load(path)
        write_weights(
            path,
            {"a": torch.zeros(2)},
            dict(model="polyfit", version=1, order=4, network=SpatialTransformer().shape),
        )
        with pytest.raises(InputError, match="network of another shape"):
            PolyFit.load(path)

    @pytest.mark.parametrize("content", [b"", b"no safetensors at all", None])
    def test_that_cannot_be_read_are_refused(self, tmp_path, content):
        path = tmp_path / "w.safetensors"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError, match="w.safetensors: ") as error:
            PolyFit.load(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("order", [0, 11])
def test_orders_that_no_jet_has_are_refused(order):
    with pytest.raises(InputError, match=f"order = {order}"):
        PolyFit(order)


def test_points_that_are_not_finite_are_refused(model):
    points, _ = bent_sheets(2)
    points[1, 3] = torch.nan
    with pytest.raises(InputError, match="patch 1"):
        model(points)
