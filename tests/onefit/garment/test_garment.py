import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from surfaces import joined, sphere, tube

from onefit.body import AnnyBody, ClosestSurface, skeleton, skinning
from onefit.garment import TEMPLATES, Garment, fitting, standard_body, standard_surface
from onefit.garment.binding import Binding, surface_of, vertex_normals
from onefit.garment.mending import mended
from onefit.garment.remesh import loops
from onefit.garment.sewing.block import Block
from onefit.garment.sewing.patterns import ramp, smooth_union
from onefit.garment.sewing.sew import sewn
from polyfit import mesh, write_ply
from polyfit.errors import InputError

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


@pytest.fixture(scope="module")
def templates():
    return {name: Garment.template(name) for name in TEMPLATES}


@pytest.fixture(scope="module")
def tank(templates):
    g = templates["tank"]
    return g.vertices.double().numpy(), g.faces.numpy()


@pytest.fixture(scope="module")
def anny():
    return AnnyBody()


def edge_lengths(V, F):
    e = mesh.edges_of(F)[0]
    return np.linalg.norm(V[e[:, 0]] - V[e[:, 1]], axis=1)


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


def turned(vector, by):
    from scipy.spatial.transform import Rotation

    return torch.as_tensor(
        (Rotation.from_rotvec(by) * Rotation.from_rotvec(vector.numpy())).as_rotvec()
    ).float()


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


def test_shorts_are_sewn_as_the_template_was(templates):
    body = standard_body()
    block = Block(
        body.vertices.numpy(), body.faces.numpy(), spacing=0.016
    )  # twice as coarse, several times as fast
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
    slow = np.array([distance_to_triangles(p, V[F]) for p in x])
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
    import trimesh

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


def distance_to_triangles(p, T):
    """Slow: the nearest of the plane's foot, where it is inside, and of the three sides."""
    n = np.cross(T[:, 1] - T[:, 0], T[:, 2] - T[:, 0])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    height = ((p - T[:, 0]) * n).sum(axis=1)
    foot = p - height[:, None] * n
    within = np.all(
        [
            (np.cross(T[:, (k + 1) % 3] - T[:, k], foot - T[:, k]) * n).sum(axis=1) >= 0
            for k in range(3)
        ],
        axis=0,
    )
    best = np.abs(height[within]).min(initial=np.inf)
    for k in range(3):
        a, d = T[:, k], T[:, (k + 1) % 3] - T[:, k]
        t = np.clip(((p - a) * d).sum(axis=1) / (d * d).sum(axis=1), 0, 1)
        best = min(best, np.linalg.norm(p - a - t[:, None] * d, axis=1).min())
    return best


def winding_number(x, T):
    """Sum of the solid angles of the triangles (Van Oosterom and Strackee) over 4 pi."""
    a, b, c = (T[None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    top = np.einsum("nfd,nfd->nf", a, np.cross(b, c))
    bottom = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return 2 * np.arctan2(top, bottom).sum(axis=1) / (4 * np.pi)


def soup(V, F):
    """Every face with vertices of its own."""
    return V[F.ravel()], np.arange(F.size).reshape(-1, 3)


def punched(V, F, at, faces=1):
    """Without the faces nearest to vertex ``at``."""
    d = np.linalg.norm(V[F].mean(axis=1) - V[at], axis=1)
    return V, np.delete(F, np.argsort(d, kind="stable")[:faces], axis=0)


def flipped(F, rows):
    G = F.copy()
    G[rows] = G[rows, ::-1]
    return G


class TestRepairs:
    """Each case is made from the tank top; what reading says of it, and that the tank top comes
    out.
    """

    def check(self, V, F, *said):
        g = Garment.of_mesh("case", V, F)
        assert len(g.repairs) == len(said), g.repairs
        for sentence, expected in zip(g.repairs, said):
            assert re.search(expected, sentence), (sentence, expected)
        assert (
            len(loops(g.faces.numpy())) == 4
            and mended(g.vertices.double().numpy(), g.faces.numpy())[2] == ()
        )
        assert standard_surface()(g.vertices.numpy()).distance.min() > 0
        agree = (
            standard_surface()(g.vertices.numpy()).normal
            * vertex_normals(g.vertices.numpy(), g.faces.numpy())
        ).sum(axis=1)
        assert (agree > 0).mean() > 0.999
        return g

    def test_a_clean_one_is_left_alone(self, tank):
        V, F = tank
        g = self.check(V, F)
        assert np.allclose(g.vertices.numpy(), V, atol=1e-7) and np.array_equal(g.faces.numpy(), F)

    def test_vertices_in_no_face_and_faces_without_area(self, tank):
        V, F = tank
        V, F = np.concatenate([[[0, 0, 0], [9, 9, np.nan]], V]), F + 2
        F = np.concatenate([F[:100], [[5, 5, 9]], F[100:], F[40:42]])
        self.check(
            V,
            F,
            "2 vertices that are in no face",
            "1 faces without area",
            "2 faces that repeat others",
        )

    def test_seams_and_soups_are_sewn(self, tank):
        V, F = tank
        g = self.check(*soup(V, F), f"merged {F.size - len(V)} vertices")
        assert len(g) == len(V)

    def test_faces_wound_against_the_others_and_inwards(self, tank):
        V, F = tank
        self.check(V, flipped(F, slice(100, 300)), "turned 200 faces that were wound against")
        self.check(V, F[:, ::-1], f"turned {len(F)} faces that were wound inwards")

    def test_small_holes_are_filled(self, tank):
        V, F = tank
        inner = np.setdiff1d(np.arange(len(V)), np.concatenate(loops(F)))
        at = inner[np.argsort(np.abs(V[inner, 2] - 0.2))[0]]
        g = self.check(*punched(V, F, at), "filled 1 hole of less than 10 cm")
        assert len(g.faces) == len(F)
        self.check(*punched(V, F, at, 5), "filled 1 hole")

    def test_a_pocket_sewn_on_comes_off(self, tank):
        V, F = tank
        # five faces that stand on one side each of five of the front
        front = [
            np.argmin(np.linalg.norm(V[F].mean(axis=1) - [x, -0.14, 0.2], axis=1))
            for x in np.linspace(-0.08, 0.08, 5)
        ]
        outer = V[F[front]].mean(axis=1) + [0, -0.01, 0]
        extra = np.stack([F[front, 0], F[front, 1], len(V) + np.arange(5)], axis=1)
        g = self.check(
            np.concatenate([V, outer]),
            np.concatenate([F, extra]),
            "cut apart at 5 edges",
            "dropped 5 parts of 5 faces",
        )
        assert len(g) == len(V)

    def test_buttons_are_dropped(self, tank):
        button, G = sphere(0.006, 1)
        self.check(
            *joined(tank, (button + [0, -0.16, 0.3], G)), f"dropped a part of {len(G)} faces"
        )

    def test_separate_parts_stay(self, templates, tank):
        shorts = templates["shorts"]
        V, F = joined(tank, (shorts.vertices.double().numpy(), shorts.faces.numpy()))
        g = Garment.of_mesh("both", V, F)
        assert g.repairs == ("has 2 separate parts, which move each for itself",) and len(g) == len(
            V
        )

    def test_parts_that_touch_in_a_point(self, tank):
        V, F = tank
        T, G = tube(0.03, 0.2, 12, 8)
        T = T + V[5] - T[0]
        T, G = joined((V, F), (T, G))
        G[len(V) == G] = 5
        _, _, told = mended(T, G)
        assert any("1 vertices where parts touch in a point" in s for s in told), told

    def test_vertices_inside_the_body_are_pushed_out(self, tank):
        V, F = tank
        found = standard_surface()(V)
        dent = (
            np.linalg.norm(V - V[np.argmin(np.linalg.norm(V - [0, -0.13, 0.2], axis=1))], axis=1)
            < 0.05
        )
        W = V - np.where(dent, found.distance + 0.015, 0)[:, None] * found.normal
        g = self.check(W, F, rf"pushed {dent.sum()} vertices out of the body, by up to 15\.\d mm")
        assert (
            np.abs(g.vertices.numpy() - W)[
                np.linalg.norm(V - V[dent].mean(axis=0), axis=1) > 0.2
            ].max()
            < 0.002
        )


class TestRefusals:
    def refused(self, V, F, match, **how):
        with pytest.raises(InputError, match=match) as error:
            Garment.of_mesh("case", V, F, where="case.obj", **how)
        assert "\n" not in str(error.value) and str(error.value).startswith("case.obj: ")
        return str(error.value)

    def test_meshes_that_are_no_garment(self, tank):
        V, F = tank
        self.refused(V, F[:0], "no faces")
        self.refused(V[:0], F[:0], "no faces")
        W = V.copy()
        W[17, 1] = np.nan
        self.refused(W, F, "1 vertices have coordinates that are not finite .*vertex 17")
        self.refused(np.zeros_like(V), F, "no area")
        loose, G = soup(V, F)
        self.refused(
            loose + np.random.default_rng(0).normal(0, 3e-4, loose.shape),
            G,
            f"falls apart into {len(F)} parts, 100 % of its area",
        )
        body = standard_body()
        self.refused(body.vertices.numpy(), body.faces.numpy(), "closed surface without openings")
        rim = np.concatenate([np.stack([x, np.roll(x, -1)], 1) for x in loops(F)])
        walls = [
            np.stack([rim[:, 1], rim[:, 0], rim[:, 0] + len(V)], 1),
            np.stack([rim[:, 1], rim[:, 0] + len(V), rim[:, 1] + len(V)], 1),
        ]
        thick = np.concatenate([F, F[:, ::-1] + len(V), *walls])
        self.refused(
            np.concatenate([V, V + 0.003 * vertex_normals(V, F)]), thick, "cloth with a thickness"
        )

    def test_moebius_strip(self):
        a = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        w = np.array([-1.0, 0, 1])[:, None] * 0.06
        r, z = 0.2 + w * np.cos(a / 2), w * np.sin(a / 2)
        V = np.stack([r * np.cos(a), r * np.sin(a) - 0.03, z + 0.1], axis=-1)  # (3, 60, 3)
        number = np.arange(180).reshape(3, 60)
        number = np.concatenate([number, number[::-1, :1]], axis=1)
        p, q, r, s = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        F = np.concatenate(
            [np.stack([p, q, r], -1).reshape(-1, 3), np.stack([p, r, s], -1).reshape(-1, 3)]
        )
        self.refused(V.reshape(-1, 3), F, "one side only")

    @pytest.mark.parametrize(
        "what, change, expected",
        [
            ("centimetres", lambda V: 100 * V, dict(scale=0.01)),
            ("millimetres", lambda V: 1000 * V, dict(scale=0.001)),
            ("y up", lambda V: np.stack([V[:, 0], V[:, 2], -V[:, 1]], 1), dict(up="y")),
            ("facing backwards", lambda V: V * [-1, -1, 1], dict(turn=180.0)),
            (
                "centimetres, y up",
                lambda V: 100 * np.stack([V[:, 0], V[:, 2], -V[:, 1]], 1),
                dict(scale=0.01, up="y"),
            ),
            (
                "on a body that stands on the ground",
                lambda V: V + [0, 0, 0.82],
                dict(offset=(0, 0, -0.82)),
            ),
        ],
    )
    def test_units_axes_and_places_are_found(self, templates, what, change, expected, tmp_path):
        g = templates["tshirt"]
        path = tmp_path / "shirt.ply"
        write_ply(path, change(g.vertices.double().numpy()), g.faces.numpy())
        with pytest.raises(InputError) as error:
            Garment.read(path)
        found = re.fullmatch(
            rf"{re.escape(str(path))}: does not lie on the body: .*; it looks like {what}: give"
            r" (.*)",
            str(error.value),
        )
        assert found, error.value
        given = eval(f"dict({found[1]})")
        assert given == expected
        assert (
            np.abs(Garment.read(path, **given).vertices.numpy() - g.vertices.numpy()).max() < 1e-4
        )

    def test_nothing_fits(self):
        V, F = tube(0.5, 0.4)
        assert "1.63 m tall" in self.refused(1e-7 * V, F, "does not lie on the body")

    def test_t_pose(self, templates):
        g, body = templates["long_sleeve_top"], standard_body()
        maps = skinning.transforms(body, torch.zeros(1, 24, 3), torch.zeros(1, 3))
        V = skinning.skin(g.vertices, g.blend_weights, maps)[0].double().numpy()
        self.refused(V, g.faces.numpy(), "looks made for the T-pose .*give made_for='T-pose'")
        back = Garment.of_mesh("top", V, g.faces.numpy(), made_for="T-pose")
        error = (back.vertices - g.vertices).norm(dim=1)
        assert error.mean() < 0.003 and error.max() < 0.02

    def test_made_for_something_else_than_a_body(self, tank):
        with pytest.raises(InputError, match="made_for='A-pose'"):
            Garment.of_mesh("case", *tank, made_for="A-pose")

    def test_deep_inside(self, tank):
        V, F = tank
        self.refused(V * [0.5, 0.3, 1] + [0, -0.02, 0], F, "does not lie on the body")

    def test_wrong_up(self):
        with pytest.raises(InputError, match="'z' or 'y'"):
            fitting.placed(np.zeros((1, 3)), up="x")


@pytest.mark.parametrize("name, loose", [("tshirt", False), ("trousers", False), ("dress", True)])
def test_made_for_another_shape_in_another_stand(name, loose, templates, anny):
    g = templates[name]
    body = anny.body(anny.random_shape(np.random.default_rng(4)))
    pose = skeleton.standard_rest_pose() if loose else torch.zeros(24, 3)
    stands = fitting.in_pose(body, pose)
    maps = skinning.transforms(body, pose[None], torch.zeros(1, 3))
    V = skinning.skin(g.graded(body), g.blend_weights, maps)[0].double().numpy()
    back = Garment.of_mesh(name, V, g.faces.numpy(), made_for=stands, loose=loose)
    error = (back.vertices - g.vertices).norm(dim=1)
    assert error.mean() < 0.004 and error.max() < 0.02
    assert (torch.as_tensor(V) - g.vertices).norm(dim=1).mean() > 3 * error.mean()


def test_loose_leaves_the_pose_of_the_legs(templates):
    g, body = templates["dress"], standard_body()
    wide = body.rest_pose.clone()
    for side, sign in (("left", -1), ("right", 1)):
        wide[skeleton.INDEX[f"{side}_hip"]] = turned(
            wide[skeleton.INDEX[f"{side}_hip"]], [0, 0.12 * sign, 0]
        )
    V, F = g.vertices.double().numpy(), g.faces.numpy()
    made_for = fitting.in_pose(body, wide)
    moved = lambda loose: np.linalg.norm(
        fitting.to_standard(V, F, made_for, loose) - V, axis=1
    ).max()
    assert moved(True) < 0.005 < 0.02 < moved(False)


def test_garments_of_others(shared_data):
    for path in sorted((shared_data / "garments_makehuman").glob("*.obj")):
        if path.stem == "body_rest":
            continue
        g = Garment.read(path)
        assert (
            g.repairs == ()
            and g.name == path.stem
            and g.blend_weights.sum(1) == pytest.approx(torch.ones(len(g)), abs=1e-5)
        )


def test_garments_in_another_pose_and_axes(shared_data):
    for path in (
        shared_data / "garments_snug" / name for name in ("long_sleeve_top.obj", "shorts.obj")
    ):
        with pytest.raises(
            InputError,
            match="does not lie on the body: .* it looks like y up, .*give up='y'.*offset=",
        ) as error:
            Garment.read(path)
        given = eval(f"dict({str(error.value).partition('give ')[2]})")
        g = Garment.read(path, **{"made_for": "T-pose", **given})
        assert standard_surface()(g.vertices.numpy()).distance.min() > 0
