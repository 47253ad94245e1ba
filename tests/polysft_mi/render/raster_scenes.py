"""Scenes that the tests of the raster integrator render: a camera, loose triangles, and what they
look like.
"""

import mitsuba as mi
import numpy as np

WIDTH, HEIGHT = 96, 72
UNLIT_MESH = {
    "type": "twosided",
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1, 1, 1]}},
}


def sensor(width=WIDTH, height=HEIGHT, fov=40, **film):
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 0.001,
        "to_world": (
            mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0])
        ),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
            "sample_border": True,
            **film,
        },
    }


def write_mesh(path, vertices, faces, uv=None):
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_texcoords=uv is not None)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(np.asarray(uv, np.float32).ravel())
    params.update()
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": True}


def triangles(path, *corners, **options):
    """A scene of loose triangles, each three points."""
    vertices = np.concatenate([np.asarray(c, float) for c in corners])
    mesh = write_mesh(path / "triangles.ply", vertices, np.arange(len(vertices)).reshape(-1, 3))
    return mi.load_dict(
        {"type": "scene", "sensor": sensor(**options), "mesh": {**mesh, "bsdf": UNLIT_MESH}}
    )


def raster(**options):
    return mi.load_dict({"type": "raster", **options})


def picture(scene, spp=1, **options):
    return np.array(mi.render(scene, integrator=raster(**options), spp=spp))


def pixel_size(depth=1.0, width=WIDTH, fov=40):
    return depth * 2 * np.tan(np.radians(fov / 2)) / width
