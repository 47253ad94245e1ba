"""Patched surfaces: meshes to patches and charts and back, at any resolution, and their
derivatives.
"""

import dataclasses

import numpy as np
import pytest
import surfaces
import torch
import trimesh
from scipy.spatial.transform import Rotation

from polyfit import (
    CanonicalFrame,
    InputError,
    PatchedSurface,
    Patches,
    PolyFit,
    mesh,
    patch_count,
    read_mesh,
    smoothed,
)

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def ball():
    return PatchedSurface.from_mesh(*surfaces.sphere(0.2), 20, dtype=torch.float64)


@pytest.fixture(scope="module")
def sleeve():
    V, F = surfaces.tube()
    V[:, 0] += 0.003 * np.sin(40 * V[:, 2])
    return PatchedSurface.from_mesh(V, F, 8, dtype=torch.float64)


def places(surface, count=300):
    """Points inside the charts: patches (P,) and uv (P, 2)."""
    entry = torch.as_tensor(RNG.integers(len(surface.uv), size=count))
    return torch.as_tensor(surface.patches.entry_patch)[entry], surface.uv[entry]


def on_mesh(surface, count=500):
    F = surface.patches.given
    return RNG.integers(len(F), size=count), RNG.dirichlet((1, 1, 1), count)


def test_a_plane_is_held_exactly():
    V, F = surfaces.sheet(n=7)
    surface = PatchedSurface.from_mesh(
        V @ Rotation.random(random_state=1).as_matrix() + 3, F, 5, dtype=torch.float64
    )
    assert (surface.vertices() - torch.as_tensor(surface.patches.vertices)).abs().max() < 1e-12
    vertices, faces = surface.resampled(3)
    assert mesh.areas(vertices.numpy(), faces.numpy()).sum() == pytest.approx(
        mesh.areas(V, F).sum()
    )
    assert surface.parameters == 5 * 22


@pytest.mark.parametrize("face", [-1, 10**6])
def test_a_face_that_is_not_there_is_told(ball, face):
    with pytest.raises(InputError, match=f"faces {face} to {face}; 0 to"):
        ball.at([face], [[1.0, 0, 0]])


def test_vertices_come_back(ball, sleeve):
    for surface, bound in ((ball, 1e-3), (sleeve, 3e-3)):
        V = torch.as_tensor(surface.patches.vertices)
        assert (surface.vertices() - V).norm(dim=1).max() < bound
        assert (surface.points(surface.vertex_patch, surface.vertex_uv) - V).norm(
            dim=1
        ).max() < bound
        face = np.arange(len(surface.patches.given))
        corners = surface.at(face, np.tile([[1.0, 0, 0]], (len(face), 1)))
        assert (
            corners - surface.vertices()[torch.as_tensor(surface.patches.given[:, 0])]
        ).abs().max() < 1e-12


def test_resampling_keeps_the_mesh_whole(ball):
    vertices, faces = ball.resampled(3)
    fine = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert fine.is_watertight and fine.is_winding_consistent
    assert len(faces) == 9 * len(ball.patches.given)
    assert np.abs(np.linalg.norm(fine.vertices, axis=1) - 0.2).max() < 2e-3
    given = len(trimesh.creation.icosphere(subdivisions=3).vertices)
    assert (vertices[:given] - ball.vertices()[:given]).abs().max() < 1e-12


def test_surface_is_smoother_than_its_mesh():
    """Jets fitted to a coarse sphere, evaluated at four times its resolution, are nearer to the
    sphere's normals than its facets are.
    """
    V, F = surfaces.sphere(0.2, 2)
    vertices, faces = PatchedSurface.from_mesh(V, F, 20, dtype=torch.float64).resampled(4)

    def angle(V, F):
        n, middle = mesh.face_vectors(V, F), V[F].mean(axis=1)
        cosine = (n * middle).sum(1) / np.linalg.norm(n, axis=1) / np.linalg.norm(middle, axis=1)
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    fine = np.einsum("nj,njc->nc", mesh.refined(F, 4)[2], V[F[mesh.refined(F, 4)[1]]])
    assert angle(vertices.numpy(), faces.numpy()).mean() < 0.5 * angle(fine, faces.numpy()).mean()


def test_neighbours_join_without_a_gap(sleeve):
    """Points of an edge, seen from the faces on its two sides."""
    F = sleeve.patches.given
    edges, side = mesh.edges_of(F)
    order = np.argsort(side.ravel(), kind="stable")
    twice = np.flatnonzero(np.bincount(side.ravel()) == 2)
    first = (np.cumsum(np.bincount(side.ravel())) - np.bincount(side.ravel()))[twice]
    t, found = RNG.random(len(twice)), []
    for corner in (order[first], order[first + 1]):
        face, k = corner // 3, corner % 3
        forward = F[face, k] == edges[twice, 0]
        b = np.zeros((len(face), 3))
        b[np.arange(len(face)), k], b[np.arange(len(face)), (k + 1) % 3] = (
            np.where(forward, t, 1 - t),
            np.where(forward, 1 - t, t),
        )
        found.append(sleeve.at(face, b))
    assert (found[0] - found[1]).norm(dim=1).max() < 1e-12


def test_sample_is_on_the_surface_and_even(sleeve):
    points, normals = sleeve.sample(4000, what=("points", "normals"))
    V, F = sleeve.patches.vertices[: len(surfaces.tube()[0])], sleeve.patches.given
    _closest, distance, face = trimesh.proximity.closest_point_naive(
        trimesh.Trimesh(V, F, process=False), points[:300].numpy()
    )
    assert np.sqrt((distance**2).mean()) < 5e-4
    outwards = mesh.face_vectors(V, F)[face]
    assert (
        (normals[:300].numpy() * outwards).sum(axis=1) > 0.8 * np.linalg.norm(outwards, axis=1)
    ).all()
    height = points[:, 2].numpy() / 0.4
    assert np.histogram(height, 8, (0, 1))[0] == pytest.approx(np.full(8, 500), abs=100)


def test_tangents_normals_and_metric_against_finite_differences(sleeve):
    patch, uv = places(sleeve)
    tangents, h = sleeve.tangents(patch, uv), 1e-6
    for k, t in enumerate(tangents):
        step = torch.eye(2, dtype=torch.float64)[k] * h
        numeric = (sleeve.points(patch, uv + step) - sleeve.points(patch, uv - step)) / (2 * h)
        assert (t - numeric).abs().max() < 1e-6 * numeric.abs().max()
    n = torch.nn.functional.normalize(torch.linalg.cross(*tangents), dim=-1)
    assert (sleeve.normals(patch, uv) - n).abs().max() < 1e-9
    J = torch.stack(tangents, -1)
    assert (sleeve.metric(patch, uv) - J.mT @ J).abs().max() < 1e-12


def test_curvature_of_a_sphere(ball):
    k = ball.principal_curvatures(ball.vertex_patch, ball.vertex_uv)
    inside = torch.ones(len(k), dtype=torch.bool)
    inside[torch.as_tensor(np.unique(ball.patches.faces[ball.patches.on_boundary]))] = False
    assert k[inside].mean().item() == pytest.approx(-5, rel=0.02)  # 1 / 0.2 m, away from the normal
    assert (k[inside] + 5).abs().median() < 0.6  # of facets, fitted by jets of order 4


def test_normals_are_on_the_side_of_the_faces(ball):
    outwards = (
        ball.normals(ball.vertex_patch, ball.vertex_uv) * torch.as_tensor(ball.patches.vertices)
    ).sum(1)
    assert (outwards > 0.19).all()
    V, F = surfaces.sphere(0.2)
    inverse = PatchedSurface.from_mesh(V, F[:, ::-1], 20, dtype=torch.float64)
    assert (
        (
            inverse.normals(inverse.vertex_patch, inverse.vertex_uv)
            * torch.as_tensor(inverse.patches.vertices)
        ).sum(1)
        < -0.19
    ).all()


def test_normals_agree_where_the_winding_does_not():
    V, F = surfaces.sphere(0.2)
    F = np.where(np.random.default_rng(1).random(len(F))[:, None] < 0.3, F[:, ::-1], F)
    mixed = PatchedSurface.from_mesh(V, F, 20, dtype=torch.float64)
    outwards = (
        mixed.normals(mixed.vertex_patch, mixed.vertex_uv) * torch.as_tensor(mixed.patches.vertices)
    ).sum(1)
    assert (outwards > 0.19).all()


def test_boundary_points_of_two_patches_are_the_same_place(sleeve):
    points, normals = sleeve.boundary()
    assert points.shape == normals.shape == (len(sleeve.patches.boundary), 2, 3)
    assert (points[:, 0] - points[:, 1]).norm(dim=1).square().mean().sqrt() < 1e-3
    assert (normals[:, 0] * normals[:, 1]).sum(1).mean() > 0.98
    one = points[:, 0] - torch.as_tensor(
        sleeve.patches.vertices[sleeve.patches.entry_vertex[sleeve.patches.boundary[:, 0]]]
    )
    assert one.norm(dim=1).max() < 5e-3
    assert (sleeve.boundary_patch[:, 0] < sleeve.boundary_patch[:, 1]).all()


def test_gradients_against_finite_differences():
    surface = PatchedSurface.fit(
        Patches.cut(*surfaces.sheet(lambda x, y: x * y, n=4), 3), dtype=torch.float64
    )
    face, b = on_mesh(surface, 20)
    names = {
        "alpha": surface.alpha,
        "s": surface.frame.s,
        "R": surface.frame.R,
        "T": surface.frame.T,
    }

    def values(alpha, s, R, T):
        moved = dataclasses.replace(surface, alpha=alpha, frame=CanonicalFrame(s, R, T))
        return (
            moved.at(face, b),
            moved.at(face, b, "normals"),
            *moved.boundary(),
            moved.resampled(2, smoothing=1)[0],
        )

    assert torch.autograd.gradcheck(
        values, [x.clone().requires_grad_() for x in names.values()], fast_mode=True
    )


def test_smoothing_moves_seams_only_and_keeps_the_outline_in_place():
    V, F = surfaces.sheet(n=21)
    rough, where = (
        torch.as_tensor(V + RNG.normal(size=V.shape) * (0, 0, 0.005)),
        torch.zeros(len(V), dtype=torch.bool),
    )
    where[torch.as_tensor(np.abs(V[:, 0]) < 0.1)] = True
    faces = torch.as_tensor(F)
    smooth = smoothed(rough, faces, where, 20)
    assert torch.equal(smooth[~where], rough[~where])
    assert smooth[where][:, 2].std() < 0.5 * rough[where][:, 2].std()
    assert smooth[:, 1].min() == -0.3 and smooth[:, 1].max() == 0.3  # not drawn in at the rim
    assert torch.equal(smoothed(rough, faces, where, 0), rough)
    one = smoothed(rough, faces, where, 1)
    k = int(torch.as_tensor(np.hypot(V[:, 0], V[:, 1])).argmin())
    around = np.unique(F[(k == F).any(axis=1)])
    mean = rough[torch.as_tensor(around[around != k])].mean(0)
    assert (one[k] - (rough[k] + mean) / 2).abs().max() < 1e-12


def test_smoothing_closes_torn_seams(sleeve):
    """Patches moved by a millimetre each: the seams' steps become ramps."""
    T = sleeve.frame.T + 1e-3 * torch.as_tensor(RNG.normal(size=sleeve.frame.T.shape))
    torn = dataclasses.replace(sleeve, frame=CanonicalFrame(sleeve.frame.s, sleeve.frame.R, T))

    def bend(smoothing):
        V, F = (x.numpy() for x in torn.resampled(4, smoothing))
        pairs = trimesh.Trimesh(V, F, process=False)
        return np.percentile(pairs.face_adjacency_angles, 99)

    assert bend(3) < 0.7 * bend(0)


def test_moved_boundaries_fit_better_and_stay_connected():
    V, F = surfaces.sheet(
        lambda x, y: 0.1 * np.exp(-((x - 0.05) ** 2 + (y + 0.02) ** 2) / 0.004), n=40
    )
    before, after = PatchedSurface.fit(Patches.cut(V, F, 12)), PatchedSurface.from_mesh(V, F, 12)
    rms = [
        (s.residual.square() * torch.as_tensor(s.patches.entry_weight)).sum().sqrt()
        for s in (before, after)
    ]
    assert rms[1] < 0.8 * rms[0]
    p = after.patches
    edges = mesh.edges_of(p.sheets)[0]
    assert (
        mesh.components(len(p.label), edges[p.label[edges[:, 0]] == p.label[edges[:, 1]]]).max() + 1
        == len(after)
        == 12
    )


@pytest.mark.parametrize("name", ["fin", "moebius", "parts"])
def test_what_is_no_manifold_is_held_as_well(name):
    V, F = {
        "fin": surfaces.with_fin,
        "moebius": surfaces.moebius,
        "parts": lambda: surfaces.joined(
            surfaces.sphere(subdivisions=2), surfaces.sheet(n=2, size=1e-3), surfaces.tube(0.03)
        ),
    }[name]()
    surface = PatchedSurface.from_mesh(V, F, 30, dtype=torch.float64)
    assert surface.alpha.isfinite().all() and len(surface) == 30
    distance = (surface.vertices() - torch.as_tensor(surface.patches.vertices)).norm(dim=1)
    assert distance.square().mean().sqrt() < 1e-3


def test_a_tiny_closed_part_stays_in_its_place():
    """One patch cannot hold a closed ball, but neither does it harm the rest."""
    V, F = surfaces.joined(surfaces.sphere(0.2, 2), surfaces.sphere(0.005, 0))
    surface = PatchedSurface.from_mesh(V, F, 20)
    off = (
        surface.vertices() - torch.as_tensor(surface.patches.vertices, dtype=torch.float32)
    ).norm(dim=1)
    tiny = torch.as_tensor(np.linalg.norm(surface.patches.vertices, axis=1) < 0.1)
    assert off[tiny].max() < 0.01 and off[~tiny].square().mean().sqrt() < 1e-3


def test_polyfit_may_choose_frames_and_order():
    surface = PatchedSurface.from_mesh(*surfaces.tube(), 8, polyfit=PolyFit(3))
    plain = PatchedSurface.from_mesh(*surfaces.tube(), 8, 3)
    assert surface.alpha.shape == (8, 10)
    assert (surface.vertices() - plain.vertices()).abs().max() < 1e-4
    model = PolyFit.pretrained().requires_grad_(False)
    both = [PatchedSurface.from_mesh(*surfaces.tube(), 4, polyfit=p) for p in (model, None)]
    rms = [s.residual.square().mean().sqrt() for s in both]
    assert rms[0] < 1.5 * rms[1]


def test_surface_moves_to_another_type(ball):
    single = ball.to(torch.float32)
    assert single.vertices().dtype == torch.float32
    assert (single.vertices() - ball.vertices()).abs().max() < 1e-6


@pytest.mark.parametrize(
    "garment",
    ["garments_snug/shorts", "garments_snug/pants", "garments_makehuman/m_shirt_wrinkled"],
)
def test_real_garments(shared_data, garment):
    V, F, _ = read_mesh(shared_data / f"{garment}.obj")
    surface = PatchedSurface.from_mesh(V, F)
    assert len(surface) == patch_count(mesh.areas(V, F).sum())
    rms = (
        (surface.vertices() - torch.as_tensor(surface.patches.vertices, dtype=torch.float32))
        .square()
        .sum(1)
        .mean()
        .sqrt()
    )
    assert rms < (1.5e-3 if "wrinkled" in garment else 6e-4)


def test_bad_input_is_named():
    V, F = surfaces.sheet(n=4)
    with pytest.raises(InputError, match="order = 0; the order of a jet is 1 to 10"):
        PatchedSurface.from_mesh(V, F, 2, order=0)
    with pytest.raises(InputError, match="mesh: 2.5 patches; a whole number is needed"):
        PatchedSurface.from_mesh(V, F, 2.5)
    for wrong in F + 0.5, np.nan * F:
        with pytest.raises(InputError, match="mesh: faces are not whole numbers"):
            PatchedSurface.from_mesh(V, wrong)
    with pytest.raises(InputError, match="mesh: no faces"):
        PatchedSurface.from_mesh(V, F[:0])
    with pytest.raises(TypeError, match="unexpected keyword argument 'patches'"):
        PatchedSurface.from_mesh(V, F, patches=2)
    for wrong in ("sheet.obj", F), (torch.tensor(V, requires_grad=True), F):
        with pytest.raises(InputError, match="mesh: vertices are no array of numbers"):
            PatchedSurface.from_mesh(*wrong)
    surface = PatchedSurface.from_mesh(V, F, 2)
    for parts in 0, 2.5:
        with pytest.raises(InputError, match=f"parts = {parts}; a whole number, 1 or more"):
            surface.resampled(parts)
    with pytest.raises(InputError, match=r"barycentric \(1, 2\); \(P,\) and \(P, 3\) are needed"):
        surface.at([0], [[0.5, 0.5]])
    with pytest.raises(InputError, match="what = 'colours'; points or normals is needed"):
        surface.sample(1, what=("colours",))
    for face, barycentric, said in (
        ([0], [[1, 1, 1]], "barycentric: rows of finite numbers that sum to 1"),
        ([0], [[np.nan, 0, 1]], "barycentric: rows of finite numbers that sum to 1"),
        ([0.7], [[1, 0, 0]], "faces: whole numbers"),
        (["0"], [[1, 0, 0]], "faces: whole numbers"),
    ):
        with pytest.raises(InputError, match=said):
            surface.at(face, barycentric)
    with pytest.raises(InputError, match="patches -1 to -1; 0 to 1 exist"):
        surface.points(torch.tensor([-1]), torch.zeros(1, 2))
    vertices, faces = surface.resampled(2.0, smoothing=1.0)
    for where in torch.ones(len(vertices)).long(), torch.ones(3).bool():
        with pytest.raises(InputError, match=rf"; \({len(vertices)},\) of bool is needed"):
            smoothed(vertices, faces, where)
    assert torch.equal(surface.resampled(2, 1)[0], vertices)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, m: s.resampled("4"), "parts = '4'; a whole number, 1 or more, is needed"),
        (lambda s, m: s.resampled(None), "parts = None; a whole number, 1 or more, is needed"),
        (lambda s, m: s.resampled(smoothing="4"), "smoothing = '4'; a whole number, 0 or more"),
        (lambda s, m: s.sample(-1), "count = -1; a whole number, 0 or more"),
        (lambda s, m: s.from_mesh(*m, np.nan), "nan patches; a whole number is needed"),
        (lambda s, m: s.from_mesh(*m, "2"), "2 patches; a whole number is needed"),
        (lambda s, m: s.from_mesh(*m, 2, rounds="a"), "rounds = 'a'; a whole number, 0 or more"),
        (lambda s, m: s.from_mesh(*m, 2, device="gpu"), "device = 'gpu'; one that this torch has"),
        (lambda s, m: s.from_mesh(*m, 2, device="cuda:99"), "device = 'cuda:99'; one that this"),
        (lambda s, m: s.from_mesh(*m, 2, dtype="float64"), "dtype = 'float64'; torch.float32 or"),
        (lambda s, m: s.from_mesh(*m, 2, polyfit="paper"), "polyfit = 'paper'; a PolyFit"),
        (lambda s, m: read_mesh(None), "mesh of type NoneType; a file's name is needed"),
    ],
)
def test_arguments_of_another_kind_are_named(call, message):
    sheet = surfaces.sheet(n=4)
    surface = PatchedSurface.from_mesh(*sheet, 2.0, 4.0, rounds=0.0)
    with pytest.raises(InputError, match=message):
        call(surface, sheet)
