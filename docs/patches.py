"""Draw ``docs/patches.png``: a garment, its patches, its jets' surface at four times the
resolution, the error.

    python docs/patches.py garment.obj        (a minute)

The picture in the documentation is that of a CC0 shirt of the MakeHuman community
(``m_shirt_wrinkled``).
"""

import argparse
import os

from polyfit.backend import set_variant

set_variant()

import matplotlib  # noqa: E402
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from polyfit import PatchedSurface, mesh, read_mesh  # noqa: E402

HERE = os.path.dirname(os.path.abspath(__file__))

WIDTH, HEIGHT = 480, 740
CLOTH = np.array([0.35, 0.50, 0.68])
ERROR = "viridis"


def shaped(V, F, colours, smooth):
    """A Mitsuba mesh of V (N, 3), F (F, 3) with a colour for each face, (F, 3), or for each vertex,
    (N, 3), linear RGB.
    """
    if len(colours) == len(F):
        normals = mesh.vertex_normals(V, F)[F].reshape(-1, 3)
        V, colours, F = (
            V[F].reshape(-1, 3),
            np.repeat(colours, 3, axis=0),
            np.arange(3 * len(F)).reshape(-1, 3),
        )
    else:
        normals = mesh.vertex_normals(V, F)
    props = mi.Properties()
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    props["bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
    )
    props["face_normals"] = not smooth
    out = mi.Mesh("garment", len(V), len(F), has_vertex_normals=smooth, props=props)
    out.add_attribute("vertex_color", 3, colours.astype(np.float32).ravel())
    params = mi.traverse(out)
    params["vertex_positions"] = mi.Float(V.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(F.astype(np.uint32).ravel())
    if smooth:
        params["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
    params.update()
    return out


def picture(shape, centre, distance, samples):
    """sRGB image (H, W, 3) of the mesh over white, seen from its front and a little from its left
    and above.
    """
    t = mi.ScalarTransform4f()
    eye = centre + distance * np.array([-0.42, -1.0, 0.22])
    light = lambda direction, irradiance: {
        "type": "directional",
        "direction": list(map(float, direction)),
        "irradiance": {"type": "rgb", "value": irradiance},
    }
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "fov_axis": "y",
                "to_world": t.look_at(
                    origin=list(map(float, eye)), target=list(map(float, centre)), up=[0, 0, 1]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": WIDTH,
                    "height": HEIGHT,
                    "pixel_format": "rgba",
                    "rfilter": {"type": "gaussian"},
                },
                "sampler": {"type": "multijitter", "sample_count": samples},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
            "key": light((0.95, 0.45, -0.75), 2.3),
            "fill": light((-0.9, 0.8, 0.1), 0.7),
            "mesh": shape,
        }
    )
    image = np.array(mi.render(scene, seed=1))
    rgb = image[..., :3] + 1 - image[..., 3:4]
    return np.clip(
        np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * np.maximum(rgb, 1e-9) ** (1 / 2.4) - 0.055),
        0,
        1,
    )


def patch_colours(surface):
    """A colour for each patch, (K, 3), unlike its neighbours', from a short palette."""
    palette = matplotlib.colormaps["Set2"](np.arange(8))[:, :3] ** 2.2
    near = [set() for _ in range(len(surface))]
    for a, b in surface.patches.neighbours.tolist():
        near[a].add(b)
        near[b].add(a)
    chosen = np.full(len(surface), -1)
    for k in sorted(range(len(surface)), key=lambda k: -len(near[k])):
        taken = {chosen[n] for n in near[k]}
        free = [c for c in range(8) if c not in taken] or list(range(8))
        chosen[k] = free[(5 * k) % len(free)]
    return palette[chosen]


def distances(points, V, F):
    import pyvista

    _, closest = pyvista.PolyData.from_regular_faces(V, F).find_closest_cell(
        points, return_closest_point=True
    )
    return np.linalg.norm(points - closest, axis=1)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mesh")
    parser.add_argument("--samples", type=int, default=144)
    parser.add_argument(
        "--most", type=float, default=2.0, help="upper end of the error's colours [mm]"
    )
    parser.add_argument("-o", "--output", default=os.path.join(HERE, "patches.png"))
    args = parser.parse_args()
    V, F, _ = read_mesh(args.mesh)
    surface = PatchedSurface.from_mesh(V, F)
    W, G = (
        x.double().numpy() if x.is_floating_point() else x.numpy() for x in surface.resampled(4)
    )
    error = 1e3 * distances(W, V, F)
    p = surface.patches
    colours = patch_colours(surface)[np.median(p.corner_patch, axis=1).astype(int)]
    colour = matplotlib.colormaps[ERROR](np.clip(error / args.most, 0, 1))[:, :3] ** 2.2
    panels = {
        f"the mesh: {len(V):,} vertices": shaped(V, F, np.tile(CLOTH, (len(F), 1)), False),
        f"{len(surface)} patches": shaped(
            surface.vertices().double().numpy(), p.faces, colours, True
        ),
        f"their jets, {surface.parameters:,} numbers, at 4× the resolution": shaped(
            W, G, np.tile(CLOTH, (len(W), 1)), True
        ),
        f"distance from the mesh: {np.sqrt((error**2).mean()):.2f} mm RMS": shaped(
            W, G, colour, True
        ),
    }
    centre, extent = (V.max(0) + V.min(0)) / 2, np.ptp(V, axis=0)
    distance = 1.05 * max(extent[2], extent[0] * HEIGHT / WIDTH) / (2 * np.tan(np.radians(10)))
    out = Figure(figsize=(4 * WIDTH / 200, (HEIGHT + 75) / 200), dpi=200)
    FigureCanvasAgg(out)
    for k, (title, shape) in enumerate(panels.items()):
        axes = out.add_axes((k / 4, 0, 0.25, HEIGHT / (HEIGHT + 75)))
        axes.imshow(picture(shape, centre, distance, args.samples))
        axes.axis("off")
        out.text((k + 0.5) / 4, 0.955, title, ha="center", va="center", fontsize=7)
    bar = out.add_axes((0.975, 0.2, 0.006, 0.45))
    scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, args.most), ERROR)
    out.colorbar(scale, cax=bar).ax.tick_params(labelsize=5, length=1.5, width=0.4, pad=1)
    bar.yaxis.set_ticks_position("left")
    bar.set_title("mm", fontsize=5)
    bar.set_yticks(np.linspace(0, args.most, 5))
    out.savefig(args.output)
    print(f"written: {args.output}")


if __name__ == "__main__":
    main()
