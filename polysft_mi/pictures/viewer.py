"""A run in polyscope's window, to turn, play and colour; or one picture of it."""

import ctypes
import os
import sys

import numpy as np

from polyfit.errors import require
from polysft_mi.colours import patch_colours
from polysft_mi.errors import InputError


class Viewer:
    """The window of a run: ``show(k)`` puts its k-th frame there. polyscope holds one window a
    process.
    """

    def __init__(self, run, ps):
        from polyfit.animation import from_camera

        self.run, self.ps = run, ps
        self.vertices = from_camera(run.vertices, "y")
        self.curvature = run.mean_curvature()
        self.frame, self.playing, self._shown_at = 0, False, 0.0
        ps.set_up_dir("y_up")
        ps.set_front_dir("z_front")
        ps.set_ground_plane_mode("none")
        self.mesh = ps.register_surface_mesh(
            "surface", self.vertices[0], run.faces, smooth_shade=True, back_face_policy="identical"
        )
        self.limits = np.quantile(np.abs(self.curvature), 0.99)
        if run.texture and os.path.isfile(run.texture):
            self._texture()
        patch, weight = (run.params[name] for name in ("patch", "weight"))
        if patch.max() > 0:
            self.mesh.add_color_quantity("patches", patch_colours(patch, weight) / 255)
        self.show(0)

    def _texture(self):
        import cv2

        image = cv2.imread(self.run.texture)
        if image is not None:
            corners = self.run.texcoords.corners.reshape(-1, 2)
            self.mesh.add_parameterization_quantity("uv", corners, defined_on="corners")
            colours = image[..., ::-1].astype(np.float32) / 255
            self.mesh.add_color_quantity(
                "texture", colours, defined_on="texture", param_name="uv", enabled=True
            )

    def show(self, k):
        self.frame = int(np.clip(k, 0, len(self.vertices) - 1))
        self.mesh.update_vertex_positions(self.vertices[self.frame])
        self.mesh.add_scalar_quantity(
            "mean curvature [1/m]",
            self.curvature[self.frame],
            cmap="coolwarm",
            vminmax=(-self.limits, self.limits),
        )
        if self.run.sigma is not None and np.isfinite(self.run.sigma[self.frame]).all():
            top = 1e3 * float(np.nanquantile(self.run.sigma, 0.99))
            self.mesh.add_scalar_quantity(
                "sigma [mm]", 1e3 * self.run.sigma[self.frame], vminmax=(0, top)
            )

    def controls(self):
        """Drawn by polyscope in every frame of its own."""
        import time

        import polyscope.imgui as imgui

        moved, k = imgui.SliderInt("frame", self.frame, 0, len(self.vertices) - 1)
        imgui.SameLine()
        imgui.TextUnformatted(f"= {int(self.run.frames[k])}")
        if imgui.Button("pause" if self.playing else "play"):
            self.playing = not self.playing
        now = time.monotonic()
        if moved:
            self.playing = False
            self.show(k)
        elif self.playing and now - self._shown_at >= 1 / self.run.fps:
            self._shown_at = now
            self.show((self.frame + 1) % len(self.vertices))


_INSTEAD = "open report.html in the run's folder, or write a picture by --screenshot FILE"


def _display():
    """Whether a window could be opened, found out without polyscope, which ends untidily where it
    cannot.
    """
    if not sys.platform.startswith("linux") or os.environ.get("WAYLAND_DISPLAY"):
        return True
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    return bool(os.environ.get("DISPLAY")) and bool(x11.XOpenDisplay(None))


def show(run, frame=None, screenshot=None):
    """Open the window of a :class:`~polysft_mi.results.run.Run` and wait until it is closed; or
    write the picture ``screenshot`` (.png) instead.

    ``frame``: the index of the frame to begin with, by default the first. Raises InputError.
    """
    order = {int(k): n for n, k in enumerate(run.frames)}
    if frame is not None and frame not in order:
        raise InputError(f"--frame {frame}: the run has frames {min(order)} to {max(order)}")
    if screenshot is not None and not screenshot.lower().endswith(".png"):
        raise InputError(f"--screenshot {screenshot}: a .png file is needed")
    ps = _polyscope(screenshot is not None)
    viewer = Viewer(run, ps)
    viewer.show(order[frame] if frame is not None else 0)
    if screenshot is not None:
        ps.screenshot(screenshot, transparent_bg=False)
    else:
        ps.set_user_callback(viewer.controls)
        ps.show()


def _polyscope(screenshot):
    """polyscope, started. Raises InputError where it is not installed or finds no display."""
    if not screenshot and not _display():
        raise InputError(f"view: no display (DISPLAY={os.environ.get('DISPLAY', '')}); {_INSTEAD}")
    require("polyscope")
    import polyscope as ps

    ps.set_program_name("polysft")
    ps.set_verbosity(0)
    ps.set_use_prefs_file(False)
    ps.set_allow_headless_backends(screenshot)
    try:
        ps.init()
    except RuntimeError:
        raise InputError(
            f"view: cannot open a window, OpenGL or a display is missing; {_INSTEAD}"
        ) from None
    return ps
