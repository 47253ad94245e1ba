"""A moving mesh as binary glTF 2.0: as it is in each frame, or skinned by a skeleton's joints."""

import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from polyfit.errors import InputError
from polyfit.files import aside

from .moving import check_up, checked, encoded, normals

GREY = (0.72, 0.72, 0.72)


class _File:
    """A glTF document that grows: ``out``, and the bytes of its buffer."""

    def __init__(self):
        import pygltflib as gltf

        self.gltf, self.blob = gltf, bytearray()
        self.out = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="polyfit"))

    def view(self, raw, target=None):
        self.blob.extend(b"\0" * (-len(self.blob) % 4))
        self.out.bufferViews.append(
            self.gltf.BufferView(
                buffer=0, byteOffset=len(self.blob), byteLength=len(raw), target=target
            )
        )
        self.blob.extend(raw)
        return len(self.out.bufferViews) - 1

    def accessor(self, array, form, target=None, component=None, bounds=False):
        array = np.ascontiguousarray(array)
        low, high = np.atleast_1d(array.min(0)), np.atleast_1d(array.max(0))
        limits = {"min": low.tolist(), "max": high.tolist()} if bounds else {}
        self.out.accessors.append(
            self.gltf.Accessor(
                bufferView=self.view(array.tobytes(), target),
                componentType=component or self.gltf.FLOAT,
                count=len(array),
                type=form,
                **limits,
            )
        )
        return len(self.out.accessors) - 1

    def geometry(self, positions, directions):
        buffer, vec3 = self.gltf.ARRAY_BUFFER, self.gltf.VEC3
        return self.gltf.Attributes(
            POSITION=self.accessor(positions, vec3, buffer, bounds=True),
            NORMAL=self.accessor(directions, vec3, buffer),
        )

    def indices(self, faces, count):
        """The accessor of ``faces`` (F, 3) of ``count`` vertices."""
        gltf, wide = self.gltf, count > 65535
        return self.accessor(
            faces.ravel().astype(np.uint32 if wide else np.uint16),
            gltf.SCALAR,
            gltf.ELEMENT_ARRAY_BUFFER,
            gltf.UNSIGNED_INT if wide else gltf.UNSIGNED_SHORT,
        )

    def material(self, name, paint):
        """The number of a material that both sides of cloth show; ``paint``: what of its PBR."""
        paint = self.gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=0.9, **paint)
        self.out.materials.append(
            self.gltf.Material(
                pbrMetallicRoughness=paint, doubleSided=True, name=name, alphaCutoff=None
            )
        )
        return len(self.out.materials) - 1

    def mesh(self, primitive, name, target_names):
        """The number of a mesh; its morph targets, where there are some, have weights of 0."""
        mesh = self.gltf.Mesh(primitives=[primitive], name=name)
        if target_names:
            mesh.weights, mesh.extras = [0.0] * len(target_names), {"targetNames": target_names}
        self.out.meshes.append(mesh)
        return len(self.out.meshes) - 1

    def animate(self, channels, count, fps):
        """The animation of ``count`` frames: ``channels`` of (node, path, values, form)."""
        gltf = self.gltf
        times = (np.arange(count) / fps).astype(np.float32)
        times, samplers, targets = self.accessor(times, gltf.SCALAR, bounds=True), [], []
        for node, path, values, form in channels:
            output = self.accessor(np.asarray(values, np.float32), form)
            samplers.append(
                gltf.AnimationSampler(input=times, output=output, interpolation="LINEAR")
            )
            target = gltf.AnimationChannelTarget(node=node, path=path)
            targets.append(gltf.AnimationChannel(sampler=len(samplers) - 1, target=target))
        self.out.animations = [gltf.Animation(samplers=samplers, channels=targets, name="motion")]

    def write(self, path, roots):
        """The file of a scene with the nodes ``roots``."""
        out = self.out
        out.scenes, out.scene = [self.gltf.Scene(nodes=roots)], 0
        out.buffers = [self.gltf.Buffer(byteLength=len(self.blob))]
        out.set_binary_blob(bytes(self.blob))
        with aside(path) as temporary:
            out.save_binary(temporary)


def _check_name(path):
    if not os.fspath(path).lower().endswith(".glb"):
        raise InputError(f"{path}: .glb is needed")


def write_glb(path, vertices, faces, uv=None, texture=None, *, fps=24.0, name="surface"):
    """Write binary glTF 2.0 (``.glb``): the first frame as the mesh, a morph target for each later
    one, and an animation of their weights, which blends each frame into the next. ``vertices`` have
    y up, as glTF has it; they are split along seams, for glTF has one uv a vertex. Needs pygltflib.
    """
    vertices, faces, uv = checked(vertices, faces, uv, fps)
    _check_name(path)
    data, kind = encoded(texture) if texture is not None and uv is not None else (None, None)
    file = _File()
    gltf, out = file.gltf, file.out
    n = normals(vertices, faces)
    if uv is not None:
        source, uv, faces = uv.split(faces)
        uv = np.nan_to_num(uv).astype(np.float32)
        vertices, n = vertices[:, source], n[:, source]
    attributes = file.geometry(vertices[0], n[0])
    if uv is not None:
        attributes.TEXCOORD_0 = file.accessor(
            np.stack([uv[:, 0], 1 - uv[:, 1]], 1), gltf.VEC2, gltf.ARRAY_BUFFER
        )
    targets = [file.geometry(V - vertices[0], d - n[0]) for V, d in zip(vertices[1:], n[1:])]
    index = file.indices(faces, vertices.shape[1])
    if data:
        out.images = [
            gltf.Image(
                bufferView=file.view(data),
                mimeType={"png": "image/png", "jpg": "image/jpeg"}[kind],
                name="texture",
            )
        ]
        out.samplers = [
            gltf.Sampler(
                magFilter=gltf.LINEAR,
                minFilter=gltf.LINEAR_MIPMAP_LINEAR,
                wrapS=gltf.CLAMP_TO_EDGE,
                wrapT=gltf.CLAMP_TO_EDGE,
            )
        ]
        out.textures = [gltf.Texture(source=0, sampler=0)]
        paint = dict(baseColorTexture=gltf.TextureInfo(index=0))
    else:
        paint = dict(baseColorFactor=[*GREY, 1.0])
    material = file.material(name, paint)
    primitive = gltf.Primitive(
        attributes=attributes, indices=index, material=material, targets=targets
    )
    mesh = file.mesh(primitive, name, [str(k) for k in range(1, len(vertices))])
    out.nodes = [gltf.Node(mesh=mesh, name=name)]
    if targets:
        weights = np.eye(len(vertices))[:, 1:].ravel()
        file.animate([(0, "weights", weights, gltf.SCALAR)], len(vertices), fps)
    file.write(path, [0])


@dataclass(frozen=True)
class Skeleton:
    """Joints that move: their ``names`` (J,), ``parents`` (J,), each before its children, -1 of the
    root; ``offsets`` (J, 3) [m] from the parent in its axes; ``inverse`` (J, 4, 4), from the rest
    space of the meshes to each joint's; ``rotations`` (T, J, 3) [rad], axis-angle vectors against
    the parent; ``translation`` (T, 3) [m], added to the root's offset.
    """

    names: Any
    parents: Any
    offsets: Any
    inverse: Any
    rotations: Any
    translation: Any


@dataclass(frozen=True)
class SkinnedMesh:
    """A mesh on a :class:`Skeleton`: ``vertices`` (N, 3) [m] at rest, ``faces`` (F, 3);
    ``joint_of`` (N, 4) and ``joint_weights`` (N, 4), rows that sum to one; ``shapes`` (R, N, 3)
    [m], added to the vertices by ``weights`` (T, R) before they are skinned; ``colour``, linear
    RGB.
    """

    name: str
    vertices: Any
    faces: Any
    joint_of: Any
    joint_weights: Any
    shapes: Any = ()
    weights: Any = field(default=(), repr=False)
    colour: Any = GREY


def write_skinned_glb(path, meshes, skeleton, *, fps=24.0, up="z"):
    """Write binary glTF 2.0 (``.glb``) of :class:`SkinnedMesh` meshes on one :class:`Skeleton`: a
    skin, a morph target for each of a mesh's shapes, and one animation of the joints and of the
    weights. ``up``: the axis that points up in all of it; a node above the root turns z up to y up.
    A shape's normals are those of its first order, at the vertices with all weights 0. Needs
    pygltflib.
    """
    _check_name(path)
    check_up(up)
    for mesh in meshes:
        checked(np.asarray(mesh.vertices)[None], mesh.faces, None, fps)
    _check(skeleton, meshes)
    file, count = _File(), len(skeleton.rotations)
    gltf, out = file.gltf, file.out
    joints = range(len(skeleton.names))
    parents = list(skeleton.parents)
    for j in joints:
        children = [k for k in joints if parents[k] == j]
        node = gltf.Node(name=skeleton.names[j], children=children)
        node.translation, node.rotation = np.asarray(skeleton.offsets[j]).tolist(), [0, 0, 0, 1]
        out.nodes.append(node)
    turn = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)] if up == "z" else [0.0, 0.0, 0.0, 1.0]
    top, root = len(out.nodes), parents.index(-1)
    out.nodes.append(gltf.Node(name="skeleton", rotation=turn, children=[root]))
    columns = np.asarray(skeleton.inverse, np.float32).swapaxes(-1, -2).reshape(-1, 16)
    inverse = file.accessor(columns, gltf.MAT4)
    out.skins = [gltf.Skin(joints=[*joints], inverseBindMatrices=inverse, skeleton=top)]
    # one sign of the quaternion from frame to frame: they are blended as they stand
    turns = np.asarray(skeleton.rotations, float).transpose(1, 0, 2)
    turns = Rotation.from_rotvec(turns.reshape(-1, 3)).as_quat().reshape(len(joints), count, 4)
    flips = np.where((turns[:, 1:] * turns[:, :-1]).sum(-1) < 0, -1.0, 1.0)
    turns[:, 1:] *= np.cumprod(flips, 1)[..., None]
    channels = [(j, "rotation", turns[j], gltf.VEC4) for j in joints]
    place = np.asarray(skeleton.offsets[root]) + np.asarray(skeleton.translation)
    channels.append((root, "translation", place, gltf.VEC3))
    for mesh in meshes:
        node = len(out.nodes)
        out.nodes.append(gltf.Node(name=mesh.name, mesh=_skinned(file, mesh), skin=0))
        if len(mesh.shapes):
            channels.append((node, "weights", np.asarray(mesh.weights).ravel(), gltf.SCALAR))
    file.animate(channels, count, fps)
    file.write(path, [top, *range(top + 1, len(out.nodes))])


def _check(skeleton, meshes):
    """Raises InputError where arrays do not fit each other, or are not as the classes say."""
    count, frames = len(skeleton.names), len(skeleton.rotations)
    needed = dict(offsets=(count, 3), inverse=(count, 4, 4), translation=(frames, 3))
    needed["rotations"] = (max(frames, 1), count, 3)
    _check_numbers("skeleton", skeleton, needed)
    parents = [*skeleton.parents]
    before = len(parents) == count and all(-1 <= p < k for k, p in enumerate(parents))
    if not before or parents.count(-1) != 1 or count > 256:
        raise InputError(
            f"animation: parents of {count} joints, at most 256: of each one that stands before it"
            " is needed, and -1 of one root"
        )
    for mesh in meshes:
        size, shapes = len(mesh.vertices), len(mesh.shapes)
        needed = dict(joint_of=(size, 4), joint_weights=(size, 4))
        more = dict(shapes=(shapes, size, 3), weights=(frames, shapes)) if shapes else {}
        _check_numbers(mesh.name, mesh, needed | more)
        weights = np.asarray(mesh.joint_weights)
        if weights.min() < 0 or np.abs(weights.sum(1) - 1).max() > 1e-3:
            why = "rows that sum to 1, none negative, are needed"
            raise InputError(f"animation: {mesh.name}: joint_weights: {why}")
        if not np.isin(np.asarray(mesh.joint_of)[weights > 0], np.arange(count)).all():
            why = f"0 to {count - 1}, the numbers of joints, are needed"
            raise InputError(f"animation: {mesh.name}: joint_of: {why}")


def _check_numbers(where, holder, needed):
    for name, shape in needed.items():
        try:
            array = np.asarray(getattr(holder, name), np.float64)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if array.shape != shape or not np.isfinite(array).all():
            found = f"{name} {array.shape}; {shape} of finite numbers is needed"
            raise InputError(f"animation: {where}: {found}")


def _skinned(file, mesh):
    """The number of the mesh of a :class:`SkinnedMesh`."""
    gltf = file.gltf
    vertices, shapes = (np.asarray(x, np.float32) for x in (mesh.vertices, mesh.shapes))
    faces = np.asarray(mesh.faces, np.int64)
    n = normals(vertices[None], faces)[0]
    attributes = file.geometry(vertices, n)
    weights = np.asarray(mesh.joint_weights, np.float32)
    joints = np.where(weights > 0, mesh.joint_of, 0).astype(np.uint8)
    buffer, vec4 = gltf.ARRAY_BUFFER, gltf.VEC4
    attributes.JOINTS_0 = file.accessor(joints, vec4, buffer, gltf.UNSIGNED_BYTE)
    attributes.WEIGHTS_0 = file.accessor(weights, vec4, buffer)
    step = 0.01  # of a weight
    change = [(normals((vertices + step * s)[None], faces)[0] - n) / step for s in shapes]
    targets = [file.geometry(s, c) for s, c in zip(shapes, change)]
    primitive = gltf.Primitive(
        attributes=attributes,
        indices=file.indices(faces, len(vertices)),
        material=file.material(mesh.name, dict(baseColorFactor=[*mesh.colour, 1.0])),
        targets=targets,
    )
    return file.mesh(primitive, mesh.name, [f"shape {k}" for k in range(len(shapes))])
