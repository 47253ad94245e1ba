"""A textured mesh that moves, as files that other programs play: USD, glTF, one OBJ or PLY a frame,
or arrays.

Everywhere: ``vertices`` (T, N, 3) [m] of T frames, in the axes of the file (right-handed, ``up``
says which way is up), ``faces`` (F, 3), counterclockwise as seen from outside; ``uv`` (N, 2)
texture coordinates, v up, or None; ``texture`` the path of an image, or None; ``fps`` frames a
second, the first at time 0. Files are written aside and renamed; InputError and OSError are raised
for what cannot be used or written.
"""

import io
import os
import tempfile

import numpy as np

from .errors import InputError
from .files import aside, folder_aside
from .mesh import face_vectors
from .meshio import write_ply

UP = {"y": np.diag([1.0, -1.0, -1.0]), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}


def from_camera(points, up="y"):
    """Points (..., 3) of an OpenCV camera frame (x right, y down, z forward) in a frame with y up,
    (x, -y, -z), or with z up, (x, z, -y).

    Both are rotations about x: nothing is mirrored. The camera stays at the origin; with y up it
    looks along -z, as the cameras of glTF and USD do.
    """
    return np.asarray(points) @ UP[up].T.astype(np.asarray(points).dtype)


def normals(vertices, faces):
    """Unit normals (T, N, 3) of the vertices, each the mean of its faces' normals by area; zero
    where there is none.
    """
    out = np.zeros(np.shape(vertices), np.float64)
    for V, n in zip(np.asarray(vertices, np.float64), out):
        across = face_vectors(V, faces)
        for k in range(3):
            np.add.at(n, faces[:, k], across)
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
    return out.astype(np.float32)


def _checked(vertices, faces, uv, fps):
    V, F = np.asarray(vertices, np.float32), np.asarray(faces, np.int64)
    if (
        V.ndim != 3
        or V.shape[2] != 3
        or not V.size
        or F.ndim != 2
        or F.shape[1:] != (3,)
        or not F.size
    ):
        raise InputError(
            f"animation: vertices {V.shape}, faces {F.shape}; (T, N, 3) and (F, 3), neither empty,"
            " are needed"
        )
    if not np.isfinite(V).all() or not 0 <= F.min() <= F.max() < V.shape[1]:
        raise InputError(
            f"animation: positions that are not finite, or faces beyond the {V.shape[1]} vertices"
        )
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(f"animation: {fps} frames a second; a positive number is needed")
    if uv is not None:
        uv = np.asarray(uv, np.float32)
        if uv.shape != (V.shape[1], 2):
            raise InputError(f"animation: uv {uv.shape}; ({V.shape[1]}, 2) is needed")
        uv = np.nan_to_num(uv)
    return V, F, uv


def encoded(texture):
    """``(bytes, extension)`` of an image file as PNG or JPEG, which is what USD and glTF take: as
    it is where it is one, else as PNG.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(texture) as image:
            if image.format in ("PNG", "JPEG"):
                with open(texture, "rb") as file:
                    return file.read(), {"PNG": "png", "JPEG": "jpg"}[image.format]
            data = io.BytesIO()
            image.convert("RGB").save(data, "PNG")
            return data.getvalue(), "png"
    except FileNotFoundError:
        raise InputError(f"{texture}: no such file; the image of the texture is needed") from None
    except (UnidentifiedImageError, SyntaxError, ValueError) as error:
        raise InputError(
            f"{texture}: not an image that can be embedded ({error}); PNG, JPEG, TIFF, BMP or WebP"
            " is needed"
        ) from None


# ---- USD -----------------------------------------------------------------------------------------


def write_usd(path, vertices, faces, uv=None, texture=None, *, fps=24.0, up="y", name="surface"):
    """Write a USD scene, its format by the extension: ``.usdz`` (one file with the texture in it),
    ``.usdc``, ``.usda``, or ``.usd``, for which the texture is written beside as NAME_texture.png
    or .jpg.

    A Mesh ``/name/mesh`` with ``points``, ``normals`` and ``extent`` at the time codes 0 to T - 1,
    ``fps`` time codes a second, metersPerUnit 1, no subdivision, and a UsdPreviewSurface with the
    texture. Needs usd-core.
    """
    vertices, faces, uv = _checked(vertices, faces, uv, fps)
    stem, extension = os.path.splitext(os.fspath(path))
    if extension.lower() not in (".usd", ".usda", ".usdc", ".usdz"):
        raise InputError(f"{path}: .usdz, .usdc, .usda or .usd is needed")
    data, kind = encoded(texture) if texture is not None and uv is not None else (None, None)
    if extension.lower() == ".usdz":
        _write_usdz(path, vertices, faces, uv, data, kind, fps, up, name)
        return
    image = f"{os.path.basename(stem)}_texture.{kind}" if data else None
    stage = _stage(vertices, faces, uv, image and f"./{image}", fps, up, name)
    if data:
        with (
            aside(os.path.join(os.path.dirname(stem), image)) as temporary,
            open(temporary, "wb") as file,
        ):
            file.write(data)
    with aside(path) as temporary:
        stage.GetRootLayer().Export(temporary)


def _write_usdz(path, vertices, faces, uv, data, kind, fps, up, name):
    from pxr import Sdf, UsdUtils

    with aside(path) as temporary, tempfile.TemporaryDirectory() as folder:
        if data:
            with open(os.path.join(folder, f"texture.{kind}"), "wb") as file:
                file.write(data)
        inner = os.path.join(folder, "surface.usdc")
        stage = _stage(vertices, faces, uv, f"./texture.{kind}" if data else None, fps, up, name)
        stage.GetRootLayer().Export(inner)  # the stage must live on: layers are held weakly
        UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(inner), temporary)


def _stage(vertices, faces, uv, image, fps, up, name):
    """The scene, in memory; ``image``: the texture's path as the file shall name it."""
    from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up.upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(vertices) - 1)
    root = UsdGeom.Xform.Define(stage, f"/{Tf.MakeValidIdentifier(name)}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    mesh = UsdGeom.Mesh.Define(stage, root.GetPath().AppendChild("mesh"))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    points, normal, extent = (
        mesh.CreatePointsAttr(),
        mesh.CreateNormalsAttr(),
        mesh.CreateExtentAttr(),
    )
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    for k, (V, n) in enumerate(zip(vertices, normals(vertices, faces))):
        points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(V)), k)
        normal.Set(Vt.Vec3fArray.FromNumpy(n), k)
        extent.Set([Gf.Vec3f(*map(float, V.min(0))), Gf.Vec3f(*map(float, V.max(0)))], k)
    material = UsdShade.Material.Define(stage, root.GetPath().AppendChild("material"))
    shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("preview"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.9)
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    colour = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    if uv is not None:
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        st.Set(Vt.Vec2fArray.FromNumpy(uv))
    if image:
        reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("uv"))
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        bitmap = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("texture"))
        bitmap.CreateIdAttr("UsdUVTexture")
        bitmap.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(image))
        bitmap.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        for axis in ("wrapS", "wrapT"):
            bitmap.CreateInput(axis, Sdf.ValueTypeNames.Token).Set("clamp")
        place = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        bitmap.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(place)
        colour.ConnectToSource(bitmap.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    else:
        colour.Set(Gf.Vec3f(0.72, 0.72, 0.72))
    material.CreateSurfaceOutput().ConnectToSource(
        shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    )
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return stage


# ---- glTF ----------------------------------------------------------------------------------------


def write_glb(path, vertices, faces, uv=None, texture=None, *, fps=24.0, name="surface"):
    """Write binary glTF 2.0 (``.glb``): the first frame as the mesh, a morph target for each later
    one, and an animation of their weights, which blends each frame into the next. ``vertices`` have
    y up, as glTF has it. Needs pygltflib.
    """
    import pygltflib as gltf

    vertices, faces, uv = _checked(vertices, faces, uv, fps)
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


# ---- a file a frame, and arrays ------------------------------------------------------------------


def write_frames(folder, kind, vertices, faces, uv=None, texture=None, *, labels=None, up="y"):
    """Write one mesh a frame into a new or empty ``folder``: ``kind`` "obj", with a material file
    and the texture, or "ply", with uv as ``s``, ``t``.

    ``labels`` (T,): the frames' numbers in the file names, by default 0 to T - 1. A folder that
    holds nothing but such files is replaced.
    """
    vertices, faces, uv = _checked(vertices, faces, uv, 1)
    ours = lambda name: (
        name in ("surface.mtl", "texture.png", "texture.jpg")
        or (name.endswith(f".{kind}") and name[: -len(kind) - 1].isdigit())
    )
    data, image = (
        encoded(texture)
        if kind == "obj" and texture is not None and uv is not None
        else (None, None)
    )
    with folder_aside(folder, ours) as place:
        if data:
            with open(os.path.join(place, f"texture.{image}"), "wb") as file:
                file.write(data)
        if kind == "obj":
            with open(os.path.join(place, "surface.mtl"), "w", encoding="ascii") as file:
                file.write(
                    "newmtl surface\nKd 1 1 1\nKs 0 0 0\nillum 1\n"
                    + (f"map_Kd texture.{image}\n" if data else "")
                )
        for label, V in zip(range(len(vertices)) if labels is None else labels, vertices):
            name = os.path.join(place, f"{int(label):03d}.{kind}")
            if kind == "ply":
                write_ply(name, V, faces, uv)
            else:
                _write_obj(name, V, faces, uv, up)


def _write_obj(path, V, F, uv, up):
    corner = ("{0}/{0}" if uv is not None else "{0}").format
    with open(path, "w", encoding="ascii") as file:
        file.write(f"# metres, {up} up\nmtllib surface.mtl\no surface\n")
        file.writelines("v {:.9g} {:.9g} {:.9g}\n".format(*p) for p in V.tolist())
        if uv is not None:
            file.writelines("vt {:.9g} {:.9g}\n".format(*t) for t in uv.tolist())
        file.write("usemtl surface\ns 1\n")
        file.writelines("f " + " ".join(corner(k + 1) for k in face) + "\n" for face in F.tolist())
