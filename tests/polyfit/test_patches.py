"""Meshes made ready and cut into patches: by invariants, on manifolds and on what is none."""

import numpy as np
import pytest
import surfaces
import trimesh

from polyfit import InputError, Patches, mesh, patch_count


def refined_points(V, F, face, barycentric):
    return np.einsum("nj,njc->nc", barycentric, V[F[face]])


@pytest.mark.parametrize("parts", range(1, 6))
def test_refined_mesh_is_the_same_surface(parts):
    V, F = surfaces.sphere(1, 1)
    faces, face, barycentric = mesh.refined(F, parts)
    fine = trimesh.Trimesh(refined_points(V, F, face, barycentric), faces, process=False)
    coarse = trimesh.Trimesh(V, F, process=False)
    assert len(faces) == parts**2 * len(F)
    assert fine.is_watertight and fine.is_winding_consistent
    assert fine.area == pytest.approx(coarse.area) and fine.volume == pytest.approx(coarse.volume)
    assert np.abs(fine.vertices[: len(V)] - V).max() == 0


def test_points_are_found_on_the_subdivided_mesh():
    V, F = surfaces.tube()
    rng = np.random.default_rng(0)
    face = rng.integers(len(F), size=500)
    barycentric = np.concatenate(
        [rng.dirichlet((1, 1, 1), 400), np.repeat(np.eye(3), [40, 30, 30], axis=0)]
    )
    W, G = V, F
    for levels in range(1, 4):
        G, edges = mesh.subdivided(G)
        W = np.concatenate([W, W[edges].mean(axis=1)])
        child, b = mesh.child(face, barycentric, levels)
        assert b.min() > -1e-12
        assert (
            np.abs(refined_points(V, F, face, barycentric) - refined_points(W, G, child, b)).max()
            < 1e-12
        )
        assert (child // 4**levels == face).all()
        assert trimesh.Trimesh(W, G, process=False).is_winding_consistent


def test_sheets_are_manifold_and_keep_their_places():
    for _, F in (surfaces.with_fin(), surfaces.sheet(), surfaces.moebius()):
        split = mesh.sheets(F)
        _, side = mesh.edges_of(split)
        assert np.bincount(side.ravel()).max() <= 2
        assert all(
            len({F.ravel()[k] for k in np.flatnonzero(split.ravel() == s)}) == 1
            for s in range(split.max() + 1)
        )
    assert len(np.unique(mesh.sheets(surfaces.sheet()[1]))) == len(surfaces.sheet()[0])
    V, F = surfaces.with_fin()
    assert (
        mesh.sheets(F).max() + 1 == len(V) + 2 * 11
    )  # the row of the fin's foot exists three times


def test_a_vertex_where_two_cones_meet_is_split():
    _V, F = surfaces.joined(surfaces.sheet(n=3), surfaces.sheet(n=3))
    F = np.where(F == 9, 8, F)  # a corner of the one on a corner of the other
    assert len(np.unique(mesh.sheets(F))) == 18


def test_faces_wound_the_other_way_are_found():
    V, F = surfaces.joined(surfaces.sphere(subdivisions=2), surfaces.tube())
    rng = np.random.default_rng(4)
    turned = rng.random(len(F)) < 0.3
    mixed = np.where(turned[:, None], F[:, ::-1], F)
    assert (mesh.winding(F) == 1).all()
    assert (mesh.winding(mixed) == np.where(turned, -1, 1)).all()
    assert (mesh.winding(surfaces.moebius()[1]) == 1).all()
    a, b = Patches.cut(V, F, 20), Patches.cut(V, mixed, 20)
    rms = [np.linalg.norm(p.direction, axis=1).sum() for p in (a, b)]
    assert rms[1] == pytest.approx(
        rms[0], rel=0.05
    )  # the patches of the one are as flat as those of the other


SHAPES = {
    "sphere": (surfaces.sphere(), 20),
    "tube": (surfaces.tube(), 7),
    "annulus": (trimesh.creation.annulus(0.1, 0.2, 0.01), 12),
    "fin": (surfaces.with_fin(), 9),
    "moebius": (surfaces.moebius(), 8),
    "parts": (
        surfaces.joined(
            surfaces.sphere(),
            surfaces.sphere(0.01, 0),
            surfaces.sheet(n=2, size=1e-3),
            surfaces.tube(0.02),
        ),
        30,
    ),
    "one": (surfaces.sheet(), 1),
    "each vertex": (surfaces.sheet(n=4), 16),
}


@pytest.fixture(params=SHAPES, scope="module")
def shape(request):
    (V, F), count = (
        lambda m, k: ((np.array(m.vertices), np.array(m.faces)) if hasattr(m, "faces") else m, k)
    )(*SHAPES[request.param])
    return V, F, count, Patches.cut(V, F, count)


def test_the_cut_is_a_partition_into_connected_patches(shape):
    V, F, count, p = shape
    assert len(p) == count
    assert np.abs(p.vertices[: len(V)] - V).max() == 0
    assert len(np.unique(p.vertex_patch)) == len(np.unique(p.label)) == count
    edges = mesh.edges_of(p.sheets)[0]
    pieces = mesh.components(len(p.label), edges[p.label[edges[:, 0]] == p.label[edges[:, 1]]])
    assert pieces.max() + 1 == count
    assert mesh.areas(p.vertices, p.faces).sum() == pytest.approx(mesh.areas(V, F).sum())


def test_no_patch_goes_around_an_edge_of_three_faces_or_onto_another_part(shape):
    _V, _F, _, p = shape
    part = mesh.components(p.sheets.max() + 1, mesh.edges_of(p.sheets)[0])
    assert (np.bincount(np.unique(np.stack([p.label, part]), axis=1)[0]) == 1).all()


def test_charts_overlap_by_the_faces_that_touch_several_patches(shape):
    _, _, count, p = shape
    expected = {
        (k, v)
        for patches, corners in zip(p.corner_patch, p.faces)
        for k in patches
        for v in corners
    }
    assert sorted(expected) == list(zip(p.entry_patch.tolist(), p.entry_vertex.tolist()))
    assert (p.entry_vertex[p.face_entries] == p.faces[:, None, :]).all()
    assert (p.entry_patch[p.face_entries] == p.corner_patch[:, :, None]).all()
    assert (p.entry_vertex[p.vertex_entry] == np.arange(len(p.vertices))).all()
    index, exists = p.padded
    assert index.shape[0] == count and (index[exists] == np.arange(len(p.entry_patch))).all()
    assert (p.entry_patch[index] == np.arange(count)[:, None]).all()


def test_shares_of_area_and_direction_add_up(shape):
    _, _, _, p = shape
    assert (
        p.entry_weight.sum() == pytest.approx(mesh.areas(p.vertices, p.faces).sum())
        and p.entry_weight.min() >= 0
    )
    assert p.direction.sum(axis=0) == pytest.approx(
        (p.side[:, None] * mesh.face_vectors(p.vertices, p.faces)).sum(axis=0) / 2, abs=1e-12
    )


def test_boundary_pairs_and_neighbours(shape):
    _, _, _, p = shape
    charts = {}
    for e, v in enumerate(p.entry_vertex.tolist()):
        charts.setdefault(v, []).append(e)
    expected = sorted(
        (a, b)
        for es in charts.values()
        for a in es
        for b in es
        if p.entry_patch[a] < p.entry_patch[b]
    )
    assert sorted(map(tuple, p.boundary.tolist())) == expected
    assert sorted(map(tuple, p.neighbours.tolist())) == sorted(
        {(p.entry_patch[a], p.entry_patch[b]) for a, b in expected}
    )


def test_patches_have_about_the_same_area():
    p = Patches.cut(*surfaces.sphere(), 40)
    area = np.bincount(p.entry_patch, p.entry_weight)
    assert area.std() < 0.15 * area.mean()


@pytest.mark.parametrize("count", [4, 6, 10, 40])
def test_no_patch_goes_around_a_sleeve(count):
    p = Patches.cut(*surfaces.tube(), count)
    normal = mesh.face_vectors(p.vertices, p.faces)
    up = (normal[:, None] * p.direction[p.corner_patch]).sum(axis=-1)
    area = mesh.areas(p.vertices, p.faces)
    assert area[(up < 0).any(axis=1)].sum() < 0.02 * area.sum()


def test_plain_acvd_looks_at_positions_alone():
    """Each vertex is nearest to the centroid of its own cluster, or nearly: so it is round, and
    goes around a sleeve.
    """
    V, F = surfaces.tube()
    plain, ours = Patches.cut(V, F, 6, acvd=True), Patches.cut(V, F, 6)
    away = []
    for p in (plain, ours):
        assert len(p) == 6
        x, own = p.vertices, p.vertex_patch
        centre = np.stack([x[own == k].mean(0) for k in range(6)])
        distance = np.linalg.norm(x[:, None] - centre, axis=2)
        away.append((distance.argmin(1) == own).mean())
    assert away[0] > 0.9
    spread = [
        min(np.linalg.eigvalsh(np.cov(p.vertices[p.vertex_patch == k].T))[0] for k in range(6))
        for p in (ours, plain)
    ]
    assert spread[0] < spread[1]  # ours are the flatter ones


def test_a_mesh_is_subdivided_as_often_as_is_asked_for():
    V, F = surfaces.sheet(n=5)
    for levels in (0, 1, 3):
        p = Patches.cut(V, F, 4, levels=levels)
        assert p.levels == levels and len(p.faces) == 4**levels * len(F)


def test_number_of_patches_of_the_paper():
    assert [patch_count(a) for a in (0.1, 0.81, 0.92, 2, 5)] == [100, 101, 115, 250, 400]
    V, F = surfaces.sphere(0.3)  # 1.13 m^2
    assert len(Patches.cut(V, F)) == patch_count(mesh.areas(V, F).sum()) == 140
    many = surfaces.joined(
        *[(x + 0.1 * k, F) for k, (x, F) in enumerate([surfaces.sheet(n=2, size=0.01)] * 120)]
    )
    assert len(Patches.cut(*many)) == 120  # each part needs a patch
    assert len(Patches.cut(*surfaces.sheet(n=5))) == 25  # no more patches than vertices


def test_faces_without_area_double_faces_and_loose_vertices_do_no_harm():
    V, F = surfaces.sphere()
    noisy = np.concatenate([F, F[:5], F[7:9, ::-1], [[3, 3, 5], [4, 4, 4]]])
    p = Patches.cut(V, F, 20)
    loose = np.concatenate([[[np.nan, 0, 0]], V, V[:1]])
    q = Patches.cut(loose, noisy + 1, 20)
    assert (p.vertices == q.vertices).all()
    assert (p.given == q.given).all() and (p.label == q.label).all()


def test_the_same_mesh_is_cut_the_same_way():
    a, b = (Patches.cut(*surfaces.tube(), 12) for _ in range(2))
    assert (a.label == b.label).all()


def test_bad_meshes_and_counts_are_named():
    V, F = surfaces.sheet(n=5)
    hole = V.copy()
    hole[7, 1] = np.nan
    for message, args in {
        "no faces; a triangle mesh is needed": (V, F[:0]),
        "1 vertices have coordinates that are not finite (the first is vertex 7": (hole, F),
        "faces name vertices 0 to 24; 0 to 23 exist": (V[:24], F),
        "faces of shape (8, 4)": (V, np.zeros((8, 4), dtype=int)),
        "vertices of shape (25, 2)": (V[:, :2], F),
        "vertices are no array of numbers": ([["x", "y", "z"]] * 25, F),
        "faces are no array of numbers": (V, [[0, 1, 2], [1, 2]]),
        "its faces have no area": (V * (1, 0, 0), F),
        "26 patches; 1 to 25, the number of its vertices, are possible": (V, F, 26),
        "0 patches; 1 to 25": (V, F, 0),
        "2 patches, but it has 3 separate parts": (
            *surfaces.joined(*[(V + k, F) for k in range(3)]),
            2,
        ),
    }.items():
        with pytest.raises(InputError) as error:
            Patches.cut(*args, where="shirt.obj")
        assert str(error.value).startswith("shirt.obj: ") and message in str(error.value)


@pytest.mark.parametrize("shape", ["tube", "sphere"])
def test_loops_smooth_surface_is_that_of_trimesh(shape):
    V, F = getattr(surfaces, shape)()[:2]
    V = V + 0.01 * np.random.default_rng(3).normal(size=V.shape)
    faces, matrix = mesh.subdivided_loop(F, len(V))
    expected, _ = trimesh.remesh.subdivide_loop(V, F)
    fine = matrix @ V
    assert len(fine) == len(expected) and fine[: len(V)] == pytest.approx(expected[: len(V)])
    at = lambda x: x[np.lexsort(np.round(x, 9).T)]  # the middles of edges in any order
    assert at(fine) == pytest.approx(at(expected))
    loose, more = mesh.subdivided_loop(F, len(V) + 2)
    padded = more @ np.concatenate([V, V[:2]])
    assert padded[loose] == pytest.approx(fine[faces])
    assert matrix.sum(1) == pytest.approx(1) and faces.max() == len(fine) - 1
