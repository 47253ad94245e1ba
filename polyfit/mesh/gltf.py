"""glTF 2.0 files (.glb, .gltf): the meshes of a scene at rest, as one, each in its place.

What moves and what shades is left aside: cameras, lights, animations, images.
"""

import base64
import binascii
import json
import os
import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from polyfit.errors import InputError

from .texcoords import TexCoords
from .triangles import welded

# Extensions that a file may require: read here, or about what a mesh does not have. Those of
# materials, and of images' formats, by how they begin
_READ = ("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual")
_HARMLESS = ("KHR_materials_", "KHR_texture_basisu", "EXT_texture_", "MSFT_texture_dds", "KHR_xmp")

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_LENGTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6  # modes of a primitive


def read_gltf(path: str) -> tuple[np.ndarray, np.ndarray, TexCoords | None]:
    """``(vertices (N, 3) float64, faces (F, 3) int64, texcoords or None)`` of the file's scene.

    Node transforms, the rest pose of skins and the weights of morph targets are applied; vertices
    that seams of the texture split are one again. Texture coordinates are those of the base
    colour's texture, with its ``KHR_texture_transform``, else the first set, v up; faces without
    any have -1. Raises InputError in one line, for a required extension that is not read by its
    name.
    """
    try:
        return _Document.open(path).mesh()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except (
        ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error, RecursionError,
        binascii.Error,
    ) as error:  # fmt: skip
        kind = os.path.splitext(path)[1][1:].upper()
        raise InputError(
            f"{path}: not a readable {kind} file ({type(error).__name__}: {error})"
        ) from None


def _refuse_extensions(names: Any) -> None:
    names = ", ".join(sorted(names))
    if names:
        raise InputError(
            f"needs {names}, which is not read; export it without (compression off), or as OBJ"
        )


@dataclass(frozen=True)
class _Document:
    """``json``: the document; ``binary``: the chunk of a .glb; ``folder``: where its files are."""

    json: dict[str, Any]
    binary: bytes | None
    folder: str

    @classmethod
    def open(cls, path: str) -> "_Document":
        with open(path, "rb") as file:
            raw = file.read()
        binary, text = None, raw
        if raw[:4] == b"glTF":
            at, text = 12, b""
            while at + 8 <= len(raw):
                length, kind = struct.unpack_from("<I4s", raw, at)
                chunk = raw[at + 8 : at + 8 + length]
                if len(chunk) < length:
                    raise ValueError("it is cut off")
                if kind == b"JSON" and not text:
                    text = chunk
                elif kind == b"BIN\0" and binary is None:
                    binary = chunk
                at += 8 + length
        document = json.loads(text.decode("utf-8-sig"))
        version = str(document["asset"]["version"])
        if version.split(".")[0] != "2":
            raise InputError(f"is glTF {version}; glTF 2 is read")
        required = set(document.get("extensionsRequired", ()))
        _refuse_extensions(
            name for name in required if name not in _READ and not name.startswith(_HARMLESS)
        )
        return cls(document, binary, os.path.dirname(path))

    def mesh(self) -> tuple[np.ndarray, np.ndarray, TexCoords | None]:
        parts = []
        for node, world in self._placed():
            if "mesh" in node:
                parts.extend(self._parts(node, world))
        if not parts:
            raise InputError("holds no faces; a triangle mesh is needed")
        vertices, faces, coordinates, corners, before, known = [], [], [], [], 0, 0
        for V, F, uv in parts:
            vertices.append(V)
            faces.append(F + before)
            before += len(V)
            corners.append(np.full(F.shape, -1) if uv is None else F + known)
            if uv is not None:
                coordinates.append(uv)
                known += len(uv)
        V, F = np.concatenate(vertices), np.concatenate(faces)
        if F.size and F.max() >= len(V):
            raise ValueError(f"faces name vertex {F.max()} of {len(V)}")
        texcoords = None
        if coordinates:
            texcoords = TexCoords(np.concatenate(coordinates), np.concatenate(corners))
        kept, F = welded(V, F)
        return V[kept], F, texcoords

    @cached_property
    def _worlds(self) -> list[np.ndarray]:
        """The matrix (4, 4) of each node to the axes of its root."""
        nodes = self.json["nodes"]
        children = {child for node in nodes for child in node.get("children", ())}
        worlds: dict[int, np.ndarray] = {}
        pending = [(k, np.eye(4)) for k in range(len(nodes)) if k not in children]
        while pending:
            k, above = pending.pop()
            if k in worlds:
                raise ValueError(f"node {k} hangs on several others")
            worlds[k] = above @ _local(nodes[k])
            pending.extend((child, worlds[k]) for child in nodes[k].get("children", ()))
        if len(worlds) < len(nodes):
            raise ValueError("nodes hang on one another in a circle")
        return [worlds[k] for k in range(len(nodes))]

    def _placed(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """(node, its matrix (4, 4)) of the scene, in the file's order; meshes of a file without
        nodes lie as they are.
        """
        nodes = self.json.get("nodes", [])
        if not nodes:
            return [({"mesh": k}, np.eye(4)) for k in range(len(self.json.get("meshes", ())))]
        scenes = self.json.get("scenes", [])
        if not scenes:
            return list(zip(nodes, self._worlds))
        worlds, inside = self._worlds, set()
        pending = list(scenes[self.json.get("scene", 0)].get("nodes", []))
        while pending:
            k = pending.pop()
            inside.add(k)
            pending.extend(nodes[k].get("children", ()))
        return [(nodes[k], worlds[k]) for k in sorted(inside)]

    def _parts(self, node: dict[str, Any], world: np.ndarray) -> Any:
        """Yield (vertices, faces, uv or None) of each primitive of a node's mesh that has
        triangles.
        """
        mesh = self.json["meshes"][node["mesh"]]
        weights = node.get("weights", mesh.get("weights", ()))
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in primitive["attributes"]:
                continue
            attributes = primitive["attributes"]
            compressed = [n for n in primitive.get("extensions", ()) if "compression" in n]
            if "bufferView" not in self.json["accessors"][attributes["POSITION"]]:
                _refuse_extensions(compressed)
            V = self._accessor(attributes["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", ())):
                if weight and "POSITION" in target:
                    V = V + weight * self._accessor(target["POSITION"])
            count = len(V)
            indices = np.arange(count)
            if "indices" in primitive:
                indices = self._accessor(primitive["indices"])[:, 0].astype(np.int64)
            F = _faces(indices, mode)
            if not len(F):
                continue
            if F.max() >= count:
                raise ValueError(f"faces name vertex {F.max()} of {count}")
            V, mirrored = self._at_rest(V, attributes, node, world)
            yield V, F[:, ::-1] if mirrored else F, self._uv(primitive)

    def _at_rest(
        self, V: np.ndarray, attributes: dict[str, Any], node: dict[str, Any], world: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """Vertices (N, 3) in the scene's axes, and whether they are mirrored: by the joints of
        their skin in its pose in the file, else by the matrix of their node.
        """
        if "skin" not in node or "JOINTS_0" not in attributes:
            return V @ world[:3, :3].T + world[:3, 3], np.linalg.det(world[:3, :3]) < 0
        skin = self.json["skins"][node["skin"]]
        matrices = np.stack([self._worlds[k] for k in skin["joints"]])
        if "inverseBindMatrices" in skin:
            inverse = self._accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            matrices = matrices @ inverse.transpose(0, 2, 1)[: len(matrices)]  # columns first
        mixed, total = np.zeros((len(V), 4, 4)), np.zeros(len(V))
        for k in range(8):
            if f"JOINTS_{k}" not in attributes:
                break
            joint = self._accessor(attributes[f"JOINTS_{k}"]).astype(np.int64)
            share = self._accessor(attributes[f"WEIGHTS_{k}"])
            mixed += np.einsum("nk,nkij->nij", share, matrices[joint])
            total += share.sum(axis=1)
        mixed[total <= 0] = matrices[0]  # which hang on no joint: on the first, as in viewers
        mixed /= np.where(total > 0, total, 1)[:, None, None]
        placed = np.einsum("nij,nj->ni", mixed[:, :3, :3], V) + mixed[:, :3, 3]
        return placed, np.median(np.linalg.det(mixed[:, :3, :3])) < 0

    def _uv(self, primitive: dict[str, Any]) -> np.ndarray | None:
        """Texture coordinates (N, 2) of a primitive, v up, or None."""
        material: dict[str, Any] = {}
        if "material" in primitive:
            material = self.json["materials"][primitive["material"]]
        older = "KHR_materials_pbrSpecularGlossiness"
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        texture = texture or material.get("extensions", {}).get(older, {}).get("diffuseTexture")
        texture = texture or {}
        change = texture.get("extensions", {}).get("KHR_texture_transform", {})
        number = change.get("texCoord", texture.get("texCoord", 0))
        at = primitive["attributes"].get(f"TEXCOORD_{number}")
        if at is None:
            return None
        uv = self._accessor(at)[:, :2]
        c, s = np.cos(change.get("rotation", 0.0)), np.sin(change.get("rotation", 0.0))
        uv = uv * change.get("scale", (1.0, 1.0)) @ [[c, -s], [s, c]]
        return (uv + change.get("offset", (0.0, 0.0))) * (1, -1) + (0, 1)

    def _accessor(self, index: int) -> np.ndarray:
        """Values (count, components) float64 of an accessor: of any type, normalised, interleaved
        or sparse.
        """
        accessor = self.json["accessors"][index]
        size, count = _LENGTHS[accessor["type"]], accessor["count"]
        component = accessor["componentType"]
        if "bufferView" in accessor:
            offset = accessor.get("byteOffset", 0)
            values = self._array(accessor["bufferView"], offset, component, count, size)
        else:
            values = np.zeros((count, size))
        if "sparse" in accessor:
            sparse, values = accessor["sparse"], values.copy()
            where, new = sparse["indices"], sparse["values"]
            rows = self._array(
                where["bufferView"], where.get("byteOffset", 0), where["componentType"],
                sparse["count"], 1,
            )  # fmt: skip
            values[rows[:, 0].astype(np.int64)] = self._array(
                new["bufferView"], new.get("byteOffset", 0), component, sparse["count"], size
            )
        if accessor.get("normalized") and component in (5120, 5121, 5122, 5123):
            values = np.maximum(values / np.iinfo(_COMPONENTS[component]).max, -1.0)
        return values

    def _array(self, index: int, offset: int, component: int, count: int, size: int) -> np.ndarray:
        """Rows (count, size) float64 of a buffer view, from a byte on."""
        view = self.json["bufferViews"][index]
        kind = np.dtype(_COMPONENTS[component])
        data = self._buffers(view)
        start, width = view.get("byteOffset", 0) + offset, kind.itemsize * size
        stride = view.get("byteStride", width)
        end = view.get("byteOffset", 0) + view["byteLength"]
        if count and (start + stride * (count - 1) + width > min(end, len(data)) or stride < width):
            raise ValueError("an accessor reaches beyond its buffer")
        rows = np.ndarray((count, size), kind, data, start, (stride, kind.itemsize))
        return rows.astype(np.float64)

    def _buffers(self, view: dict[str, Any]) -> bytes:
        """The bytes of a view's buffer."""
        index = view["buffer"]
        buffer = self.json["buffers"][index]
        uri = buffer.get("uri")
        if uri is None:
            if index == 0 and self.binary is not None:
                return self.binary
            _refuse_extensions({*view.get("extensions", ()), *buffer.get("extensions", ())})
            raise ValueError(f"buffer {index} has no data")
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        try:
            with open(os.path.join(self.folder, unquote(uri)), "rb") as file:
                return file.read()
        except FileNotFoundError:
            raise InputError(f"its file {uri} is not there") from None


def _local(node: dict[str, Any]) -> np.ndarray:
    """A node's own matrix (4, 4)."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T  # columns first
    out = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix()
    out[:3, :3] = turn * np.asarray(node.get("scale", (1.0, 1.0, 1.0)))
    out[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return out


def _faces(indices: np.ndarray, mode: int) -> np.ndarray:
    """Triangles (F, 3) of a primitive's indices (K,); those of a strip without area left out."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    a, b, c = indices[:-2], indices[1:-1], indices[2:]
    if mode == _FAN:
        return np.stack([np.full(len(b), indices[0]), b, c], axis=1)
    odd = np.arange(len(a)) % 2 == 1
    F = np.stack([a, np.where(odd, c, b), np.where(odd, b, c)], axis=1)
    return F[(np.roll(F, 1, axis=1) != F).all(axis=1)]
