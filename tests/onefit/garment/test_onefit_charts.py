from dataclasses import replace

import numpy as np
import pytest
import torch
from charted import T, deformation

from onefit.garment import TEMPLATES, Garment, standard_surface
from onefit.garment.charts import Deformation, PatchedGarment, SparseMatrix
from onefit.garment.charts.blending import DRIFT_WIDTH, SLOPE_RIDGE
from onefit.garment.charts.frames import steady_jets
from onefit.garment.waistband import BAND_WIDTH, held
from polyfit import InputError, jets
from polyfit.mesh import loops


def points_of(patched, d, t, uv, patch):
    """Points of deformed jets by their definition: p = s' R (u, v, z'(u, v)) + T'."""
    frame = patched.frame.to(torch.float32)[patch]
    alpha = patched.alpha.float()[patch] + d.alpha[t][patch]
    s = frame.s * d.scale[t][patch].exp()
    z = jets.height(alpha, uv[:, None])[:, 0]
    x = s[:, None] * torch.cat([uv, z[:, None]], 1) + frame.s[:, None] * d.translation[t][patch]
    return (frame.R @ x[..., None])[..., 0] + frame.T + drifted(patched, d.drift[t], uv, patch)


def room(patched):
    return torch.as_tensor(patched.drift_scale, dtype=torch.float32)[:, None]


def drifted(patched, drift, uv, patch):
    """The plane, at points (P, 2) of the charts, that fits the drifts of the patches around by
    weighted least squares.
    """
    T, s, R = patched.frame.T.float(), patched.frame.s.float(), patched.frame.R.float()
    drift = drift * room(patched)
    meet = torch.eye(len(T), dtype=torch.bool)
    meet[tuple(patched.boundary_patch.T)] = meet[tuple(patched.boundary_patch.T.flip(0))] = True
    i, j = (meet & ~torch.eye(len(T), dtype=torch.bool)).nonzero().T
    length = np.median((T[i] - T[j]).norm(dim=1))
    planes = []
    for k in range(len(T)):
        around = (meet[meet[k]].any(0)).nonzero()[:, 0]
        away = T[around] - T[k]
        w = (
            -(away.square().sum(1)) / (DRIFT_WIDTH * length) ** 2 / 2
        ).exp()  # the root of the weights
        b = torch.cat([torch.ones(len(around), 1), (away @ R[k])[:, :2] / s[k]], 1)
        held = torch.diag(torch.tensor([0.0, SLOPE_RIDGE, SLOPE_RIDGE]).sqrt()) * w.norm()
        planes.append(
            torch.linalg.lstsq(
                torch.cat([w[:, None] * b, held]),
                torch.cat([w[:, None] * drift[around], torch.zeros(3, 3)]),
            ).solution
        )
    return (torch.cat([torch.ones(len(uv), 1), uv], 1)[:, None] @ torch.stack(planes)[patch])[:, 0]


def test_a_sparse_matrix_multiplies_and_differentiates_as_a_dense_one():
    g = torch.Generator().manual_seed(0)
    dense = torch.randn(7, 5, generator=g) * (torch.rand(7, 5, generator=g) > 0.5)
    x = torch.randn(5, 2, 3, generator=g, requires_grad=True)
    sparse, full = SparseMatrix(dense.numpy()) @ x, torch.einsum("nm,mab->nab", dense, x)
    assert torch.allclose(sparse, full, atol=1e-6)
    weights = torch.randn(7, 2, 3, generator=g)
    a, b = (
        torch.autograd.grad((y * weights).sum(), x, retain_graph=True)[0] for y in (sparse, full)
    )
    assert torch.allclose(a, b, atol=1e-6)
    assert torch.allclose(SparseMatrix(dense.numpy()) @ x[:, 0, 0], full[:, 0, 0], atol=1e-6)


def test_no_deformation_moves_nothing(patched):
    zero = deformation(patched, 0.0)
    assert patched.displacement(patched.changes(zero)).abs().max() == 0


def test_changes_are_those_of_the_deformed_jets(patched):
    d = deformation(patched)
    at = patched.at_metric(patched.changes(d)).unflatten(0, (len(patched), -1))  # (K, M, 3, T, 3)
    patch = torch.arange(len(patched)).repeat_interleave(at.shape[1])
    uv = patched.metric_uv.flatten(0, 1)
    rest = points_of(patched, deformation(patched, 0.0), 0, uv, patch)
    for t in (0, T - 1):
        moved = points_of(patched, d, t, uv, patch) - rest
        assert torch.allclose(at[:, :, 0, t].flatten(0, 1), moved, atol=1e-6)
        step = 1e-2  # of a polynomial of degree 4 in float32: central differences of the right size
        for k, axis in enumerate(torch.eye(2)):
            ahead, behind = (
                points_of(patched, d, t, uv + sign * step * axis, patch) for sign in (1, -1)
            )
            ahead0, behind0 = (
                points_of(patched, deformation(patched, 0.0), 0, uv + sign * step * axis, patch)
                for sign in (1, -1)
            )
            slope = ((ahead - behind) - (ahead0 - behind0)) / (2 * step)
            assert torch.allclose(at[:, :, 1 + k, t].flatten(0, 1), slope, atol=2e-4)


def test_blending_keeps_a_common_motion(patched):
    # every patch moved by the same vector of the rest space: so is every vertex, whatever charts it
    # is blended from
    move = torch.tensor([0.03, -0.02, 0.05])
    local = (patched.frame.R.float().mT @ move) / patched.frame.s.float()[:, None]
    zero = deformation(patched, 0.0, 1)
    for common in (
        replace(zero, translation=local[None]),
        replace(zero, drift=(move / room(patched))[None]),
    ):
        moved = patched.displacement(patched.changes(common))
        assert torch.allclose(moved[:, 0], move.expand(len(moved), 3), atol=1e-6)


def test_a_drift_turns_and_stretches_the_cloth_with_it(patched, garment):
    # drifts that grow with the place: every chart moves by its part of the same field, so that no
    # seam opens
    slope = torch.tensor([[0.1, 0, 0.2], [0.05, -0.1, 0.3], [0, 0.1, 0.1]])
    zero, field = deformation(patched, 0.0, 1), patched.frame.T.float() @ slope.T / room(patched)
    moved = patched.displacement(patched.changes(replace(zero, drift=field[None])))[:, 0]
    wanted = garment.vertices @ slope.T
    inner = (garment.vertices[:, None] - patched.frame.T.float()).norm(dim=-1).topk(
        4, largest=False
    ).values[:, 3] < 0.1  # not at the rims
    assert (moved - wanted)[inner].norm(dim=1).median() < 0.04 * (wanted - wanted.mean(0)).norm(
        dim=1
    ).median()
    at = patched.at_boundary(patched.changes(replace(zero, drift=field[None])))[:, :, 0, 0]
    alone = patched.at_boundary(
        patched.changes(replace(zero, translation=_in_charts(patched, slope)[None]))
    )[:, :, 0, 0]
    apart = lambda x: (x[0] - x[1]).norm(dim=1).median()
    assert apart(at) < 0.2 * apart(alone)


def _in_charts(patched, slope):
    """Translations (K, 3), in the charts, of the patches' centres by the field of this slope."""
    move = patched.frame.T.float() @ slope.T
    return (patched.frame.R.float().mT @ move[..., None])[..., 0] / patched.frame.s.float()[:, None]


def test_looseness_tells_how_far_patches_are_from_the_body(patched, garment):
    distance = standard_surface()(garment.vertices.numpy()).distance
    found = 5e-3 * torch.sinh(patched.looseness)
    for k in (0, len(patched) // 2, len(patched) - 1):
        own = distance[patched.vertex_patch == k]
        least, mean, greatest = found[k].tolist()
        assert (
            least <= own.min() + 1e-6 and greatest >= own.max() - 1e-6
        )  # the patches' own, finer vertices
        assert mean == pytest.approx(own.mean(), abs=1.5e-3)


def test_garments_are_held_at_the_waist_or_hang_from_the_shoulders(body):
    joints = body.joints.double().numpy()
    for name in TEMPLATES:
        garment = Garment.template(name)
        V, F = garment.vertices.double().numpy(), garment.faces.numpy()
        found = held(V, F, joints)
        if name not in ("trousers", "shorts", "skirt"):
            assert not found.any()
            continue
        rim = V[
            next(loop for loop in loops(F) if V[loop, 2].min() > V[:, 2].max() - 0.001)
        ]  # the waists are level
        line = np.concatenate(
            [(1 - t) * rim + t * np.roll(rim, -1, axis=0) for t in np.linspace(0, 1, 50)]
        )
        away = np.concatenate(
            [
                np.linalg.norm(V[i : i + 500, None] - line, axis=2).min(1)
                for i in range(0, len(V), 500)
            ]
        )
        x = np.clip((BAND_WIDTH[1] - away) / (BAND_WIDTH[1] - BAND_WIDTH[0]), 0, 1)
        assert np.allclose(found, 3 * x**2 - 2 * x**3, atol=0.01)
        assert (found == 1).sum() > 50
    # the dress without what is above its waist is a skirt; a dress that ends below the shoulders is
    # held, too
    dress = Garment.template("dress")
    V, F = dress.vertices.double().numpy(), dress.faces.numpy()
    skirt = F[(V[F, 2] < 0.1).all(1)]
    used, skirt = np.unique(skirt, return_inverse=True)
    skirt = skirt.reshape(-1, 3)
    found = held(V[used], skirt, joints)
    assert found[V[used, 2] > 0.085].min() > 0.99 and not found[V[used, 2] < 0.02].any()
    assert held(V, F, joints + [0, 0, 0.2]).any()
    box = (
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -1.0]]),
        np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
    )
    assert not held(*box, joints).any()  # no boundary at all
    # in a file of both, the skirt is held, and the dress that it came from is not
    both = held(np.concatenate([V, V[used]]), np.concatenate([F, skirt + len(V)]), joints)
    assert not both[: len(V)].any() and np.array_equal(both[len(V) :], found)


def test_a_band_gives_way_but_does_not_slide(body):
    shorts = PatchedGarment(Garment.template("shorts"), body)
    V = shorts.garment.vertices
    d = deformation(shorts)
    d.drift.requires_grad_()
    moved = shorts.displacement(shorts.changes(d))  # (N, T, 3)
    free = shorts.blend @ shorts.changes(d).flatten(0, 1)
    firmly = torch.as_tensor(
        held(V.double().numpy(), shorts.garment.faces.numpy(), body.joints.double().numpy())
    ).float()
    normal = torch.as_tensor(standard_surface()(V.numpy()).normal)
    outwards = lambda x: torch.einsum("ntd,nd->nt", x, normal)
    slid = lambda x: (x - outwards(x)[..., None] * normal[:, None]).norm(dim=-1)
    assert torch.allclose(outwards(moved), outwards(free), atol=1e-6)
    assert torch.allclose(slid(moved), (1 - firmly[:, None]) * slid(free), atol=1e-6)
    assert (firmly == 1).sum() > 50 and slid(free)[firmly == 1].median() > 0.005
    # what is held has no gradient along the body
    (gradient,) = torch.autograd.grad(
        (moved - outwards(moved)[..., None] * normal[:, None])[firmly == 1].sum(), d.drift
    )
    assert gradient.abs().max() < 1e-5
    # the network is told which patches are held
    own = torch.as_tensor(shorts.vertex_patch)
    share = torch.zeros(len(shorts)).index_add(0, own, firmly) / torch.bincount(own)
    assert (
        torch.allclose(shorts.features[4][:, 0], share, atol=0.1) and shorts.features[4].max() > 0.5
    )
    assert shorts.features[4][share == 0].median() == 0


def test_seams_are_not_torn(patched, garment):
    # the charts disagree at random; an edge across a seam jumps far less than if each vertex had
    # its own patch's displacement alone
    d = deformation(patched, 0.2)
    moved = patched.displacement(patched.changes(d))[:, 0]
    own = torch.as_tensor(patched.vertex_patch)
    frame = patched.frame.to(torch.float32)[own]
    uv = ((garment.vertices - frame.T)[:, None] @ frame.R)[:, 0, :2] / frame.s[:, None]
    alone = points_of(patched, d, 0, uv, own) - points_of(
        patched, deformation(patched, 0.0), 0, uv, own
    )
    a, b = patched.edges[(own[patched.edges[:, 0]] != own[patched.edges[:, 1]])].T
    assert len(a) > 200
    jump = lambda x: (x[a] - x[b]).norm(dim=-1).median()
    assert jump(moved) < 0.35 * jump(alone)


def test_a_strip_follows_its_neighbours(body):
    # a hem turned in: where the strip's own chart alone is moved, the strip follows little of it; a
    # patch on the outside follows it
    garment = Garment.template("shorts")
    V, F = garment.vertices.double().numpy(), garment.faces.numpy()
    rim = max(loops(F), key=lambda loop: V[loop, 2].mean())  # the waist
    inner = (
        V[rim]
        - [0, 0, 0.012]
        + 0.004
        * (V[rim].mean(0) - V[rim])
        / np.linalg.norm(V[rim].mean(0) - V[rim], axis=1, keepdims=True)
    )
    new, after = len(V) + np.arange(len(rim)), np.roll(np.arange(len(rim)), -1)
    turned_in = np.concatenate(
        [np.stack([rim[after], rim, new], 1), np.stack([rim[after], new, new[after]], 1)]
    )
    hemmed = PatchedGarment(
        Garment.bound("hemmed", np.concatenate([V, inner]), np.concatenate([F, turned_in])), body
    )
    own = torch.as_tensor(hemmed.vertex_patch)
    area = torch.zeros(len(hemmed)).index_add(0, own, hemmed.vertex_area) / (
        np.pi * hemmed.frame.s.float() ** 2
    )
    zero = deformation(hemmed, 0.0, 1)

    def followed(k):
        """How much of its chart's motion along z the patch k follows, in the mean."""
        move = torch.zeros(1, len(hemmed), 3)
        move[0, k, 2] = 1.0
        moved = hemmed.displacement(hemmed.changes(replace(zero, translation=move)))[own == k, 0]
        return float(moved.norm(dim=1).mean() / hemmed.frame.s[k])

    strips, others = torch.nonzero(area < 0.12)[:, 0], torch.nonzero(area > 0.4)[:, 0]
    assert len(strips) > 0
    assert max(followed(k) for k in strips) < 0.15 and min(followed(k) for k in others) > 0.35


def test_fields_of_the_vertices_and_their_derivatives(patched, garment):
    # the positions themselves are such a field: its derivatives are the template's tangents
    value, du, _dv = (patched.field @ garment.vertices).unflatten(0, (-1, 3)).unbind(1)
    patch = torch.arange(len(patched)).repeat_interleave(patched.metric_uv.shape[1])
    uv = patched.metric_uv.flatten(0, 1)
    points = points_of(patched, deformation(patched, 0.0), 0, uv, patch)
    assert (value - points).norm(dim=-1).median() < 2e-4
    slope = jets.height_derivatives(patched.alpha.float()[patch], uv[:, None])
    s, R = patched.frame.s.float()[patch], patched.frame.R.float()[patch]
    u = torch.stack([torch.ones(len(uv)), torch.zeros(len(uv)), slope[0][:, 0]], -1)
    u = s[:, None] * (R @ u[..., None])[..., 0]
    assert ((du - u).norm(dim=-1) / u.norm(dim=-1)).median() < 0.02
    assert torch.allclose(patched.metric_weights[:, 0].sum(1), torch.ones(len(uv)), atol=1e-3)


def test_frames_lie_along_the_bones_and_outwards(patched, garment, body):
    R = patched.frame.R
    assert torch.allclose(R.mT @ R, torch.eye(3, dtype=R.dtype).expand_as(R), atol=1e-9)
    assert torch.allclose(torch.linalg.det(R), torch.ones(len(R), dtype=R.dtype))
    outwards = patched.frame.T - body.joints[[0, 3, 6, 9]].double().mean(0)
    side = patched.frame.T[:, :2].norm(dim=1) > 0.08  # not the shoulders
    assert ((R[:, :2, 2] * outwards[:, :2]).sum(1)[side] > 0).double().mean() > 0.95
    # a tank hangs from the spine: v is upwards
    assert (R[:, 2, 1] > 0.5).double().mean() > 0.8


def test_jets_of_strips_stay_within_reason():
    # a strip 20 times as long as wide with 0.5 mm of noise: least squares alone would have
    # coefficients of hundreds
    g = torch.Generator().manual_seed(0)
    uv = (torch.rand(200, 2, generator=g, dtype=torch.float64) * 2 - 1) * torch.tensor([0.05, 1.0])
    z = 0.1 * uv[:, 1] ** 2 + 0.01 * torch.randn(200, generator=g, dtype=torch.float64)
    disc = torch.rand(200, 2, generator=g, dtype=torch.float64) * 1.6 - 0.8
    shape = torch.tensor(
        [0.02, 0, 0.1, -0.2, 0.1, 0.3, 0, 0.1, 0, -0.1, 0.1, 0, 0.2, 0, 0], dtype=torch.float64
    )
    x = torch.cat(
        [torch.cat([uv, z[:, None]], 1), torch.cat([disc, jets.height(shape, disc)[:, None]], 1)]
    )
    patch = torch.arange(2).repeat_interleave(200)
    alone = jets.fit(x[:200], 4).alpha
    strip, whole = steady_jets(x, patch, torch.ones(400, dtype=torch.float64), 2, 4)
    assert alone.abs().max() > 10 > 1 > strip.abs().max()
    assert (jets.height(strip, uv) - z).square().mean().sqrt() < 0.012
    # cloth on all of the chart is fitted as it is
    assert (jets.height(whole, disc) - x[200:, 2]).abs().max() < 0.01


def test_patches_as_the_paper_has_them(body):
    shorts = Garment.template("shorts")
    ours, paper = (
        PatchedGarment(shorts, body),
        PatchedGarment(shorts, body, frames="stn", acvd=True, waistband=False),
    )
    assert len(ours) == len(paper) and (ours.vertex_patch != paper.vertex_patch).any()
    turned = PatchedGarment(shorts, body, frames="stn")
    cosine = (turned.frame.R[:, :, 2] * ours.frame.R[:, :, 2]).sum(-1)
    assert (cosine < 0.99999).any() and len(turned) == len(ours)
    assert len(ours.band[0]) and ours.held.max() > 0.5
    assert not len(paper.band[0]) and not paper.held.any()
    # a garment without deformation stays the mesh, and one that is lifted is lifted everywhere
    K = len(paper)
    lift = torch.zeros(1, K, 3)
    up = Deformation(torch.zeros(1, K, 15), lift, torch.zeros(1, K), lift)
    assert not paper.displacement(paper.changes(up)).any()
    up = replace(up, translation=torch.tensor([0.0, 0, 0.1]).expand(1, K, 3))
    assert paper.displacement(paper.changes(up)).norm(dim=-1).min() > 1e-4
    with pytest.raises(InputError, match="frames 'lda'"):
        PatchedGarment(shorts, body, frames="lda")
