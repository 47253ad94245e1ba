"""Mesh files as other programs write them: each kind gives the mesh that it means, or one line."""

import base64
import json
import logging
import struct

import numpy as np
import pytest
import surfaces

from polyfit import PatchedSurface, write_ply
from polyfit.errors import InputError
from polyfit.mesh import areas, centred, face_vectors, read_mesh, read_textured
from polyfit.mesh.polygons import triangulated

V = np.array([[0, 0, 0], [0.3, 0, 0], [0.3, 0.2, 0], [0, 0.2, 0.1]])
F = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
OBJ = (
    "".join("v {} {} {}\n".format(*p) for p in V)
    + "".join("vt {} {}\n".format(*p) for p in UV)
    + "f 1/1 2/2 3/3 4/4\n"
)


def read_as_it_is(path):
    """The file holds the mesh above."""
    vertices, faces, uv = read_mesh(path)
    np.testing.assert_allclose(vertices, V, atol=1e-7)
    np.testing.assert_array_equal(faces, F)
    np.testing.assert_allclose(uv, UV, atol=1e-6)


# --- text -----------------------------------------------------------------------------------------

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32")


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_obj_in_any_encoding(tmp_path, encoding, end):
    (tmp_path / "a.obj").write_bytes(OBJ.replace("\n", end).encode(encoding))
    read_as_it_is(tmp_path / "a.obj")


@pytest.mark.parametrize(
    "old, new",
    [
        ("v 0.3 0.2", "v 0.3 \\\n 0.2"),
        ("3/3 4/4", "\\  \n3/3\\\n4/4"),
        ("v 0.3 0.2", "V 0.3 0.2"),
        ("vt 1.0 1", "VT 1.0 1"),
        ("f 1/1", "F 1/1"),
        ("f 1/1", "# C:\\models\\\nf 1/1"),  # a path that ends in a backslash continues nothing
        ("4/4\n", "4/4 # the sheet\n"),
        ("4/4\n", "4/4#\n"),
    ],
)
def test_obj_as_other_programs_write_it(tmp_path, old, new):
    assert old in OBJ
    (tmp_path / "a.obj").write_text(OBJ.replace(old, new))
    read_as_it_is(tmp_path / "a.obj")


def ply(properties="property float s\nproperty float t\n", comment="", faces=F):
    rows = [" ".join(map(str, [*p, *q])) for p, q in zip(V, UV if properties else V[:, :0])]
    rows += [" ".join(map(str, [len(f), *f])) for f in faces]
    return (
        f"ply\nformat ascii 1.0\n{comment}element vertex 4\nproperty float x\nproperty float y\n"
        f"property float z\n{properties}element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n"
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ply_in_any_encoding(tmp_path, encoding, end):
    (tmp_path / "a.ply").write_bytes(ply().replace("\n", end).encode(encoding))
    read_as_it_is(tmp_path / "a.ply")


@pytest.mark.parametrize("index", [0, -5, 2**31, 10**30])
def test_obj_with_an_index_that_none_can_be(index, tmp_path):
    (tmp_path / "a.obj").write_text(OBJ.replace("f 1/", f"f {index}/"))
    with pytest.raises(InputError, match=f"a.obj: line 9: .* is not OBJ .index {index}"):
        read_textured(tmp_path / "a.obj")


@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v"])
def test_ply_that_names_a_texture_is_quiet(tmp_path, names, capfd, caplog):
    properties = "".join(f"property float {name}\n" for name in names.split())
    (tmp_path / "a.ply").write_text(ply(properties, "comment TextureFile not here.jpg\n"))
    with caplog.at_level(logging.DEBUG):
        read_as_it_is(tmp_path / "a.ply")
    assert not caplog.records and capfd.readouterr() == ("", "")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("mixed", [False, True])
def test_binary_ply(tmp_path, order, mixed):
    """Faces of one length and of several, other elements before and between, uv of the corners."""
    name = {"<": "little", ">": "big"}[order]
    faces = [[0, 1, 2, 3]] if not mixed else [[0, 1, 2], [0, 2, 3, 1]]
    head = (
        f"ply\nformat binary_{name}_endian 1.0\nelement camera 1\nproperty double f\nelement"
        " vertex 4\nproperty uchar red\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar uint vertex_index\nproperty list uchar"
        " float texcoord\nend_header\n"
    )
    body = struct.pack(order + "d", 35.0)
    body += b"".join(struct.pack(order + "Bddd", 9, *p) for p in V)
    for k, f in enumerate(faces):
        uv = UV[f].ravel() if k == 0 else ()  # the second has none
        body += struct.pack(f"{order}B{len(f)}IB{len(uv)}f", len(f), *f, len(uv), *uv)
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    if not mixed:
        read_as_it_is(tmp_path / "a.ply")
        return
    vertices, triangles, texcoords = read_textured(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, V)
    assert len(triangles) == 3 and triangles[0].tolist() == [0, 1, 2]
    np.testing.assert_allclose(texcoords.corners[0], UV[[0, 1, 2]])
    assert np.isnan(texcoords.corners[1:]).all()


def test_cut_off_ply_is_one_line(tmp_path):
    for text in (ply()[:-20], ply().replace("face 2", "face 3"), ply()[:60]):
        (tmp_path / "a.ply").write_text(text)
        with pytest.raises(InputError, match=r"a\.ply: not a readable PLY file"):
            read_mesh(tmp_path / "a.ply")


# --- polygons -------------------------------------------------------------------------------------


def _star(n=7):
    t = np.linspace(0, 2 * np.pi, 2 * n, endpoint=False)
    return np.stack([np.cos(t), np.sin(t)], 1) * np.where(np.arange(2 * n) % 2, 0.3, 1)[:, None]


POLYGONS = {
    "convex": [[0, 0], [2, 0], [3, 1], [2, 2], [0, 2]],
    "dart": [[0, 0], [4, 2], [0, 4], [1, 2]],
    "L": [[0, 0], [2, 0], [2, 1], [1, 1], [1, 3], [0, 3]],
    "U": [[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]],
    "star": _star(),
    "corners in a line": [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]],
    "a hole behind a slit": [
        *([0, 0], [4, 0], [4, 4], [0, 4], [0, 0]),
        *([1, 1], [1, 3], [3, 3], [3, 1], [1, 1]),
    ],
}


def _area(p):
    x, y = np.asarray(p, dtype=float).T
    return 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()


@pytest.mark.parametrize("name", POLYGONS)
@pytest.mark.parametrize("extension", ["obj", "ply"])
def test_polygons_are_covered_and_wound_as_they_are(name, extension, tmp_path):
    """From whichever corner the file begins, however it lies in space: the polygon's area, all
    triangles wound alike.
    """
    for first in range(len(POLYGONS[name])):
        flat = np.roll(POLYGONS[name], first, axis=0)[:: 1 if first % 2 else -1].astype(float)
        turn = np.linalg.qr(np.random.default_rng(first).normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        points = np.pad(flat, ((0, 0), (0, 1))) @ turn.T + [3.0, -2.0, 50.0]
        rows = "".join("{} {} {}\n".format(*p) for p in points)
        path = tmp_path / f"a.{extension}"
        if extension == "obj":
            face = "f " + " ".join(str(k + 1) for k in range(len(points)))
            path.write_text("".join(f"v {row}\n" for row in rows.splitlines()) + face)
        else:
            path.write_text(
                f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty double x\nproperty"
                " double y\nproperty double z\nelement face 1\nproperty list uchar int"
                f" vertex_indices\nend_header\n{rows}{len(points)} "
                + " ".join(map(str, range(len(points))))
            )
        vertices, faces, _ = read_mesh(path)
        assert faces.shape == (len(points) - 2, 3)
        along = face_vectors(vertices, faces) @ turn[:, 2] * np.sign(_area(flat))
        assert along.min() > 0
        assert areas(vertices, faces).sum() == pytest.approx(abs(_area(flat)), rel=1e-9)


def test_convex_polygons_stay_fans_and_triangles_as_they_are():
    points = np.random.default_rng(0).normal(size=(9, 3))
    corner = np.arange(9)
    np.testing.assert_array_equal(
        triangulated(points, corner, np.array([3, 3, 3])), corner.reshape(3, 3)
    )
    hexagon = np.array([[np.cos(t), np.sin(t), 0.2 * t] for t in np.arange(6) * np.pi / 3])
    np.testing.assert_array_equal(
        triangulated(hexagon, np.arange(6), np.array([6])),
        [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]],
    )


# --- faces without texture coordinates ------------------------------------------------------------


def test_faces_without_a_coordinate_take_no_other(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ + "v 1 1 1\nf 2 5 3\n")
    _, faces, texcoords = read_textured(tmp_path / "a.obj")
    assert np.isnan(texcoords.corners[2]).all() and np.isfinite(texcoords.corners[:2]).all()
    source, uv, split = texcoords.split(faces)
    np.testing.assert_array_equal(source[split], faces)
    assert np.isnan(uv[split[2]]).all()
    assert read_mesh(tmp_path / "a.obj")[2] is None


# --- glTF -----------------------------------------------------------------------------------------

FLOAT, BYTE, UBYTE, SHORT, USHORT, UINT = 5126, 5120, 5121, 5122, 5123, 5125
KINDS = {FLOAT: "<f4", BYTE: "i1", UBYTE: "u1", SHORT: "<i2", USHORT: "<u2", UINT: "<u4"}


class File:
    """A glTF file, made by hand. It begins as the sheet of this module, v down."""

    def __init__(self):
        self.data = bytearray()
        self.json = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "bufferViews": [],
            "accessors": [],
        }
        attributes = {
            "POSITION": self.accessor(V, FLOAT, "VEC3"),
            "TEXCOORD_0": self.accessor(UV * (1, -1) + (0, 1), FLOAT, "VEC2"),
        }
        primitive = {"attributes": attributes, "indices": self.accessor(F.ravel(), USHORT)}
        self.json["meshes"] = [{"primitives": [primitive]}]
        self.primitive, self.attributes = primitive, attributes

    def view(self, raw, **more):
        self.data.extend(b"\0" * (-len(self.data) % 4))
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw), **more}
        )
        self.data.extend(raw)
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values, component, form="SCALAR", **more):
        array = np.ascontiguousarray(np.asarray(values), KINDS[component])
        view = more.pop("bufferView", None)
        self.json["accessors"].append(
            {
                "bufferView": self.view(array.tobytes()) if view is None else view,
                "componentType": component,
                "count": len(array),
                "type": form,
                **more,
            }
        )
        return len(self.json["accessors"]) - 1

    def material(self, texture):
        self.json["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}}]
        self.primitive["material"] = 0

    def write(self, path):
        if path.suffix == ".gltf":
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            self.json["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
            path.write_text(json.dumps(self.json))
            return path
        self.json["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        body = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        path.write_bytes(
            struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
            + struct.pack("<I4s", len(text), b"JSON") + text
            + struct.pack("<I4s", len(body), b"BIN\0") + body
        )  # fmt: skip
        return path


def test_gltf_that_counts_more_than_it_has(tmp_path):
    file = File()
    file.json["accessors"][0]["count"] = 10**12
    with pytest.raises(InputError, match="an accessor reaches beyond its buffer"):
        read_mesh(file.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_gltf_without_a_material_keeps_its_uv(tmp_path, name):
    read_as_it_is(File().write(tmp_path / name))


@pytest.mark.parametrize("component, most", [(SHORT, 32767), (USHORT, 65535)])
def test_gltf_of_whole_numbers(tmp_path, component, most):
    """KHR_mesh_quantization: normalised positions under a node's scale, normalised uv."""
    file = File()
    file.attributes["POSITION"] = file.accessor(
        np.round(V / 0.3 * most), component, "VEC3", normalized=True
    )
    file.attributes["TEXCOORD_0"] = file.accessor(
        (1 - UV[:, 1:]) * (0, 255) + UV * (255, 0), UBYTE, "VEC2", normalized=True
    )
    file.json["nodes"][0]["scale"] = [0.3, 0.3, 0.3]
    file.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    vertices, faces, uv = read_mesh(file.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(vertices, V, atol=0.3 / most)
    np.testing.assert_array_equal(faces, F)
    np.testing.assert_allclose(uv, UV, atol=1e-6)


def test_gltf_of_whole_numbers_that_are_not_normalised(tmp_path):
    file = File()
    file.attributes["POSITION"] = file.accessor(np.round(V * 10), BYTE, "VEC3")
    file.json["nodes"][0]["matrix"] = np.diag([0.1, 0.1, 0.1, 1]).ravel().tolist()
    read_as_it_is(file.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("component", [UBYTE, USHORT, UINT])
def test_gltf_interleaved_with_indices_of_any_type(tmp_path, component):
    file = File()
    rows = np.zeros(4, [("p", "<f4", 3), ("other", "<f4", 2), ("uv", "<f4", 2)])
    rows["p"], rows["uv"], rows["other"] = V, UV * (1, -1) + (0, 1), 7
    view = file.view(rows.tobytes(), byteStride=28)
    file.attributes["POSITION"] = file.accessor(V, FLOAT, "VEC3", bufferView=view)
    file.attributes["TEXCOORD_0"] = file.accessor(UV, FLOAT, "VEC2", bufferView=view, byteOffset=20)
    file.primitive["indices"] = file.accessor(F.ravel(), component)
    read_as_it_is(file.write(tmp_path / "a.glb"))


def test_gltf_with_sparse_accessors(tmp_path):
    file = File()
    wrong = V.copy()
    wrong[[1, 3]] = 9
    index, values = (
        file.view(np.array([1, 3], "u1").tobytes()),
        file.view(V[[1, 3]].astype("<f4").tobytes()),
    )
    sparse = {
        "count": 2,
        "indices": {"bufferView": index, "componentType": UBYTE},
        "values": {"bufferView": values},
    }
    file.attributes["POSITION"] = file.accessor(wrong, FLOAT, "VEC3", sparse=sparse)
    read_as_it_is(file.write(tmp_path / "a.glb"))


def test_gltf_nodes_place_meshes_and_mirrors_keep_outsides(tmp_path):
    file = File()
    half = np.sqrt(0.5)
    file.json["nodes"] = [
        {"children": [1], "translation": [0, 0, 1.0]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 2, -2]},
        {"mesh": 0},  # in no scene
    ]
    vertices, faces, _ = read_mesh(file.write(tmp_path / "a.glb"))
    x, y, z = V.T
    np.testing.assert_allclose(vertices, np.stack([-2 * y, 2 * x, 1 - 2 * z], 1), atol=1e-6)
    np.testing.assert_array_equal(faces, F[:, ::-1])


@pytest.mark.parametrize("component", [UBYTE, FLOAT])
def test_gltf_skins_stand_in_the_pose_of_the_file(tmp_path, component):
    """The scale lies in a joint; the node of the mesh has no say. Two joints share a vertex."""
    file = File()
    file.json["nodes"] = [
        {"children": [1, 2]},
        {"mesh": 0, "skin": 0, "scale": [7, 7, 7]},
        {"scale": [0.01] * 3, "children": [3]},
        {"translation": [10, 0, 0]},
    ]
    bind = np.stack([np.eye(4), np.eye(4)])
    bind[1, 3, :3] = [-10, 0, 0]  # columns first
    moved = V * 100
    file.attributes["POSITION"] = file.accessor(moved, FLOAT, "VEC3")
    share = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0], [1, 0, 0, 0]])
    if component == UBYTE:
        share = np.round(share * 255)
    file.attributes["JOINTS_0"] = file.accessor([[0, 1, 0, 0]] * 4, UBYTE, "VEC4")
    file.attributes["WEIGHTS_0"] = file.accessor(share, component, "VEC4", normalized=True)
    matrices = file.accessor(bind.reshape(2, 16), FLOAT, "MAT4")
    file.json["skins"] = [{"joints": [2, 3], "inverseBindMatrices": matrices}]
    read_as_it_is(file.write(tmp_path / "a.glb"))


def test_gltf_skins_whose_joints_are_elsewhere_and_weights_missing(tmp_path):
    """Joints outside the scene count; a vertex on no joint hangs on the first, as in viewers."""
    file = File()
    file.json["nodes"] = [{"mesh": 0, "skin": 0}, {"scale": [0.5] * 3}, {"scale": [9] * 3}]
    file.attributes["POSITION"] = file.accessor(V * 2, FLOAT, "VEC3")
    file.attributes["JOINTS_0"] = file.accessor([[1, 0, 0, 0]] * 4, UBYTE, "VEC4")
    file.attributes["WEIGHTS_0"] = file.accessor(np.zeros((4, 4)), FLOAT, "VEC4")
    file.json["skins"] = [{"joints": [1, 2]}]
    read_as_it_is(file.write(tmp_path / "a.glb"))
    file.json["nodes"][1]["children"] = [1]
    with pytest.raises(InputError, match=r"not a readable GLB file .*circle"):
        read_mesh(file.write(tmp_path / "a.glb"))


def test_gltf_uv_are_those_of_the_base_colour(tmp_path):
    file = File()
    file.attributes["TEXCOORD_1"] = file.accessor(UV * (1, -1) + (0, 1), FLOAT, "VEC2")
    file.attributes["TEXCOORD_0"] = file.accessor(0 * UV, FLOAT, "VEC2")
    file.material({"index": 0, "texCoord": 1})
    read_as_it_is(file.write(tmp_path / "a.glb"))


def test_gltf_texture_transform(tmp_path):
    """The specification's example: the lower left quarter of the image, turned."""
    file = File()
    file.json["extensionsRequired"] = ["KHR_texture_transform"]
    file.attributes["TEXCOORD_1"] = file.accessor(UV, FLOAT, "VEC2")
    change = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5], "texCoord": 1}
    file.material({"index": 0, "extensions": {"KHR_texture_transform": change}})
    uv = read_mesh(file.write(tmp_path / "a.glb"))[2]
    np.testing.assert_allclose(uv, UV[:, ::-1] * 0.5, atol=1e-6)  # v up


@pytest.mark.parametrize("mode, order", [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_gltf_strips_and_fans(tmp_path, mode, order):
    file = File()
    file.primitive |= {"mode": mode, "indices": file.accessor(order, USHORT)}
    vertices, faces, _ = read_mesh(file.write(tmp_path / "a.glb"))
    assert len(faces) == 2 and (face_vectors(vertices, faces)[:, 2] > 0).all()
    np.testing.assert_allclose(vertices, V, atol=1e-7)


def test_gltf_weights_of_morph_targets(tmp_path):
    file = File()
    file.attributes["POSITION"] = file.accessor(V - 0.5, FLOAT, "VEC3")
    file.primitive["targets"] = [{"POSITION": file.accessor(np.ones((4, 3)), FLOAT, "VEC3")}]
    file.json["meshes"][0]["weights"] = [0.5]
    read_as_it_is(file.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("required", [True, False])
@pytest.mark.parametrize("name", ["EXT_meshopt_compression", "KHR_draco_mesh_compression"])
def test_compressed_gltf_is_refused_by_name(tmp_path, name, required):
    file = File()
    if required:
        file.json["extensionsRequired"] = [name]
    elif name.startswith("EXT"):
        file.json["bufferViews"][0] |= {"buffer": 1, "extensions": {name: {"buffer": 0}}}
    else:
        del file.json["accessors"][0]["bufferView"]
        file.primitive["extensions"] = {name: {}}
    path = file.write(tmp_path / "a.glb")
    if not required and name.startswith("EXT"):
        text = path.read_bytes().replace(b'"buffers": [', b'"buffers": [{"byteLength": 48}, ')
        document = json.loads(text[20 : 20 + text[20:].index(b"BIN\0") - 4].decode())
        document["buffers"].reverse()
        (tmp_path / "a.gltf").write_text(json.dumps(document))
        path = tmp_path / "a.gltf"
    with pytest.raises(InputError, match=f"needs {name}, which is not read") as error:
        read_mesh(path)
    assert "\n" not in str(error.value) and path.name in str(error.value)


def test_gltf_with_harmless_extensions_and_without_faces(tmp_path):
    file = File()
    file.json["extensionsRequired"] = ["KHR_materials_unlit", "KHR_texture_basisu"]
    read_as_it_is(file.write(tmp_path / "a.glb"))
    file.primitive["mode"] = 0
    with pytest.raises(InputError, match=r"a\.glb: holds no faces"):
        read_mesh(file.write(tmp_path / "a.glb"))
    for number, change in enumerate(({"count": 99}, {"type": "VEC9"}, {"bufferView": 44})):
        broken = File()
        broken.json["accessors"][0] |= change
        path = broken.write(tmp_path / f"{number}.glb")
        with pytest.raises(InputError, match=r"not a readable GLB file") as error:
            read_mesh(path)
        assert "\n" not in str(error.value)


# --- numbers --------------------------------------------------------------------------------------


def test_coordinates_of_a_map_are_moved_before_they_are_rounded():
    points, faces = surfaces.sheet(lambda x, y: 0.05 * np.sin(9 * x), 0.15, 7)
    far = points + [5e5, 4e6, 100.0]
    moved, shift = centred(far)
    assert np.abs(moved - (far + shift)).max() < 1e-9 and np.abs(moved).max() < 0.2
    assert centred(points)[1] is None and centred(points + 100)[1] is None
    with pytest.raises(InputError, match="too far for single precision"):
        PatchedSurface.from_mesh(far, faces, 1)
    near, there = (PatchedSurface.from_mesh(p, faces, 1) for p in (points, moved))
    np.testing.assert_allclose(there.residual, near.residual, atol=1e-6)


def test_a_ply_of_other_shapes_is_not_written(tmp_path):
    V, F = np.eye(3), np.array([[0, 1, 2]])
    for wrong in (V[:, :2], F), (V, F + 1), (V, F, V[:2, :2]):
        with pytest.raises(InputError, match="a.ply: "):
            write_ply(tmp_path / "a.ply", *wrong)
    assert not list(tmp_path.iterdir())
