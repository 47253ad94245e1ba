"""A moving mesh as a USD scene."""

import contextlib
import os
import shutil
import tempfile

import numpy as np

from polyfit.errors import InputError
from polyfit.files import aside, naming

from .moving import check_up, checked, encoded, normals


def write_usd(path, vertices, faces, uv=None, texture=None, *, fps=24.0, up="y", name="surface"):
    """Write a USD scene, its format by the extension: ``.usdz`` (one file with the texture in it),
    ``.usdc``, ``.usda``, or ``.usd``, for which the texture is written beside as NAME_texture.png
    or .jpg.

    A Mesh ``/name/mesh`` with ``points``, ``normals`` and ``extent`` at the time codes 0 to T - 1,
    ``fps`` time codes a second, metersPerUnit 1, no subdivision, and a UsdPreviewSurface with the
    texture; ``primvars:st`` is a vertex's, or a face corner's where there are seams. Needs
    usd-core.
    """
    vertices, faces, uv = checked(vertices, faces, uv, fps)
    check_up(up)
    stem, extension = os.path.splitext(os.fspath(path))
    if extension.lower() not in (".usd", ".usda", ".usdc", ".usdz"):
        raise InputError(f"{path}: .usdz, .usdc, .usda or .usd is needed")
    data, kind = encoded(texture) if texture is not None and uv is not None else (None, None)
    is_packed = extension.lower() == ".usdz"
    image = (f"{os.path.basename(stem)}_" if not is_packed else "") + f"texture.{kind}"
    stage = _stage(vertices, faces, uv, f"./{image}" if data else None, fps, up, name)
    # written elsewhere and copied: where USD cannot write, it ends in a page of its own errors
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        made = os.path.join(folder, f"surface{'.usdc' if is_packed else extension.lower()}")
        files = {made: path}
        if data:
            beside = os.path.join(folder, image)
            files[beside] = os.path.join(os.path.dirname(stem), image)
            with naming(beside), open(beside, "wb") as file:
                file.write(data)
        stage.GetRootLayer().Export(made)
        if is_packed:
            from pxr import Sdf, UsdUtils

            files = {os.path.join(folder, "surface.usdz"): path}
            UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(made), *files)
        for source, target in files.items():
            temporary = stack.enter_context(aside(target))
            with open(source, "rb") as read, open(temporary, "wb") as written:
                shutil.copyfileobj(read, written)


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
        per_vertex = uv.of_vertices(faces, vertices.shape[1])
        whole = per_vertex is not None
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st",
            Sdf.ValueTypeNames.TexCoord2fArray,
            UsdGeom.Tokens.vertex if whole else UsdGeom.Tokens.faceVarying,
        )
        values = np.nan_to_num(per_vertex) if whole else uv.coordinates
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values, np.float32)))
        if not whole:
            st.SetIndices(Vt.IntArray.FromNumpy(uv.faces.astype(np.int32).ravel()))
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
