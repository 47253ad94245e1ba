"""Meshes that are repaired or refused, and garments of other makes."""

import itertools
import re

import numpy as np
import pytest
import torch
from meshes import turned
from surfaces import joined, moebius, sphere, tube

from onefit import drape
from onefit.body import skeleton, skinning
from onefit.garment import Garment, fitting, standard_body, standard_surface
from onefit.garment.reading.mending import mended
from polyfit import mesh, write_ply
from polyfit.animation import write_glb
from polyfit.errors import InputError
from polyfit.mesh import loops, vertex_normals


def soup(V, F):
    """Every face with vertices of its own."""
    return V[F.ravel()], np.arange(F.size).reshape(-1, 3)


def punched(V, F, at, faces=1):
    """Without the faces nearest to vertex ``at``."""
    d = np.linalg.norm(V[F].mean(axis=1) - V[at], axis=1)
    return V, np.delete(F, np.argsort(d, kind="stable")[:faces], axis=0)


def thickened(V, F, thickness, rows=1):
    """A closed surface: the mesh, the same ``thickness`` [m] below it, wound the other way, and
    ``rows`` of faces along the rims.
    """
    below = -thickness * vertex_normals(V, F)
    rim = np.concatenate([np.stack([x, np.roll(x, -1)], 1) for x in loops(F)])
    vertices, faces, last = [V, V + below], [F, F[:, ::-1] + len(V)], rim + len(V)
    for k in range(1, rows + 1):
        count = sum(map(len, vertices))
        row = rim if k == rows else np.searchsorted(np.unique(rim), rim) + count
        if k < rows:
            vertices.append((V + (1 - k / rows) * below)[np.unique(rim)])
        faces.append(np.stack([row[:, 1], row[:, 0], last[:, 0]], 1))
        faces.append(np.stack([row[:, 1], last[:, 0], last[:, 1]], 1))
        last = row
    return np.concatenate(vertices), np.concatenate(faces)


def flipped(F, rows):
    G = F.copy()
    G[rows] = G[rows, ::-1]
    return G


def with_flat_faces(V, F, count, rows=3):
    """With ``count`` faces whose corners lie in a line, ``rows`` of them one beside the other in
    the place of one edge; the first ones lie at the boundary.
    """
    side = mesh.edges_of(F)[1]
    uses = np.bincount(side.ravel())
    V, F, used = list(V), F.tolist(), set()
    for e in np.argsort(uses, kind="stable")[[*range(0, 99), *range(-99, 0)]]:
        sides = np.argwhere(side == e)
        if used & set(sides[:, 0]):
            continue
        used |= set(sides[:, 0])
        f, k = sides[0]
        p, q, c = np.roll(F[f], -k)
        inner = [len(V) + i for i in range(rows)]
        V += [V[p] + (i + 1) / (rows + 1) * (V[q] - V[p]) for i in range(rows)]
        line = list(itertools.pairwise([p, *inner, q]))
        F[f] = [p, inner[0], c]
        F += [[a, b, c] for a, b in line[1:]] + [[a, q, b] for a, b in line[:-1]]
        count -= rows
        if count <= 0:
            break
    return np.array(V), np.array(F)


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

    def test_faces_whose_corners_lie_in_a_line(self, tank):
        V, F = tank
        W, G = with_flat_faces(V, F, 300)
        assert (mesh.areas(W, G) < 1e-12).sum() == 300
        g = self.check(W, G, "flipped or dropped 300 faces")
        X, H = g.vertices.double().numpy(), g.faces.numpy()
        assert len(g) == len(W) and mesh.areas(X, H).min() > 1e-7
        assert mesh.areas(X, H).sum() == pytest.approx(mesh.areas(V, F).sum(), rel=1e-4)

    def test_seams_and_soups_are_sewn(self, tank):
        V, F = tank
        g = self.check(*soup(V, F), f"merged {F.size - len(V)} vertices")
        assert len(g) == len(V)

    def test_panels_meshed_each_for_itself_are_sewn(self, tank):
        V, F = tank
        left = V[F].mean(axis=1)[:, 0] < 0
        seam = np.intersect1d(F[left], F[~left])
        right, rng, extra = F[~left] + len(V), np.random.default_rng(5), []
        cut = set()
        edges, side = mesh.edges_of(right)
        once = np.bincount(side.ravel(), minlength=len(edges)) == 1
        for f, k in np.argwhere(once[side] & np.isin(right - len(V), seam)):
            a, b, c = np.roll(right[f], -k)
            if (
                f not in cut and b - len(V) in seam
            ):  # an edge of the seam gets a vertex, a little off it
                t, number = rng.uniform(0.35, 0.65), 2 * len(V) + len(extra)
                extra.append(t * V[a - len(V)] + (1 - t) * V[b - len(V)] + rng.normal(0, 1e-4, 3))
                right[f] = a, number, c
                cut.add(f)
                right = np.concatenate([right, [[number, b, c]]])
        assert len(extra) > 50
        W, G = np.concatenate([V, V, extra]), np.concatenate([F[left], right])
        g = self.check(W, G, "no face", f"cut the boundary at {len(extra)} places", "merged")
        assert len(g) == len(V) + len(extra)
        area = mesh.areas(g.vertices.double().numpy(), g.faces.numpy()).sum()
        assert area == pytest.approx(mesh.areas(V, F).sum(), rel=1e-3)

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
            "5 parts of 5 faces, .* go along with the cloth",
        )
        assert len(g) == len(V)

    def test_buttons_are_no_cloth(self, tank):
        button, G = sphere(0.006, 1)
        self.check(
            *joined(tank, (button + [0, -0.16, 0.3], G)), f"a part of {len(G)} faces, .* go along"
        )

    def test_cloth_with_a_thickness_is_its_outer_side(self, tank):
        V, F = tank
        W, G = thickened(V, F, 0.003)
        told = f"outer side of cloth that is 3.0 mm thick, without {len(G) - len(F)} faces"
        g = self.check(W, G, told)
        assert np.allclose(g.vertices.numpy(), V, atol=1e-6) and np.array_equal(g.faces.numpy(), F)

        at = np.argmin(np.linalg.norm(V - [0, -0.13, 0.2], axis=1))
        self.check(*punched(W, G, at), told[:40], "filled 1 hole")

    def test_a_double_sided_mesh_is_one_layer(self, tank):
        V, F = tank
        g = self.check(*joined(tank, (V, F[:, ::-1])), f"dropped {len(F)} faces that repeat")
        assert len(g) == len(V)

    def test_folds_and_a_bevelled_rim_of_thick_cloth(self):
        g = Garment.template("circle_skirt")
        V, F = g.vertices.double().numpy(), g.faces.numpy()
        W, G = thickened(V, F, 0.004, rows=3)
        thick = Garment.of_mesh("thick", W, G)
        assert np.array_equal(thick.faces.numpy(), F), thick.repairs

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
        self.refused(
            V, F, "texcoords of type ndarray; a TexCoords", texcoords=np.zeros((len(V), 2))
        )
        self.refused(V[:, :2], F, r"vertices of shape \(3000, 2\); \(N, 3\) is needed")
        self.refused([*V.tolist(), [0, 1]], F, r"vertices are no array of numbers; \(N, 3\) is")
        self.refused(V, F.astype(str), r"faces are no array of numbers; \(F, 3\) is needed")
        self.refused(V, F[:, [0, 1, 2, 2]], r"faces of shape .* \(F, 3\) is needed")
        self.refused(V, F + 1, "faces name vertices 1 to 3000; 0 to 2999 exist")
        self.refused(V, F - 1, "faces name vertices -1 to 2998; 0 to 2999 exist")
        W = V.copy()
        W[17, 1] = np.nan
        self.refused(W, F, "1 vertices have coordinates that are not finite .*vertex 17")
        self.refused(np.zeros_like(V), F, "no area")
        W = V.copy()
        W[17] = 30, 0, 0
        self.refused(W, F, r"1 of 3000 vertices of the cloth .* 5 m .* at \(30, 0, 0\) m")
        loose, G = soup(V, F)
        self.refused(
            0.7 * loose + 0.3 * np.repeat(V[F].mean(axis=1), 3, axis=0),
            G,
            f"falls apart into {len(F)} parts, 100 % of its area",
        )
        body = standard_body()
        self.refused(body.vertices.numpy(), body.faces.numpy(), "closed surface without openings")
        self.refused(*thickened(V, F, -0.05), "closed surface without openings")

    def test_moebius_strip(self):
        V, F = moebius()
        self.refused(0.8 * V + [0, -0.03, 0.1], F, "one side only")

    @pytest.mark.parametrize(
        "what, change, expected",
        [
            ("millimetres", lambda V: 1000 * V, dict(scale=0.001)),
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
        g, path = templates["tshirt"], tmp_path / "shirt.ply"
        write_ply(path, change(g.vertices.double().numpy()), g.faces.numpy())
        with pytest.raises(InputError) as error:
            Garment.read(path)
        found = re.fullmatch(
            rf"{re.escape(str(path))}: does not lie on the body: .*; it looks like {what}: give"
            r" (.*), or (--.*)",
            str(error.value),
        )
        assert found, error.value
        given = eval(f"dict({found[1]})")
        assert given == expected
        flags = drape.parser().parse_args([str(path), "walk", "-o", "OUT", *found[2].split()])
        assert {name: getattr(flags, name) for name in given} == {
            name: list(value) if name == "offset" else value for name, value in expected.items()
        }
        assert (
            np.abs(Garment.read(path, **given).vertices.numpy() - g.vertices.numpy()).max() < 1e-4
        )

    def test_y_is_up_in_gltf(self, templates, tmp_path):
        g = templates["tank"]
        x, y, z = g.vertices.double().numpy().T
        for name, up, V in (("a.glb", None, [x, z, -y]), ("b.glb", "z", [x, y, z])):
            write_glb(tmp_path / name, np.stack(V, 1)[None], g.faces.numpy())
            read = Garment.read(tmp_path / name, up=up)
            assert np.abs(read.vertices.numpy() - g.vertices.numpy()).max() < 1e-4
        with pytest.raises(InputError, match="b.glb .read with y up, as glTF has it; else up='z'"):
            Garment.read(tmp_path / "b.glb")
        with pytest.raises(InputError, match="looks like z up: give up='z', or --up z$"):
            Garment.read(tmp_path / "b.glb")

    def test_what_was_given_wrongly_is_told(self, templates, tmp_path):
        """What is suggested is given in its place, not beside it."""
        g, path = templates["tank"], tmp_path / "tank.ply"
        write_ply(path, 1000 * g.vertices.double().numpy(), g.faces.numpy())
        for given, told in (
            (dict(scale=0.01), "millimetres: give scale=0.001, or --scale 0.001"),
            (dict(scale=0.001, turn=180), "facing forward: give scale=0.001, turn=0, or"),
            (dict(scale=0.001, offset=(0, 0, 0.5)), "in its place: give scale=0.001, offset="),
        ):
            with pytest.raises(InputError) as error:
                Garment.read(path, **given)
            assert told in str(error.value)
        for given in dict(scale=-1), dict(scale=0), dict(turn=np.nan), dict(offset=(0, 0, np.inf)):
            with pytest.raises(InputError, match="^(scale|turn)=.* needed$"):
                Garment.read(path, **given)

    def test_what_is_suggested_is_taken(self, templates, tmp_path):
        """Skirts look alike from all sides."""
        g, path = templates["skirt"], tmp_path / "skirt.ply"
        write_ply(path, 1000 * g.vertices.double().numpy() * (-1, -1, 1), g.faces.numpy())
        with pytest.raises(InputError, match="give scale=0.001, turn=180, or"):
            Garment.read(path, turn=180)
        Garment.read(path, turn=180, scale=0.001)

    def test_nothing_fits(self):
        V, F = tube(0.5, 0.4)
        assert "1.63 m tall" in self.refused(1e-7 * V, F, "does not lie on the body")

    def test_t_pose(self, templates):
        g, body = templates["long_sleeve_top"], standard_body()
        maps = skinning.transforms(body, torch.zeros(1, 24, 3), torch.zeros(1, 3))
        V = skinning.skin(g.vertices, g.blend_weights, maps)[0].double().numpy()
        self.refused(
            V,
            g.faces.numpy(),
            "looks made for the T-pose .*give made_for='T-pose', or --made-for T-pose$",
        )
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
        with pytest.raises(InputError, match=r"offset=\(0, 1\); three numbers"):
            fitting.placed(np.zeros((1, 3)), offset=(0, 1))


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
        given = eval(f"dict({str(error.value).partition('give ')[2].partition(', or ')[0]})")
        g = Garment.read(path, **{"made_for": "T-pose", **given})
        assert standard_surface()(g.vertices.numpy()).distance.min() > 0
