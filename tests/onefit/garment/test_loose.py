"""Garments with slack: closed seams, outside of the body, hanging, as long as they were cut."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from onefit.garment import LOOSE, Garment, standard_body, standard_surface
from onefit.garment.reading.mending import mended
from onefit.garment.sewing import fall, loose
from polyfit import mesh
from polyfit.mesh import loops

LOOPS = {
    "boxy_tshirt": 4, "shirt": 4, "waisted_dress": 4, "circle_skirt": 2, "wide_trousers": 3,
}  # fmt: skip
# How often the hem goes around the body (the leg of the trousers) at its height, at least
FULLNESS = {
    "boxy_tshirt": 1.2, "shirt": 1.2, "waisted_dress": 2.5, "circle_skirt": 2.5, "wide_trousers": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def garments():
    return {name: Garment.template(name) for name in LOOSE}


@pytest.fixture(params=LOOSE)
def garment(request, garments):
    return garments[request.param]


def perimeter(points):
    return np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum()


def lowest_loops(garment, count=1):
    V = garment.vertices.numpy()
    return sorted(loops(garment.faces.numpy()), key=lambda loop: V[loop, 2].mean())[:count]


def test_is_one_clean_sheet_whose_seams_are_closed(garment):
    V, F = garment.vertices.double().numpy(), garment.faces.numpy()
    _W, G, told = mended(V, F)
    flat = garment.name == "waisted_dress"  # one face at its rim, 0.03 mm high
    assert told == ("flipped or dropped 1 faces whose corners lie in a line",) * flat
    kept = set(map(tuple, G.tolist()))
    assert len(F) - len(G) == flat and kept <= set(map(tuple, F.tolist()))
    found = loops(F)
    assert len(found) == LOOPS[garment.name]
    assert len(V) - len(mesh.edges_of(F)[0]) + len(F) == 2 - len(found)


def test_lies_outside_the_body(garment):
    V, F = garment.vertices.numpy(), garment.faces.numpy()
    assert standard_surface()(V).distance.min() > 0.003
    assert standard_surface()(V[F].mean(axis=1)).distance.min() > 0.001


def test_is_as_long_as_it_was_cut(garment):
    edges = torch.as_tensor(mesh.edges_of(garment.faces.numpy())[0])
    V = garment.vertices
    length = (V[edges[:, 0]] - V[edges[:, 1]]).norm(dim=1)
    strain = (length / garment.rest_lengths(edges) - 1).abs()
    assert strain.mean() < 0.01 and strain.quantile(0.99) < 0.06


def test_has_slack(garment):
    V = garment.vertices.numpy()
    body = standard_body().vertices.numpy()
    legs = garment.name == "wide_trousers"
    for loop in lowest_loops(garment, 2 if legs else 1):
        height, side = V[loop, 2].mean(), V[loop, 0].mean()
        near = body[np.abs(body[:, 2] - height) < 0.01]
        # without hands; of the trousers the leg on this side
        near = near[near[:, 0] * side > 0] if legs else near[np.abs(near[:, 0]) < 0.24]
        girth = perimeter((p := near[:, :2])[ConvexHull(p).vertices])
        assert perimeter(garment.cut.numpy()[loop]) > FULLNESS[garment.name] * girth


@pytest.mark.parametrize("name", ["circle_skirt", "waisted_dress"])
def test_a_skirt_hangs_in_pleats(garments, name):
    garment = garments[name]
    V, (hem,) = garment.vertices.numpy(), lowest_loops(garment)
    around = V[hem, :2]
    hull = perimeter(around[ConvexHull(around).vertices])
    assert perimeter(V[hem]) > 1.25 * hull
    # it hangs: the hem is about as far below the waist as the ring is wide
    ring = loose.LOOSE_PATTERNS[name][2]
    waist = garment.cut.numpy()[:, 2].min()
    assert 0.85 * ring < waist - V[hem, 2].mean() < 1.02 * ring


def test_hangs_at_rest(garments):
    """A quarter of a second more of its fall hardly moves it: a pleat may still shift."""
    garment = garments["circle_skirt"]
    V, cut = garment.vertices.double().numpy(), garment.cut.double().numpy()
    done = loose.Cut(cut, garment.faces.numpy(), V)
    moved = np.linalg.norm(fall.fallen(done, seconds=0.25) - V, axis=1)
    assert moved.mean() < 0.005 and np.percentile(moved, 95) < 0.015


def test_rest_lengths_follow_the_cut_and_the_shape(garments):
    garment = garments["circle_skirt"]
    pairs = garment.faces[:, :2]
    length = lambda x: (x[pairs[:, 0]] - x[pairs[:, 1]]).norm(dim=1)
    assert torch.equal(garment.rest_lengths(pairs), length(garment.cut))
    larger = 1.1 * garment.vertices
    assert torch.allclose(garment.rest_lengths(pairs, larger), 1.1 * length(garment.cut))
    sides = garment.sides()
    assert torch.equal(sides[:, 0], length(garment.cut))
    assert torch.equal(sides[:, 2], garment.rest_lengths(garment.faces[:, [2, 0]]))
    shell = Garment.template("tank")
    assert shell.cut is None
    pairs = shell.faces[:, :2]
    assert torch.equal(
        shell.rest_lengths(pairs, 1.1 * shell.vertices), length(1.1 * shell.vertices)
    )


@pytest.mark.parametrize("times", [4, 0.4])
def test_at_another_resolution_it_has_the_same_cut(garments, times):
    garment = garments["circle_skirt"]
    other = garment.remeshed(times * len(garment))
    area = lambda g: mesh.areas(g.cut.double().numpy(), g.faces.numpy()).sum()
    assert area(other) == pytest.approx(area(garment), rel=0.01)
    (hem,), (was,) = lowest_loops(other), lowest_loops(garment)
    assert perimeter(other.cut.numpy()[hem]) == pytest.approx(
        perimeter(garment.cut.numpy()[was]), rel=0.03
    )


def test_a_ring_is_flat_and_its_hem_is_longer_by_a_whole_circle():
    n, rows = 60, 4
    turn = 2 * np.pi * np.arange(n) / n
    level = lambda z: np.stack([0.13 * np.cos(turn), 0.09 * np.sin(turn), np.full(n, z)], 1)
    V = np.concatenate([level(0.17 + 0.01 * k) for k in range(rows)])
    k, after = np.arange(n), (np.arange(n) + 1) % n
    F = np.concatenate(
        [np.stack([r * n + k, r * n + after, (r + 1) * n + after], 1) for r in range(rows - 1)]
        + [np.stack([r * n + k, (r + 1) * n + after, (r + 1) * n + k], 1) for r in range(rows - 1)]
    )
    cut = loose.with_ring(V, F, 0.3)
    assert np.array_equal(cut.vertices[: len(V)], V) and np.array_equal(cut.faces[: len(F)], F)
    ring = cut.vertices[len(V) :]
    assert np.abs(ring[:, 2] - 0.17).max() < 1e-12
    hem = max(loops(cut.faces), key=len)
    assert perimeter(cut.vertices[hem]) == pytest.approx(
        perimeter(V[:n]) + 2 * np.pi * 0.3, rel=0.002
    )
    assert mended(cut.vertices, cut.faces)[2] == () and len(loops(cut.faces)) == 2
    angle = np.degrees(_angles(cut.vertices, cut.faces[len(F) :]))
    assert angle.min() > 20
    # where it starts to fall it is about as long: the cone has waves
    edges = mesh.edges_of(cut.faces)[0]
    length = lambda x: np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    ratio = length(cut.start) / length(cut.vertices)
    assert 0.85 < np.median(ratio) < 1.1 and ratio.max() < 1.7


def _angles(V, F):
    side = np.roll(V[F], -1, axis=1) - V[F]
    side /= np.linalg.norm(side, axis=2, keepdims=True)
    return np.arccos(np.clip(-(side * np.roll(side, 1, axis=1)).sum(2), -1, 1))


def test_a_skirt_is_cut_as_the_template_was(garments, block):
    cut = loose.cut(block, "circle_skirt")
    garment = garments["circle_skirt"]
    hem = max(loops(cut.faces), key=len)
    (was,) = lowest_loops(garment)
    assert perimeter(cut.vertices[hem]) == pytest.approx(
        perimeter(garment.cut.numpy()[was]), rel=0.02
    )
    extent = lambda x: np.concatenate([x.min(0), x.max(0)])
    assert np.abs(extent(cut.vertices) - extent(garment.cut.numpy())).max() < 0.012
