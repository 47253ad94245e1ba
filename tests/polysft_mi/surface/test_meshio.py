"""Meshes written and read back, templates in the file's own order, and every reason to refuse
one.
"""

import os
import re

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from places import ROOT

from polyfit import animation
from polyfit.files import aside
from polyfit.mesh import TexCoords, in_use, read_textured, seam_note, write_ply
from polysft_mi.errors import InputError
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.meshio import (
    check_template,
    cleaned,
    read_template,
    read_textured_template,
    uv_note,
)
from polysft_mi.surface.template import Template

SHARED = os.path.join(ROOT.parent, "shared", "data")
needs_data = pytest.mark.skipif(not os.path.isdir(SHARED), reason="needs ../shared/data")


def sheet(n=4, m=3):
    x, y = np.meshgrid(np.arange(n) / (n - 1), np.arange(m) / (m - 1))
    V = np.stack([x, y, 1 + 0.1 * x * y], -1).reshape(-1, 3)
    k = np.arange(n * m).reshape(m, n)
    a, b, c, d = (i.ravel() for i in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    return (
        V,
        np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]),
        V[:, :2] * (1, -1) + (0, 1),
    )


def test_ply_reads_back(tmp_path):
    V, F, uv = sheet()
    write_ply(tmp_path / "a.ply", V, F, uv)
    vertices, faces, coordinates = read_template(tmp_path / "a.ply")
    np.testing.assert_allclose(vertices, V, atol=1e-7)
    np.testing.assert_array_equal(faces, F)
    np.testing.assert_allclose(coordinates, uv, atol=1e-7)
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_allclose(mesh.visual.uv, uv, atol=1e-7)
    assert os.listdir(tmp_path) == ["a.ply"]


def test_ply_without_uv(tmp_path):
    V, F, _ = sheet()
    write_ply(tmp_path / "a.ply", V, F)
    v, f, uv = read_template(tmp_path / "a.ply")
    assert uv is None and len(v) == len(V)
    np.testing.assert_array_equal(f, F)


def test_ply_of_what_is_no_mesh_is_not_written(tmp_path):
    V, F, uv = sheet()
    for said, mesh in {
        "a.ply: faces name vertices 1 to 12; 0 to 11 exist": (V, F + 1),
        "a.ply: faces are not whole numbers": (V, F + 0.5),
        "a.ply: vertices of shape (12, 2); (N, 3) is needed": (V[:, :2], F),
        "a.ply: uv of shape (12, 3); (12, 2) is needed": (V, F, V),
        "a.ply: uv of shape (11, 2); (12, 2) is needed": (V, F, uv[1:]),
    }.items():
        with pytest.raises(InputError, match=re.escape(said)):
            write_ply(tmp_path / "a.ply", *mesh)
    assert os.listdir(tmp_path) == []


def test_ply_is_what_mitsuba_reads(tmp_path):
    V, F, uv = sheet()
    write_ply(tmp_path / "a.ply", V, F, uv)
    file = {"type": "ply", "filename": str(tmp_path / "a.ply"), "flip_tex_coords": False}
    seen = mi.traverse(mi.load_dict(file))
    array = lambda name, columns: np.array(seen[name]).reshape(-1, columns)
    np.testing.assert_allclose(array("vertex_positions", 3), V, atol=1e-6)
    np.testing.assert_array_equal(array("faces", 3), F)
    np.testing.assert_allclose(array("vertex_texcoords", 2), uv, atol=1e-6)


OBJ = """# a comment
v 0 0 1
v 1 0 1 0.5 0.5 0.5
v 1 1 1
v 0 1 1
v 2 0 1
v 2 1 1

vt 0 0
vt 0.5 0
vt 0.5 1
vt 0 1
vt 1 0
vt 1 1
vn 0 0 1
"""
ORDERED = np.array([[1, 4, 5], [1, 5, 2], [0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    "faces",
    [
        "f 2/2/1 5/5/1 6/6/1 3/3/1\nf 1/1/1 2/2/1 3/3/1 4/4/1\n",
        "f 2/2 5/5 6/6 3/3\n  f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n",
        "f -5/-5 -2/-2 -1/-1 -4/-4\nf -6/-6 -5/-5 -4/-4 -3/-3\n",
    ],
)
def test_obj_keeps_the_files_order_and_uv(tmp_path, faces):
    (tmp_path / "a.obj").write_text(OBJ + faces)
    V, F, uv = read_template(tmp_path / "a.obj")
    np.testing.assert_array_equal(
        V, [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [2, 0, 1], [2, 1, 1]]
    )
    np.testing.assert_array_equal(F, ORDERED)
    np.testing.assert_array_equal(uv, V[:, :2] * (0.5, 1))


@pytest.mark.parametrize(
    "faces",
    [
        "f 2 5 6 3\nf 1 2 3 4\n",  # none
        "f 2//1 5//1 6//1 3//1\nf 1//1 2//1 3//1 4//1\n",  # normals alone
        "f 2/2 5/5 6/6 3/3\nf 1 2 3 4\n",  # on one face only
        "f 2/2 5/5 6/6 3/3\nf 1/1 2/1 3/3 4/4\n",  # a seam
    ],
)
def test_obj_without_one_uv_a_vertex(tmp_path, faces):
    (tmp_path / "a.obj").write_text(OBJ + faces)
    _, F, uv = read_template(tmp_path / "a.obj")
    np.testing.assert_array_equal(F, ORDERED)
    assert uv is None


def test_obj_with_equal_uv_under_several_numbers(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ + "vt 0.5 0\nf 2/7 5/5 6/6 3/3\nf 1/1 2/2 3/3 4/4\n")
    assert read_template(tmp_path / "a.obj")[2] is not None


@needs_data
@pytest.mark.parametrize("name", ["flag", "bend", "paper", "curtain", "corner"])
def test_shared_cloth_has_the_truths_faces(name):
    folder = os.path.join(SHARED, "cloth", name)
    V, F, uv = read_template(os.path.join(folder, "template.obj"))
    gt = np.load(os.path.join(folder, "gt.npz"))
    np.testing.assert_array_equal(F, gt["faces"])
    np.testing.assert_allclose(V, gt["vertices"][0], atol=1e-5)
    check_template(V, F, uv)


@needs_data
def test_shared_quads_with_normals_keep_order_and_uv():
    path = os.path.join(SHARED, "phi_sft_R1", "0_R1_quad.obj")
    V, F, uv = read_template(path)
    check_template(V, F, uv)
    assert V.shape == (1024, 3) and F.shape == (1922, 3)
    np.testing.assert_array_equal(
        F[:2], [[982, 981, 1013], [982, 1013, 1014]]
    )  # the file's first quad
    np.testing.assert_array_equal(V[0], [0.713166, 0.153658, 1.274754])  # and its first vertex


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("a.obj", "v 0 0\n", "line 1: 'v 0 0' is not OBJ"),
        ("a.obj", "v 0 0 x\n", "line 1"),
        ("a.obj", OBJ + "f 1 2\n", "fewer than three"),
        ("a.obj", OBJ + "f 1 2 9\n", "number 9 of 6 vertices"),
        ("a.obj", OBJ + "f 1 2 0\n", "index 0"),
        ("a.obj", OBJ + "f 1 2 -7\n", "index -7"),
        ("a.obj", OBJ + "f 1/1 2/2 3/8\n", "number 8 of 6 texture"),
        ("a.obj", OBJ + "f 1 2 b\n", "not OBJ"),
        ("a.ply", "not a ply", "not a readable PLY"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\n", "a.ply: "),
        ("a.stl", "solid", "'.stl'; .obj, .ply or .glb is needed"),
    ],
)
def test_unreadable_files_are_one_line(tmp_path, name, content, words):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as error:
        read_template(tmp_path / name)
    assert words in str(error.value) and str(tmp_path / name) in str(error.value)


def test_gltf_is_read_without_the_vertices_that_seams_split(tmp_path):
    V, F, uv = sheet()
    texcoords = TexCoords(np.concatenate([uv, uv + 1]), np.where(F[:, :1] % 2, F, F + len(V)))
    animation.write_glb(tmp_path / "a.glb", V[None].astype(np.float32), F, texcoords)
    W, G, read = read_textured(tmp_path / "a.glb")
    assert len(W) == len(V)
    np.testing.assert_allclose(W[G], V[F], atol=1e-6)
    np.testing.assert_allclose(read.corners, texcoords.corners, atol=1e-6)
    (tmp_path / "b.glb").write_text("not a glTF")
    with pytest.raises(InputError, match="b.glb: not a readable GLB file"):
        read_textured(tmp_path / "b.glb")


def test_a_surface_cut_along_a_seam_is_told():
    V, F, _ = sheet()
    assert seam_note(V, F) is None
    left = np.arange(len(F)) < len(F) // 2
    cut = np.where(left[:, None], F, F + len(V))
    W, G = in_use(np.concatenate([V, V]), cut)
    both = len(np.intersect1d(F[left], F[~left]))
    assert f"the surface is open where {2 * both} vertices lie on others" in seam_note(W, G)


def test_coordinates_beyond_the_image_are_told():
    _, F, uv = sheet()
    assert uv_note(TexCoords(uv, F)) is None and uv_note(TexCoords(1.02 * uv - 0.01, F)) is None
    said = uv_note(TexCoords(uv * (2, 1), F), "a.obj")
    assert said.startswith(
        "a.obj: texture coordinates from 0 to 2 and 0 to 1; the image fills 0 to"
    )


def test_a_template_without_texture_on_some_faces_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ + "f 2/2 5/5 6/6 3/3\nf 1 2 3 4\n")
    mesh = read_textured_template(tmp_path / "a.obj")
    with pytest.raises(InputError, match="2 faces have no texture coordinates, as others have"):
        check_template(*mesh)


def test_missing_file_and_folder(tmp_path):
    (tmp_path / "folder.obj").mkdir()
    for name in ("missing.obj", "missing.ply"):
        with pytest.raises(InputError, match=f"{name}: no such file"):
            read_template(tmp_path / name)
    with pytest.raises(InputError, match="folder.obj: is a folder; a template is an .obj"):
        read_template(tmp_path / "folder.obj")


def test_a_ply_of_points_is_refused(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty"
        " float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(InputError, match="holds no faces"):
        read_template(tmp_path / "a.ply")


def test_a_sheet_and_a_closed_surface_pass():
    check_template(*sheet())
    ball = trimesh.creation.icosphere(1)
    check_template(ball.vertices, ball.faces, np.zeros((len(ball.vertices), 2)))


def _change(kind):
    V, F, uv = sheet()
    if kind == "nan":
        V[5, 1] = np.nan
    elif kind == "inf":
        V[5, 1] = np.inf
    elif kind == "no uv":
        uv = None
    elif kind == "uv nan":
        uv[3] = np.nan
    elif kind == "uv shape":
        uv = uv[:-1]
    elif kind == "two vertices":
        V, F, uv = V[:2], F[:0], uv[:2]
    elif kind == "empty":
        V, F, uv = V[:0], F[:0], uv[:0]
    elif kind == "no faces":
        F = F[:0]
    elif kind == "index":
        F[2, 1] = len(V)
    elif kind == "repeated corner":
        F = np.concatenate([F, [[0, 0, 1]]])
    elif kind == "flat":
        V = V * (1, 0, 0)
    elif kind == "zero area":
        V[1] = V[0]
    elif kind == "fin":
        V, uv = np.concatenate([V, [[0.1, 0.1, 0.5]]]), np.concatenate([uv, [[0, 0]]])
        F = np.concatenate([F, [[4, 1, len(V) - 1]]])
    elif kind == "flipped face":
        F[3] = F[3, ::-1]
    elif kind == "loose vertex":
        V, uv = np.concatenate([V, [[0, 0, 1]]]), np.concatenate([uv, [[0, 0]]])
    elif kind == "two sheets":
        F = np.concatenate([F, F + len(V)])
        V, uv = np.concatenate([V, V + 2]), np.concatenate([uv, uv])
    elif kind == "bow tie":
        V, uv = (
            np.concatenate([V, [[-1, 0, 1], [-1, -1, 1.0]]]),
            np.concatenate([uv, [[0, 0], [0, 0]]]),
        )
        F = np.concatenate([F, [[0, len(V) - 2, len(V) - 1]]])
    return V, F, uv


@pytest.mark.parametrize(
    "kind, words",
    [
        ("nan", "1 vertices have coordinates that are not finite (the first is vertex 5"),
        ("inf", "not finite"),
        ("no uv", "no texture coordinates"),
        ("uv nan", "texture coordinates are not finite (the first is coordinate 3"),
        ("uv shape", "(12, 2) is needed"),
        ("two vertices", "2 vertices; a template has at least 3"),
        ("empty", "0 vertices"),
        ("no faces", "no faces"),
        ("index", "0 to 11 exist"),
        ("flat", "its faces have no area"),
        ("loose vertex", "1 vertices are in no face (the first is vertex 12"),
    ],
)
def test_refuses_what_cannot_be_a_template(kind, words):
    with pytest.raises(InputError) as error:
        check_template(*_change(kind), where="cloth.obj")
    assert (
        str(error.value).startswith("cloth.obj: ")
        and words in str(error.value)
        and "\n" not in str(error.value)
    )


@pytest.mark.parametrize(
    "kind, faces, vertices",
    [("repeated corner", 1, 0), ("zero area", 1, 1), ("loose vertex", 0, 1)],
)
def test_what_has_no_area_is_left_out(kind, faces, vertices):
    V, F, uv = _change(kind)
    W, G, texcoords, kept, note = cleaned(V, F, TexCoords(uv, F))
    check_template(W, G, texcoords)
    assert note == (f"left out {faces} faces without area and {vertices} vertices in no other face")
    assert len(kept) == len(F) and (~kept).sum() == faces and len(W) == len(V) - vertices
    np.testing.assert_array_equal(W[G], V[F[kept]])
    np.testing.assert_array_equal(texcoords.corners, uv[F[kept]])
    assert cleaned(W, G, texcoords)[4] is None


@pytest.mark.parametrize("kind", ["fin", "flipped face", "two sheets", "bow tie"])
def test_any_surface_can_be_a_template(kind):
    """Accepted, and held by jets: the undeformed template is the mesh."""
    vertices, faces, uv = _change(kind)
    check_template(vertices, faces, uv)
    template = Template.fit(vertices, faces, uv, 1, exact=False)
    atlas = Atlas(template)
    rest = atlas.state(
        {
            "delta_alpha": np.zeros_like(template.alpha),
            **{name: np.zeros(len(vertices)) for name in ("delta_u", "delta_v", "delta_w")},
            "rotation": np.tile([0.0, 0, 0, 1], (len(template), 1)),
            "translation": np.zeros((len(template), 3)),
        }
    )
    np.testing.assert_allclose(atlas.surface(rest).vertices, vertices, atol=1e-12)


def test_obj_with_a_seam_is_read_with_it(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ + "f 2/2 5/5 6/6 3/3\nf 1/1 2/1 3/3 4/4\n")
    V, F, texcoords = read_textured_template(tmp_path / "a.obj")
    np.testing.assert_array_equal(F, ORDERED)
    np.testing.assert_array_equal(texcoords.faces, [[1, 4, 5], [1, 5, 2], [0, 0, 2], [0, 2, 3]])
    assert texcoords.of_vertices(F, len(V)) is None
    check_template(V, F, texcoords)


def test_a_broken_write_leaves_the_older_file_and_names_it(tmp_path):
    (tmp_path / "a.ply").write_text("older")
    with (
        pytest.raises(OSError) as error,
        aside(tmp_path / "a.ply") as temporary,
        open(temporary, "wb") as file,
    ):
        file.write(b"half")
        raise OSError(28, "No space left on device")
    assert error.value.filename == str(tmp_path / "a.ply")
    assert os.listdir(tmp_path) == ["a.ply"] and (tmp_path / "a.ply").read_text() == "older"
    with pytest.raises(OSError) as error:
        write_ply(tmp_path / "nowhere" / "a.ply", *sheet())
    assert error.value.filename == str(tmp_path / "nowhere" / "a.ply")
