from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from meshes import turned
from surfaces import joined, sphere

from onefit.body import ClosestSurface, skeleton, skinning
from onefit.garment import LOOSE, TEMPLATES, Garment, standard_body, standard_surface
from onefit.garment.binding import Binding, surface_of
from onefit.garment.reading.mending import mended
from onefit.garment.sewing.patterns import ramp, smooth_union
from onefit.garment.sewing.sew import sewn
from onefit.objective import crossings
from polyfit import mesh
from polyfit.errors import InputError
from polyfit.mesh import loops, vertex_normals

LOOPS = {
    "tshirt": 4,
    "dress": 4,
    "tank": 4,
    "long_sleeve_top": 4,
    "shorts": 3,
    "trousers": 3,
    "jumpsuit": 5,
    "skirt": 2,
}


AREA = {
    "tshirt": 0.6,
    "dress": 1.0,
    "tank": 0.4,
    "long_sleeve_top": 0.75,
    "shorts": 0.45,
    "trousers": 0.85,
    "jumpsuit": 1.25,
    "skirt": 0.8,
}  # [m^2]


def edge_lengths(V, F):
    e = mesh.edges_of(F)[0]
    return np.linalg.norm(V[e[:, 0]] - V[e[:, 1]], axis=1)


@pytest.mark.parametrize("name", [*TEMPLATES, *LOOSE])
def test_no_template_passes_through_itself(name):
    """One place where it does grows to dozens in motion."""
    garment = Garment.template(name)
    assert crossings(garment.vertices.numpy(), garment.faces.numpy()) == 0


class TestTemplates:
    @pytest.fixture(params=TEMPLATES)
    def garment(self, request, templates):
        return templates[request.param]

    def test_is_one_clean_sheet_with_its_openings(self, garment):
        V, F = garment.vertices.double().numpy(), garment.faces.numpy()
        assert 2000 <= len(garment) <= 12000
        _W, G, told = mended(V, F)
        assert told == () and np.array_equal(G, F)
        found = loops(F)
        assert len(found) == LOOPS[garment.name]
        # 2 - 2 g - loops, g = 0: a sphere with holes, no handle
        assert len(V) - len(mesh.edges_of(F)[0]) + len(F) == 2 - len(found)
        assert mesh.areas(V, F).sum() == pytest.approx(AREA[garment.name], rel=0.1)

    def test_triangles_are_even_and_loops_smooth(self, garment):
        V, F = garment.vertices.double().numpy(), garment.faces.numpy()
        side = np.roll(V[F], -1, axis=1) - V[F]
        length = np.linalg.norm(side, axis=2)
        angle = np.degrees(
            np.arccos(
                -(side * np.roll(side, 1, axis=1)).sum(axis=2) / length / np.roll(length, 1, axis=1)
            )
        )
        assert angle.min() > 20 and np.percentile(angle.min(axis=1), 1) > 35
        assert length.max() < 2.2 * np.median(length) and length.min() > 0.3 * np.median(length)
        for loop in loops(F):
            step = np.roll(V[loop], -1, axis=0) - V[loop]
            step /= np.linalg.norm(step, axis=1, keepdims=True)
            turn = np.degrees(
                np.arccos(np.clip((step * np.roll(step, 1, axis=0)).sum(axis=1), -1, 1))
            )
            assert turn.max() < 45

    def test_lies_outside_the_body_with_its_outer_side_out(self, garment):
        V, F = garment.vertices.numpy(), garment.faces.numpy()
        found = standard_surface()(V)
        assert found.distance.min() > 0.004
        assert standard_surface()(V[F].mean(axis=1)).distance.min() > 0.003
        assert ((found.normal * vertex_normals(V, F)).sum(axis=1) > 0).mean() > 0.999
        if garment.name not in ("dress", "skirt"):
            assert found.distance.max() < 0.04

    def test_blend_weights_are_shares_and_no_edge_is_torn_by_a_turned_limb(self, garment):
        assert (
            garment.blend_weights.shape == (len(garment), 24) and garment.blend_weights.min() >= 0
        )
        assert torch.allclose(garment.blend_weights.sum(1), torch.ones(len(garment)), atol=1e-5)
        F, body = garment.faces.numpy(), standard_body()
        rest = edge_lengths(garment.vertices.numpy(), F)
        raw = torch.as_tensor(
            Binding(garment.vertices.double().numpy(), F).on_body(body.blend_weights.numpy())
        ).float()
        worst = {"smoothed": 0, "raw": 0}
        for joint in ("left_shoulder", "left_hip"):
            for axis in np.eye(3):
                pose = body.rest_pose.clone()
                pose[skeleton.INDEX[joint]] = turned(
                    pose[skeleton.INDEX[joint]], np.radians(40) * axis
                )
                maps = skinning.transforms(body, pose[None], torch.zeros(1, 3))
                for key, weights in (("smoothed", garment.blend_weights), ("raw", raw)):
                    moved = skinning.skin(garment.vertices, weights, maps)[0].numpy()
                    worst[key] = max(worst[key], (edge_lengths(moved, F) / rest).max())
        assert worst["smoothed"] < 3.5
        assert worst["smoothed"] < 0.75 * worst["raw"]

    def test_follows_the_shape_without_entering_the_body(self, garment, anny):
        assert torch.allclose(garment.graded(standard_body()), garment.vertices, atol=1e-6)
        rng = np.random.default_rng(11)
        for _ in range(4):
            body = anny.body(anny.random_shape(rng))
            moved = garment.graded(body).numpy()
            distance = surface_of(body)(moved).distance
            assert (distance < 0).mean() < 0.001 and distance.min() > -0.001
            assert (
                np.abs(distance - standard_surface()(garment.vertices.numpy()).distance).mean()
                < 0.01
            )


@pytest.mark.parametrize("name, times", [("tshirt", 4), ("shorts", 0.4)])
def test_at_another_resolution_is_the_same_garment(templates, name, times):
    garment = templates[name]
    count = times * len(garment)
    other = garment.remeshed(count)
    V, F = other.vertices.double().numpy(), other.faces.numpy()
    assert (
        0.9 * count < len(other) < 1.1 * count
        and len(loops(F)) == LOOPS[name]
        and mended(V, F)[2] == ()
    )
    W, G = garment.vertices.double().numpy(), garment.faces.numpy()
    area, area_was = mesh.areas(V, F), mesh.areas(W, G)
    assert area.sum() == pytest.approx(area_was.sum(), rel=0.01)
    assert (
        np.abs(ClosestSurface(W, G)(V).distance).max() < 0.005
        and np.abs(ClosestSurface(V, F)(W).distance).max() < 0.02
    )
    share = lambda g, area, F: area @ g.blend_weights.numpy()[F].mean(axis=1) / area.sum()
    assert share(other, area, F) == pytest.approx(share(garment, area_was, G), abs=0.005)


@pytest.mark.parametrize("name, count", [("tshirt", 100), ("shirt", 200)])
def test_too_few_vertices_for_a_sleeve(templates, name, count):
    garment = templates[name] if name in templates else Garment.template(name)
    with pytest.raises(
        InputError, match=f"^{name}: count = {count} vertices are too few, a sleeve"
    ):
        garment.remeshed(count)
    other = garment.remeshed(2 * count)
    assert mesh.areas(other.vertices.numpy(), other.faces.numpy()).min() > 1e-6


def test_grading_to_a_body_of_other_topology(templates, anny):
    body = anny.body(anny.random_shape(np.random.default_rng(8)))
    faces, edges = mesh.subdivided(body.faces.numpy())
    finer = lambda x: torch.as_tensor(np.concatenate([x.numpy(), x.numpy()[edges].mean(axis=1)]))
    order = torch.randperm(
        len(body.vertices) + len(edges), generator=torch.Generator().manual_seed(0)
    )
    place = torch.argsort(order)
    vertices, weights = finer(body.vertices)[order], finer(body.blend_weights)[order]
    other = replace(
        body,
        kind="other",
        vertices=vertices,
        blend_weights=weights,
        faces=place[torch.as_tensor(faces)],
    )
    garment = templates["tshirt"]
    difference = (garment.graded(other) - garment.graded(body)).norm(dim=1)
    assert difference.mean() < 0.012 and difference.max() < 0.03
    assert surface_of(body)(garment.graded(other).numpy()).distance.min() > 0


def test_unknown_template():
    with pytest.raises(InputError, match="there are tshirt, dress"):
        Garment.template("kilt")


def test_shorts_are_sewn_as_the_template_was(templates, block):
    V, F = sewn(block, "shorts")
    assert abs(len(V) - len(templates["shorts"])) <= 5 and len(loops(F)) == 3
    far = np.abs(ClosestSurface(V, F)(templates["shorts"].vertices.numpy()).distance)
    assert far.mean() < 0.001 and np.percentile(far, 99) < 0.005 and far.max() < 0.016


def test_smooth_union_is_the_minimum_away_from_the_fillet():
    a, b = np.array([0.1, 0.0, 0.3, 0.2]), np.array([0.2, 0.1, 0.3, 0.21])
    got = smooth_union(a, b, 0.05)
    assert (
        got[:2] == pytest.approx([0.1, 0.0])
        and got[2] == pytest.approx(0.3 - 0.05 / 4)
        and 0.2 - 0.0125 < got[3] < 0.2
    )
    assert ramp(np.array([-1, 0, 0.5, 1, 2.0]), 0, 1) == pytest.approx([0, 0, 0.5, 1, 1])


def test_nearest_points_and_sides():
    V, F = joined(sphere(0.2, 2), (sphere(0.1, 2)[0] + [0.5, 0, 0], sphere(0.1, 2)[1]))
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-0.4, 0.8, (300, 3)), V[::9], V[F[::7]].mean(axis=1)])
    got = ClosestSurface(V, F)(x)
    slow = trimesh.proximity.closest_point_naive(trimesh.Trimesh(V, F, process=False), x)[1]
    assert np.abs(np.abs(got.distance) - slow).max() < 1e-6
    # inside a polyhedron that is star-shaped about its centre: below the face that the ray from
    # there meets
    inside = np.zeros(len(x), dtype=bool)
    for centre in ([0, 0, 0], [0.5, 0, 0]):
        inside |= winding_number(x - centre, V[F] - centre) > 0.5
    far = slow > 1e-5
    assert np.array_equal((got.distance < 0)[far], inside[far]) and inside.sum() > 5
    assert np.allclose(
        np.einsum("nk,nkd->nd", got.barycentric, V[F[got.face]]), got.point, atol=1e-6
    )
    missed = ClosestSurface(V, F)(np.array([[3.0, 0, 0]]), reach=1.0)
    assert missed.face[0] == -1 and missed.distance[0] == 1.0 and np.isnan(missed.point).all()
    # a mesh that moves there, and tensors
    surface = ClosestSurface(V @ [[0.5, 0, 0], [0, 2, 0], [0.3, 0, 1]], F)
    surface.follow(torch.as_tensor(V))
    assert np.array_equal(surface.vertices, V.astype(np.float32))
    moved = surface(torch.as_tensor(x))
    assert torch.allclose(moved.distance, torch.as_tensor(got.distance), atol=1e-6)


def test_pseudonormals_of_a_cube():
    # whatever way its sides are cut in two
    cube = trimesh.creation.box((2, 2, 2))
    edge, half = (
        np.array([[1, 1, 0], [0, -1, 1], [-1, 0, -1.0]]),
        0.3 * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    )
    x = np.concatenate([cube.vertices, edge + half, [[1, 0.2, 0.1], [0.1, -1, 0.4]]])
    expected = np.concatenate([cube.vertices, edge, [[1, 0, 0], [0, -1, 0]]])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = ClosestSurface(cube.vertices, cube.faces)(x + 0.2 * expected)
    assert np.allclose(found.distance, 0.2, atol=1e-6) and np.allclose(
        found.normal, expected, atol=1e-5
    )


def test_points_between_the_legs_are_outside():
    # on the plane of symmetry both legs are equally near
    surface = standard_surface()
    x = np.random.default_rng(0).uniform([0, -0.15, -0.8], [0, 0.15, -0.05], (100, 3))
    inside = winding_number(x, surface.vertices.astype(np.float64)[surface.faces]) > 0.5
    assert np.array_equal(surface(x).distance < 0, inside) and inside.mean() < 0.1


def winding_number(x, T):
    """Sum of the solid angles of the triangles (Van Oosterom and Strackee) over 4 pi."""
    a, b, c = (T[None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    top = np.einsum("nfd,nfd->nf", a, np.cross(b, c))
    bottom = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return 2 * np.arctan2(top, bottom).sum(axis=1) / (4 * np.pi)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda path: Garment.named("tank", scale=2.0), "'tank': scale is for files; this is a"),
        (lambda path: Garment.named("tank", foo=2), "'tank': foo is for files; this is a template"),
        (lambda path: Garment.named(None), "garment of type NoneType; a file's name is needed"),
        (lambda path: Garment.read(path, scale="1"), "scale='1'; more than 0 is needed"),
        (lambda path: Garment.read(path, turn="a"), "turn='a', offset=.*; finite numbers are"),
        (lambda path: Garment.read(path, offset=None), "offset=None; three numbers"),
        (lambda path: Garment.read(path, count="300"), "count = 300: 100 to 1,000,000 vertices"),
    ],
)
def test_what_a_garment_cannot_be_read_with_is_named(templates, tmp_path, call, message):
    path, tank = tmp_path / "tank.ply", templates["tank"]
    mesh.write_ply(path, tank.vertices, tank.faces)
    with pytest.raises(InputError, match=message):
        call(path)


def test_options_of_many_are_for_those_that_are_files(templates, tmp_path):
    path, tank = tmp_path / "large.ply", templates["tank"]
    mesh.write_ply(path, 100 * tank.vertices, tank.faces)
    one, other = Garment.all_named(["tank", path], scale=0.01)
    assert (one.vertices - other.vertices).abs().max() < 1e-4


def test_texture_coordinates_of_another_mesh_are_refused(templates):
    V, F = (x.numpy() for x in (templates["tank"].vertices, templates["tank"].faces))
    with pytest.raises(InputError, match="^garment: texture coordinates .* are needed"):
        Garment.of_mesh("tank", V, F, mesh.TexCoords(V[:, :2], F[1:]))
    with pytest.raises(InputError, match="^garment: faces name texture coordinates"):
        Garment.of_mesh("tank", V, F, mesh.TexCoords(V[:100, :2], F))


def test_a_garment_that_its_constructor_made_is_told():
    tank = Garment.template("tank")
    bare = Garment("bare", tank.vertices, tank.faces, tank.blend_weights)
    with pytest.raises(InputError, match="made by its constructor; Garment.of_mesh makes one"):
        bare.graded(standard_body())


@pytest.mark.parametrize("name", ["skirt", "circle_skirt", "dress"])
def test_what_hangs_on_nothing_is_not_worn(name):
    """A skirt of a body that stands on the ground is around the head."""
    skirt = Garment.template(name)
    raised = skirt.vertices.double().numpy() + (0, 0, 0.82)
    with pytest.raises(InputError, match="on a body that stands on the ground.*--offset 0 0 -0.82"):
        Garment.of_mesh(name, raised, skirt.faces.numpy())
