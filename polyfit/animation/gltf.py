"""A moving mesh as binary glTF 2.0."""

import os

import numpy as np

from polyfit.errors import InputError
from polyfit.files import aside

from .moving import checked, encoded, normals


def write_glb(path, vertices, faces, uv=None, texture=None, *, fps=24.0, name="surface"):
    """Write binary glTF 2.0 (``.glb``): the first frame as the mesh, a morph target for each later
    one, and an animation of their weights, which blends each frame into the next. ``vertices`` have
    y up, as glTF has it; they are split along seams, for glTF has one uv a vertex. Needs pygltflib.
    """
    import pygltflib as gltf

    vertices, faces, uv = checked(vertices, faces, uv, fps)
    if not os.fspath(path).lower().endswith(".glb"):
        raise InputError(f"{path}: .glb is needed")
    data, kind = encoded(texture) if texture is not None and uv is not None else (None, None)
    out, blob = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="polyfit")), bytearray()

    def view(raw, target=None):
        blob.extend(b"\0" * (-len(blob) % 4))
        out.bufferViews.append(
            gltf.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(raw), target=target)
        )
        blob.extend(raw)
        return len(out.bufferViews) - 1

    def accessor(array, form, target=None, component=gltf.FLOAT, bounds=False):
        array = np.ascontiguousarray(array)
        limits = (
            {
                "min": np.atleast_1d(array.min(0)).tolist(),
                "max": np.atleast_1d(array.max(0)).tolist(),
            }
            if bounds
            else {}
        )
        out.accessors.append(
            gltf.Accessor(
                bufferView=view(array.tobytes(), target),
                componentType=component,
                count=len(array),
                type=form,
                **limits,
            )
        )
        return len(out.accessors) - 1

    def geometry(positions, directions):
        return gltf.Attributes(
            POSITION=accessor(positions, gltf.VEC3, gltf.ARRAY_BUFFER, bounds=True),
            NORMAL=accessor(directions, gltf.VEC3, gltf.ARRAY_BUFFER),
        )

    n = normals(vertices, faces)
    if uv is not None:
        source, uv, faces = uv.split(faces)
        vertices, n = vertices[:, source], n[:, source]
    attributes = geometry(vertices[0], n[0])
    if uv is not None:
        attributes.TEXCOORD_0 = accessor(
            np.stack([uv[:, 0], 1 - uv[:, 1]], 1), gltf.VEC2, gltf.ARRAY_BUFFER
        )
    targets = [geometry(V - vertices[0], d - n[0]) for V, d in zip(vertices[1:], n[1:])]
    wide = vertices.shape[1] > 65535
    index = accessor(
        faces.ravel().astype(np.uint32 if wide else np.uint16),
        gltf.SCALAR,
        gltf.ELEMENT_ARRAY_BUFFER,
        gltf.UNSIGNED_INT if wide else gltf.UNSIGNED_SHORT,
    )
    paint = gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=0.9)
    if data:
        out.images = [
            gltf.Image(
                bufferView=view(data),
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
        paint.baseColorTexture = gltf.TextureInfo(index=0)
    else:
        paint.baseColorFactor = [0.72, 0.72, 0.72, 1.0]
    out.materials = [
        gltf.Material(pbrMetallicRoughness=paint, doubleSided=True, name=name, alphaCutoff=None)
    ]
    primitive = gltf.Primitive(attributes=attributes, indices=index, material=0, targets=targets)
    mesh = gltf.Mesh(primitives=[primitive], name=name)
    if targets:
        mesh.weights, mesh.extras = (
            [0.0] * len(targets),
            {"targetNames": [str(k) for k in range(1, len(vertices))]},
        )
        times = accessor(
            (np.arange(len(vertices)) / fps).astype(np.float32), gltf.SCALAR, bounds=True
        )
        weights = accessor(np.eye(len(vertices), dtype=np.float32)[:, 1:].ravel(), gltf.SCALAR)
        sampler = gltf.AnimationSampler(input=times, output=weights, interpolation="LINEAR")
        channel = gltf.AnimationChannel(
            sampler=0, target=gltf.AnimationChannelTarget(node=0, path="weights")
        )
        out.animations = [gltf.Animation(samplers=[sampler], channels=[channel], name="motion")]
    out.meshes, out.nodes, out.scenes, out.scene = (
        [mesh],
        [gltf.Node(mesh=0, name=name)],
        [gltf.Scene(nodes=[0])],
        0,
    )
    out.buffers = [gltf.Buffer(byteLength=len(blob))]
    out.set_binary_blob(bytes(blob))
    with aside(path) as temporary:
        out.save_binary(temporary)
