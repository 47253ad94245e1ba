"""Draw the figures of ``docs/raster.md`` with the integrator itself: ``python docs/figures.py``
(some seconds).

``raster_gradient.png``: the gradient of alpha against finite differences.
``raster_continuity.png``: a pixel's colour while an edge passes it.
"""

import argparse
import os

from polyfit.backend import set_variant

set_variant()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from polysft_mi.camera import Intrinsics  # noqa: E402
from polysft_mi.scene import plugins  # noqa: E402

HERE = os.path.dirname(os.path.abspath(__file__))

WIDTH, HEIGHT, FOCAL = 16, 12, 20.0
TEXTURE = 0.55 + 0.4 * np.stack(
    np.broadcast_arrays(
        np.sin(np.arange(64) / 6), np.cos(np.arange(64) / 9), np.sin(np.arange(64)[:, None] / 8)
    ),
    -1,
)


class Plane:
    """Triangles that face the camera at a depth of 1 m, given by corners (F, 3, 2) in pixels,
    rendered after a shift to the right [pixels].
    """

    def __init__(self, corners, texture=None):
        corners = np.asarray(corners, dtype=float).reshape(-1, 2)
        camera = Intrinsics(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
        points = np.column_stack(
            [(corners - (WIDTH / 2, HEIGHT / 2)) / FOCAL, np.ones(len(corners))]
        )
        mesh = mi.Mesh(
            "mesh",
            len(points),
            len(points) // 3,
            has_vertex_texcoords=True,
            props=self._bsdf(texture),
        )
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
        params["faces"] = mi.UInt32(np.arange(len(points), dtype=np.uint32))
        params["vertex_texcoords"] = mi.Float(
            (corners / (WIDTH, HEIGHT)).astype(np.float32).ravel()
        )
        params.update()
        sensor = mi.load_string(f'<scene version="3.0.0">{camera.sensor_xml()}</scene>').sensors()[
            0
        ]
        self.scene = mi.load_dict({"type": "scene", "sensor": sensor, "mesh": mesh})
        self.params = mi.traverse(self.scene)
        self.key = next(k for k in self.params.keys() if k.endswith("vertex_positions"))
        self.rest = mi.Float(self.params[self.key])

    @staticmethod
    def _bsdf(texture):
        if texture is None:
            reflectance = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
        else:
            reflectance = {
                "type": "bitmap",
                "bitmap": mi.Bitmap(texture.astype(np.float32)),
                "raw": True,
                "wrap_mode": "clamp",
            }
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(
            {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
        )
        return props

    def image(self, shift, spp=1, antialias=True):
        """Image tensor (H, W, 4), attached to ``shift`` (a Float of 1, pixels)."""
        positions = mi.Point3f(dr.unravel(mi.Point3f, self.rest))
        positions.x += shift / FOCAL
        self.params[self.key] = dr.ravel(positions)
        self.params.update()
        return mi.load_dict({"type": "raster", "antialias": antialias}).render(self.scene, spp=spp)

    def array(self, shift, **options):
        return np.array(self.image(mi.Float(shift), **options))


def figure(width, height):
    out = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(out)
    return out


def gradient(path):
    """A slanted triangle: its alpha, and the derivative of every pixel's alpha by a shift to the
    right, computed in two ways.
    """
    corners = np.array([[2.3, 1.6], [13.4, 4.2], [5.7, 10.6]])
    plane, h = Plane([corners]), 0.02
    shift = mi.Float(0)
    dr.enable_grad(shift)
    dr.set_grad(shift, 1)
    image = plane.image(shift)
    ad = np.array(dr.forward_to(image)).reshape(HEIGHT, WIDTH, 4)[..., 3]
    alpha = np.array(dr.detach(image))[..., 3]
    fd = (plane.array(h)[..., 3] - plane.array(-h)[..., 3]) / (2 * h)
    out = figure(11, 2.7)
    axes = out.subplots(1, 4)
    shown = [
        (alpha, "α, and the triangle", "gray", 0, 1),
        (ad, "∂α/∂x, by the integrator", "RdBu_r", -1, 1),
        (fd, "∂α/∂x, by finite differences", "RdBu_r", -1, 1),
        (ad - fd, "their difference", "RdBu_r", -1, 1),
    ]
    for ax, (values, title, colours, low, high) in zip(axes, shown):
        drawn = ax.imshow(values, cmap=colours, vmin=low, vmax=high, extent=(0, WIDTH, HEIGHT, 0))
        ax.plot(*np.vstack([corners, corners[:1]]).T, color="#e0a030", linewidth=1)
        ax.set_title(title, fontsize=9)
        ax.set_xticks(range(0, WIDTH + 1, 4)), ax.set_yticks(range(0, HEIGHT + 1, 4))
        ax.tick_params(labelsize=7)
        out.colorbar(drawn, ax=ax, shrink=0.75).ax.tick_params(labelsize=7)
    out.savefig(path, facecolor="white")
    area = 0.5 * abs(np.linalg.det(np.stack([corners[1] - corners[0], corners[2] - corners[0]])))
    worst, total = np.abs(ad - fd).max(), abs(ad.sum())
    return (
        f"gradient: sum of alpha {alpha.sum():.2f} of an area of {area:.2f} pixels; largest |AD -"
        f" FD| {worst:.4f}; sum of d alpha / d x {total:.4f} (0 is right)"
    )


def continuity(path):
    """The red of one pixel while the right border of a textured sheet moves over it, from pixel 7
    to pixel 10.
    """
    plane = Plane([[[-40, -40], [6, -40], [6, 52]], [[-40, -40], [6, 52], [-40, 52]]], TEXTURE)
    shifts = np.arange(0.5, 4.5, 0.02)
    row, column = HEIGHT // 2, 8
    styles = {
        "one ray at the centre": (dict(antialias=False), "#3b6ea5", "--"),
        "raster": (dict(), "#c4572e", "-"),
        "coverage (400 rays)": (dict(spp=400, antialias=False), "0.6", ":"),
    }
    out = figure(7, 2.8)
    axes, jumps = out.add_subplot(), {}
    for label, (options, colour, line) in styles.items():
        values = np.array([plane.array(s, **options)[row, column, 0] for s in shifts])
        axes.plot(6 + shifts, values, line, color=colour, label=label, linewidth=1.4)
        jumps[label] = np.abs(np.diff(values)).max()
    axes.axvline(column + 0.5, color="0.85", linewidth=0.8, zorder=0)
    axes.set_xlabel(
        f"x of the sheet's border [pixels]; pixel {column} reaches from {column} to {column + 1}",
        fontsize=9,
    )
    axes.set_ylabel(f"red of pixel {column}", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    out.savefig(path, facecolor="white")
    return "continuity: largest step for 0.02 pixels: " + ", ".join(
        f"{label} {jump:.3f}" for label, jump in jumps.items()
    )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    plugins.register()
    print(gradient(os.path.join(HERE, "raster_gradient.png")))
    print(continuity(os.path.join(HERE, "raster_continuity.png")))
