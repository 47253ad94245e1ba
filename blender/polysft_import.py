"""Blender add-on: File > Import > PolySfT opens a run or a drape as an animated, textured object.

Install it by Edit > Preferences > Add-ons > Install from Disk, and choose this file. It takes the
``surface.npz`` of a run's folder, the ``drape.npz`` of onefit's, and what ``polysft export --format
npz`` writes. It needs nothing but Blender, 4.2 or newer.

The surface becomes a mesh in metres with z up, whose absolute shape keys are the frames, exact at
each and linear between; frame k of the result is frame k of the timeline, from 0. Its texture
coordinates keep their seams. Of a run come also the rate, the texture, and the camera, at the
origin, with its focal lengths, principal point and size; of a drape the rate and the body.
"""

import json
import os
import re
import xml.etree.ElementTree as ET
from fractions import Fraction

import bpy
import numpy as np
from bpy.props import StringProperty
from bpy_extras.io_utils import ImportHelper

bl_info = {
    "name": "PolySfT import",
    "author": "the PolySfT on Mitsuba 3 authors",
    "version": (0, 2, 0),
    "blender": (4, 2, 0),
    "location": "File > Import > PolySfT (.npz)",
    "description": "Moving surfaces of PolySfT and OneFit, with texture, rate and camera",
    "category": "Import-Export",
}

_KEY = 10.0  # what Blender's evaluation time grows by from one absolute shape key to the next
_TO_Z_UP = {  # the axes of a file's points to x right, y away from the viewer, z up
    "camera": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}


class ImportPolySfT(bpy.types.Operator, ImportHelper):
    """Open the moving surface of a PolySfT run or of a OneFit drape"""

    bl_idname = "import_scene.polysft"
    bl_label = "Import PolySfT"
    bl_options = {"REGISTER", "UNDO"}
    filename_ext = ".npz"
    filter_glob: StringProperty(default="surface.npz;drape.npz;*.npz", options={"HIDDEN"})

    def execute(self, context):
        """Called by Blender when a file was chosen."""
        try:
            found = open_file(self.filepath, context)
        except (OSError, ValueError, KeyError, ET.ParseError) as error:
            self.report({"ERROR"}, f"{self.filepath}: {error}")
            return {"CANCELLED"}
        for other in context.selected_objects:
            other.select_set(False)
        for thing in found:
            thing.select_set(True)
        context.view_layer.objects.active = found[0]
        return {"FINISHED"}


def open_file(path, context):
    """The objects made of a file, or of a folder that holds one, in ``context``'s collection: the
    surface first, then the body or the camera. The scene's frames, rate and size become theirs.
    """
    path = bpy.path.abspath(path)
    if os.path.isdir(path):
        names = [n for n in ("surface.npz", "drape.npz") if os.path.isfile(os.path.join(path, n))]
        if not names:
            raise ValueError("holds no surface.npz and no drape.npz")
        path = os.path.join(path, names[0])
    folder = os.path.dirname(path)
    name = os.path.basename(os.path.abspath(folder)) or "surface"
    with np.load(path) as arrays:
        a = {key: arrays[key] for key in arrays.files}
    missing = [key for key in ("vertices", "faces") if key not in a]
    if missing:
        raise ValueError(f"holds no {' and no '.join(missing)}")
    drape = "body" in a
    up = str(a["up"]) if "up" in a else "z" if drape else "camera"
    about = _json(os.path.join(folder, "run.json"))
    rate = float(a["fps"]) if "fps" in a else float(about.get("fps", 15))
    texture = _texture(os.path.join(folder, "scene.xml"))

    kind = "mesh_" if "mesh_vertices" in a else ""  # of a drape: the mesh of the garment's file
    vertices, faces = a[f"{kind}vertices"] @ _TO_Z_UP[up].T, a[f"{kind}faces"]
    material = _material(name, texture, (0.08, 0.19, 0.42) if drape else (0.6, 0.6, 0.6))
    found = [_moving(name, vertices, faces, _corners(a, faces), material, context)]
    if drape:
        skin = _material(f"{name} body", None, (0.5, 0.48, 0.46))
        found.append(_moving(f"{name} body", a["body"], a["body_faces"], None, skin, context))
    camera = _json(os.path.join(folder, "camera.json"))
    if camera and up == "camera":
        found.append(_camera(f"{name} camera", camera, context))
    scene = context.scene
    scene.frame_start, scene.frame_end = 0, len(vertices) - 1
    fraction = Fraction(rate).limit_denominator(1001)
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = float(scene.render.fps / fraction)
    scene.frame_set(0)
    return found


def _corners(a, faces):
    """Texture coordinates (F, 3, 2) of the faces' corners, or None."""
    if "uv" not in a:
        return None
    index = a.get("uv_faces", faces)
    return np.where(index[..., None] < 0, 0, np.nan_to_num(a["uv"][index]))


def _moving(name, vertices, faces, corners, material, context):
    """An object of vertices (T, N, 3) [m, z up], one absolute shape key a frame."""
    count, size = vertices.shape[:2]
    vertices = np.ascontiguousarray(vertices, np.float32)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(size)
    mesh.vertices.foreach_set("co", vertices[0].ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel().astype(np.int32))
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    if corners is not None:
        layer = mesh.uv_layers.new(name="uv")
        layer.data.foreach_set("uv", corners.astype(np.float32).ravel())
    mesh.materials.append(material)
    mesh.update(calc_edges=True)
    thing = bpy.data.objects.new(name, mesh)
    context.collection.objects.link(thing)
    if count == 1:
        return thing
    for k, points in enumerate(vertices):
        key = thing.shape_key_add(name=f"{k:04d}", from_mix=False)
        key.interpolation = "KEY_LINEAR"
        key.points.foreach_set("co", points.ravel())
    keys = mesh.shape_keys
    keys.use_relative = False
    keys.eval_time = 0.0
    keys.keyframe_insert("eval_time", frame=0)
    keys.eval_time = _KEY * (count - 1)
    keys.keyframe_insert("eval_time", frame=count - 1)
    for curve in _curves(keys):
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
        curve.extrapolation = "CONSTANT"
    return thing


def _curves(keys):
    """The animation curves of an object's data, which Blender 5 keeps in slots."""
    action = keys.animation_data.action
    if hasattr(action, "fcurves"):
        return action.fcurves
    slot = keys.animation_data.action_slot
    return [c for layer in action.layers for s in layer.strips for c in s.channelbag(slot).fcurves]


def _material(name, texture, colour):
    """A matte material with the image ``texture``, or of a colour (linear RGB)."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = next(n for n in nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Roughness"].default_value = 0.9
    shader.inputs["Specular IOR Level"].default_value = 0.0
    shader.inputs["Base Color"].default_value = (*colour, 1)
    if texture is not None:
        image = nodes.new("ShaderNodeTexImage")
        image.image = bpy.data.images.load(texture, check_existing=True)
        image.extension = "EXTEND"
        image.location = (-300, 300)
        links.new(image.outputs["Color"], shader.inputs["Base Color"])
    return material


def _camera(name, c, context):
    """The camera of a camera.json [pixels], at the origin, looking along y; the scene renders its
    images.
    """
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = c["fx"] * data.sensor_width / c["width"]
    data.shift_x = 0.5 - c["cx"] / c["width"]
    data.shift_y = (c["cy"] - 0.5 * c["height"]) * c["fx"] / c["fy"] / c["width"]
    data.clip_start, data.display_size = 0.001, 0.1
    thing = bpy.data.objects.new(name, data)
    thing.rotation_euler = (np.pi / 2, 0, 0)
    context.collection.objects.link(thing)
    render, context.scene.camera = context.scene.render, thing
    render.resolution_x, render.resolution_y = int(c["width"]), int(c["height"])
    render.resolution_percentage = 100
    render.pixel_aspect_x = max(1.0, c["fy"] / c["fx"])
    render.pixel_aspect_y = max(1.0, c["fx"] / c["fy"])
    return thing


def _json(path):
    if not os.path.isfile(path):
        return {}
    with open(path, encoding="utf-8") as file:
        return json.load(file)


def _texture(scene):
    """The path of the template's texture that a run's scene file names, None where it is gone."""
    if not os.path.isfile(scene):
        return None
    root = ET.parse(scene).getroot()
    defaults = {d.get("name"): d.get("value", "") for d in root.iter("default")}
    shapes = root.findall("shape[@id='template']") or root.findall("shape")
    named = {ref.get("id") for shape in shapes for ref in shape.iter("ref")}
    for place in shapes + [e for e in root if e.get("id") in named]:
        for name in place.findall(".//texture/string[@name='filename']"):
            text = name.get("value", "")
            for _ in range(8):  # a default may name another
                text = re.sub(r"\$(\w+)", lambda m: defaults.get(m[1], m[0]), text)
            for path in (os.path.join(os.path.dirname(os.path.abspath(scene)), text), text):
                if os.path.isfile(path):
                    return os.path.abspath(path)
    return None


def _entry(self, context):
    self.layout.operator(ImportPolySfT.bl_idname, text="PolySfT (.npz)")


def register():
    """Called by Blender when the add-on is switched on."""
    bpy.utils.register_class(ImportPolySfT)
    bpy.types.TOPBAR_MT_file_import.append(_entry)


def unregister():
    """Called by Blender when the add-on is switched off."""
    bpy.types.TOPBAR_MT_file_import.remove(_entry)
    bpy.utils.unregister_class(ImportPolySfT)


if __name__ == "__main__":
    register()
