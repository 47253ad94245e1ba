"""A scene and unknowns of your own, with Adam: `python examples/own_unknowns.py`.

The scene is the demo's poster before a camera. Two numbers are unknown: its curvature (it bends to
a cylinder) and its distance. One image tells both, by the integrator ``raster``, whose gradients
include those of the silhouette.

Look at the last line: curvature and distance beside the true ones.
"""

import argparse
from pathlib import Path

import polysft_mi

DEMO = Path(__file__).parents[1] / "scenes" / "demo"
TRUE = {"curvature": 5.0, "distance": 0.60}  # 1/m, m


def main(steps=60, width=96):
    """Returns the unknowns found: curvature [1/m] and distance [m]."""
    polysft_mi.set_variant()
    polysft_mi.register()  # "raster"
    import drjit as dr
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": width, "height": width * 3 // 4, "pixel_format": "rgba"}
    print_ = mi.Bitmap(str(DEMO / "texture.jpg")).convert(component_format=mi.Struct.Type.Float32)
    print_ = {"type": "bitmap", "bitmap": print_.resample((24, 24))}  # smooth: its pull reaches far
    sheet = {"type": "obj", "filename": str(DEMO / "template.obj")}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "raster"},
        "sensor": {"type": "perspective", "fov": 47, "film": film | {"rfilter": {"type": "box"}}},
        "sheet": sheet | {"bsdf": {"type": "diffuse", "reflectance": print_}},
    })  # fmt: skip
    params = mi.traverse(scene)
    flat = dr.unravel(mi.Point3f, mi.Float(params["sheet.vertex_positions"]))

    def image(curvature, distance):
        along = flat.x * curvature  # the angle on the cylinder
        z = distance - (1 - dr.cos(along)) / curvature
        bent = mi.Point3f(dr.sin(along) / curvature, flat.y, z)
        params["sheet.vertex_positions"] = dr.ravel(bent)
        params.update()
        return mi.render(scene, params, spp=1)

    target = dr.detach(image(*(mi.Float(x) for x in TRUE.values())))
    adam = mi.ad.Adam(lr=0.002)
    adam["curvature"], adam["distance"] = mi.Float(2.0), mi.Float(0.64)
    adam.set_learning_rate({"curvature": 0.1})
    for _ in range(steps):
        loss = dr.mean(dr.square(image(adam["curvature"], adam["distance"]) - target), axis=None)
        dr.backward(loss)
        adam.step()
    return {name: float(adam[name][0]) for name in TRUE}


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    print(", ".join(f"{name}: {x:.3f}, true {TRUE[name]:.3f}" for name, x in main().items()))
