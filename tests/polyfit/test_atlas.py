"""The cover of a mesh by few overlapping patches, and its partition of unity."""

import numpy as np
import pytest
import surfaces
from skimage.measure import marching_cubes

from polyfit import mesh
from polyfit.patches import atlas
from polyfit.patches.atlas import Cover, is_graph
from polyfit.patches.unity import LAYERS, shares


def box(n=7, size=0.2):
    """A closed box, its faces outwards; its corners and edges are shared."""
    parts = []
    for axis in range(3):
        for side in (-1, 1):
            V, F = surfaces.sheet(size=size, n=n)
            V[:, 2] = size
            turn = np.roll(np.eye(3), axis, axis=0) * side
            turn[:, 0] *= np.linalg.det(turn)
            parts.append((V @ turn.T, F))
    V, F = surfaces.joined(*parts)
    _, first, same = np.unique(V.round(9), axis=0, return_index=True, return_inverse=True)
    return V[first], same[F]


def can(around=32, radius=0.05, height=0.2):
    """A closed low-poly cylinder: long faces around it, a fan at either end."""
    angle, k = 2 * np.pi * np.arange(around) / around, np.arange(around)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    ends = [np.column_stack([ring, np.full(around, z)]) for z in (0.0, height)]
    after, low, high = (
        (k + 1) % around,
        np.full(around, 2 * around),
        np.full(around, 2 * around + 1),
    )
    faces = [(k, after, k + around), (after, after + around, k + around)]
    faces += [(after, k, low), (k + around, after + around, high)]
    V = np.concatenate([*ends, [[0, 0, 0], [0, 0, height]]])
    return V, np.concatenate([np.stack(f, 1) for f in faces])


SHAPES = {
    "sheet": surfaces.sheet,
    "wave": lambda: surfaces.sheet(lambda x, y: 0.05 * np.sin(12 * x)),
    "tube": surfaces.tube,
    "ball": lambda: surfaces.sphere(subdivisions=2),
    "box": box,
    "can": can,
    "several": lambda: surfaces.joined(surfaces.sheet(), surfaces.tube(), box()),
}


@pytest.fixture(scope="module", params=SHAPES)
def covered(request):
    vertices, faces = SHAPES[request.param]()
    return request.param, vertices, faces, Cover.of(vertices, faces)


@pytest.mark.parametrize("shape", [box, can])
def test_solids_are_closed_and_outwards(shape):
    vertices, faces = shape()
    vertices = vertices - vertices.mean(0)
    assert mesh.winding(faces).min() == 1 and 2 * len(mesh.edges_of(faces)[0]) == faces.size
    outwards = (mesh.face_vectors(vertices, faces) * vertices[faces].mean(1)).sum(1)
    assert outwards.min() > 0


def test_weights_are_a_partition_of_unity(covered):
    _, vertices, _, cover = covered
    assert cover.patch.shape == cover.weight.shape and len(cover.patch) == len(vertices)
    assert cover.weight.sum(1) == pytest.approx(1, abs=1e-12) and cover.weight.min() >= 0
    assert (cover.weight[:, 0] > 0).all() and (cover.weight.argmax(1) == 0).all()
    for row, weight in zip(cover.patch, cover.weight):  # each patch once
        held = row[weight > 0]
        assert len(np.unique(held)) == len(held)


def largest_step(vertices, faces):
    """The largest change of a patch's weight along an edge."""
    cover, edges = Cover.of(vertices, faces), mesh.edges_of(faces)[0]
    share = np.zeros((len(vertices), len(cover)))
    for m in range(cover.patch.shape[1]):
        share[np.arange(len(vertices)), cover.patch[:, m]] += cover.weight[:, m]
    return np.abs(share[edges[:, 0]] - share[edges[:, 1]]).max()


def test_weights_are_continuous_along_the_surface():
    """On a mesh twice as fine, steps of the weights along its edges are half as large."""
    steps = [largest_step(*surfaces.sphere(subdivisions=n)) for n in (3, 4)]
    assert steps[1] < 0.3 and steps[1] < 0.6 * steps[0]
    steps = [largest_step(*surfaces.tube(around=24 * n, along=20 * n)) for n in (1, 2)]
    assert steps[1] < 0.2 and steps[1] < 0.6 * steps[0]


def test_as_few_patches_as_hold_it(covered):
    name, *_, cover = covered
    low, high = {
        "sheet": (1, 1),
        "wave": (1, 1),
        "tube": (3, 4),
        "ball": (4, 8),
        "box": (2, 6),
        "can": (3, 6),
        "several": (6, 11),
    }[name]
    assert low <= len(cover) <= high


def test_little_of_a_surface_is_steep_over_its_patches(covered):
    _, vertices, faces, cover = covered
    vectors = mesh.face_vectors(vertices, faces) / 2
    area, corner = np.linalg.norm(vectors, axis=1), cover.patch[faces, 0]
    steep = np.einsum("fk,fck->fc", vectors, cover.normal[corner]) < atlas.STEEP * area[:, None]
    steep = steep.all(1)  # over the plane of each patch that has a corner
    component = mesh.components(len(vertices), mesh.edges_of(faces)[0])[faces[:, 0]]
    for part in np.unique(component):
        own = component == part
        assert steep[own] @ area[own] <= atlas.STEEP_SHARE * area[own].sum() * (1 + 1e-9)
    assert np.linalg.norm(cover.normal, axis=1) == pytest.approx(1)


def test_a_hem_that_is_folded_in_needs_no_patch_of_its_own():
    plain, faces = surfaces.tube(around=48, along=41)
    folded, z = plain.copy(), plain[:, 2]
    in_hem = z < 0.02
    folded[in_hem, 2] = 0.04 - z[in_hem]  # 2 of 40 cm
    folded[in_hem, :2] *= 0.9
    assert len(Cover.of(plain, faces)) == 3 and len(Cover.of(folded, faces)) <= 6


def test_no_patch_holds_both_legs_of_trousers():
    x, y, z = np.meshgrid(*(np.linspace(-a, a, n) for a, n in ((0.25, 31), (0.2, 25), (0.6, 61))))
    leg = np.hypot(np.abs(x) - 0.1 + 0.05 * z, y) - 0.08
    hips = np.maximum(np.hypot(0.6 * x, y) - 0.1, 0.2 - z)
    V, F, *_ = marching_cubes(-np.logaddexp(-40 * leg, -40 * hips), 0.0)
    V = (V[:, [1, 0, 2]] / (np.array(x.shape)[[1, 0, 2]] - 1) - 0.5) * (0.5, 0.4, 1.2)
    cover = Cover.of(V, F)
    foot, right = V[:, 2] < -0.1, V[:, 0] > 0
    assert foot.sum() > 500 and 4 <= len(cover) <= 16
    assert not set(cover.patch[foot & right, 0]) & set(cover.patch[foot & ~right, 0])


def test_patches_are_connected_and_of_one_component(covered):
    _, vertices, faces, cover = covered
    edges = mesh.edges_of(faces)[0]
    part = mesh.components(len(vertices), edges)
    for k in range(len(cover)):
        for held in (
            cover.patch[:, 0] == k,
            ((cover.patch == k) & (cover.weight > 0)).any(1),
        ):
            kept = edges[held[edges].all(1)]
            assert len(np.unique(mesh.components(len(vertices), kept)[held])) == 1
            assert len(np.unique(part[held])) == 1


def test_a_graph_is_one():
    vertices, faces = surfaces.sheet(lambda x, y: 0.05 * np.sin(12 * x))
    assert is_graph(vertices, faces, np.array([0, 0, 1.0]))
    assert is_graph(vertices, faces, np.array([0, 0, -1.0]))
    assert not is_graph(vertices, faces, np.array([1.0, 0, 0]))
    assert not is_graph(*surfaces.tube(), np.array([1.0, 0, 0]))


def test_the_heaviest_patches_of_a_vertex_share_it():
    rng = np.random.default_rng(0)
    vertex, patch = np.divmod(rng.permutation(40 * 7), 7)
    weight = np.maximum(rng.normal(size=len(vertex)), 0) + (patch == vertex % 7)
    kept, share = shares(vertex, weight, 40)
    for k in range(40):
        heaviest = np.sort(weight[vertex == k])[::-1][:LAYERS]
        heaviest = heaviest[heaviest > 0]
        assert np.allclose(weight[kept][vertex[kept] == k], heaviest)
        assert np.allclose(share[vertex[kept] == k], heaviest / heaviest.sum())
    assert (np.diff(vertex[kept]) >= 0).all()
