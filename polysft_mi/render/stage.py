"""A stage: moving meshes, a floor and light, path-traced by Mitsuba. How drapes of OneFit become
pictures and videos.

Import only after a Mitsuba variant is set.
"""

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

FLOOR = (0.55, 0.56, 0.58)
MARGIN = 1.12  # of the picture around what moves
FOV = 28.0  # degrees, of the picture's height
GRAIN = 3.0  # strength of the filter that takes the paths' noise off, in 8-bit steps


def render(parts, *, size=(640, 480), spp=24, azimuth=25.0, elevation=8.0, follow=False):
    """Images (H, W, 3) uint8 sRGB, one a frame, of moving meshes on a floor.

    ``parts``: of each mesh its vertices (T, N, 3) [m, z up], its faces (F, 3) and its colour,
    linear RGB. ``size``: (height, width) [pixels]; ``azimuth`` [degrees] to the side of the -y axis
    that the camera stands on, ``elevation`` above the floor. The camera keeps all in the picture;
    with ``follow`` it goes along with what moves.
    """
    height, width = size
    everything = np.concatenate([np.asarray(v, np.float32) for v, _, _ in parts], axis=1)
    low, high = everything.min(axis=1), everything.max(axis=1)  # (T, 3)
    scene = mi.load_dict(_scene(parts, low[:, 2].min()))
    params = mi.traverse(scene)
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "gaussian"},
        "pixel_format": "rgb",
    }
    middle = (low.min(axis=0) + high.max(axis=0)) / 2
    half = ((high - low).max(axis=0) if follow else high.max(axis=0) - low.min(axis=0)) / 2 * MARGIN
    across = max(half[2], np.hypot(half[0], half[1]) * height / width)
    distance = across / np.tan(np.deg2rad(FOV / 2)) + half[1]
    a, e = np.deg2rad((azimuth, elevation))
    away = distance * np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
    for t in range(len(everything)):
        for k, (vertices, _, _) in enumerate(parts):
            params[f"part{k}.vertex_positions"] = mi.Float(
                np.asarray(vertices[t], np.float32).ravel()
            )
        params.update()
        target = (low[t] + high[t]) / 2 if follow else middle
        sensor = mi.load_dict({
            "type": "perspective", "fov": FOV, "fov_axis": "y", "near_clip": 0.05, "film": film,
            # strata in place of independent samples: two thirds of the noise
            "sampler": {"type": "multijitter", "sample_count": spp},
            "to_world": mi.ScalarTransform4f().look_at(
                origin=list(target + away), target=list(target), up=[0, 0, 1]
            ),
        })  # fmt: skip
        image = mi.render(scene, sensor=sensor, spp=spp, seed=t)
        yield _smooth(
            np.array(
                mi.Bitmap(image).convert(
                    mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True
                )
            )
        )


def _smooth(image):
    """The image without the grain of few samples: each pixel averaged with those whose
    surroundings look alike (non-local means, Buades et al. 2005). Edges and folds stay.
    """
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    smooth = cv2.fastNlMeansDenoisingColored(bgr, None, GRAIN, GRAIN, 5, 15)
    return cv2.cvtColor(smooth, cv2.COLOR_BGR2RGB)


def _scene(parts, floor):
    stage = {
        "type": "scene", "integrator": {"type": "path", "max_depth": 4},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.55, 0.58, 0.62]}},
        "key": {
            "type": "rectangle",
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.6, 8.0]}},
            "to_world": mi.ScalarTransform4f().look_at(
                origin=[2.5, -3.5, floor + 4.0], target=[0, 0, floor + 1.0], up=[0, 0, 1]
            ),
        },
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, float(floor)]).scale(40.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(FLOOR)}},
        },
    }  # fmt: skip
    for k, (vertices, faces, colour) in enumerate(parts):
        stage[f"part{k}"] = _mesh(
            f"part{k}", np.asarray(vertices[0], np.float32), np.asarray(faces), colour
        )
    return stage


def _mesh(name, vertices, faces, colour):
    bsdf = {
        "type": "twosided",
        "bsdf": {
            "type": "principled",
            "base_color": {"type": "rgb", "value": list(colour)},
            "roughness": 0.7,
            "specular": 0.2,
        },
    }
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, props=props)
    params = mi.traverse(mesh)
    params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    params["vertex_positions"] = mi.Float(vertices.ravel())
    params["vertex_normals"] = dr.zeros(mi.Float, vertices.size)
    params.update()
    return mesh
