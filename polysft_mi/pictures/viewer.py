"""A moving surface in the browser, to turn, play and colour, by viser."""

import contextlib
import io
import time

import numpy as np

from polyfit.errors import InputError, require
from polyfit.mesh import vertex_normals

_LOOK_AGAIN = 1.0  # [s] between two looks at a folder that may grow
_LOADING = 0.1  # [s] that a browser has to load a frame
_TEXTURE = "texture"


class Viewer:
    """A web server with the surface of ``source``, a
    :class:`~polysft_mi.pictures.moving.Source`, in its scene.

    ``server``: viser's, whose scene holds ``/surface/0`` and ``/surface/1``, which take turns
    (``surface`` is the newer one, a GLB), ``/camera/own`` (a frustum with the frame's image),
    ``/camera/NAME`` of further cameras, and, of a drape, ``/body``. ``frame`` (a slider, counted
    from 0), ``playing``, ``follow`` (the newest frame of a run at work) and ``colour`` are its
    controls: set their ``value``. Nothing moves but in :meth:`step`, so that one thread draws. The
    ``frame`` to begin with is given by its number in the video. Raises InputError where viser is
    not installed, or that frame is not there.
    """

    def __init__(self, source, *, host="127.0.0.1", port=8080, frame=None):
        require("viser")
        import viser

        self.source, self._moving = source, source.read()
        order = {int(k): n for n, k in enumerate(self._moving.frames)}
        if frame is not None and frame not in order:
            raise InputError(
                f"--frame {frame}: {source.folder} has frames {min(order)} to {max(order)}"
            )

        with contextlib.redirect_stdout(io.StringIO()):  # the command says the address itself
            label = f"polysft {source.folder}"
            self.server = viser.ViserServer(host, port, label=label, verbose=False)
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(control_width="small", show_share_button=False)
        gui.set_panel_label("polysft view")
        scene.set_up_direction("+z")
        self._about = gui.add_markdown("")
        self.frame = gui.add_slider("frame", min=0, max=0, step=1, initial_value=0)
        self.playing = gui.add_checkbox("play", False)
        at_work = self._moving.state.startswith("at work")
        self.follow = gui.add_checkbox("follow the run", at_work, visible=at_work)
        self.colour = gui.add_dropdown("colour", ["plain"])
        self._legend = gui.add_markdown("")
        self._nodes, self._shown, self._made = {}, None, {}
        self.surface = self._before = None  # two nodes that take turns
        self._hide_at = 0.0
        self._looked = self._advanced = time.monotonic()
        self._take(self._moving)
        if frame is not None:
            self.frame.value = order[frame]
            self.follow.value = False
        self._place()
        self.step()

    @property
    def address(self):
        """Where a browser finds it."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def close(self):
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def run(self):
        """Serve until Ctrl-C."""
        try:
            while True:
                self.step()
                time.sleep(0.02)
        finally:
            self.close()

    def step(self):
        """Look for new frames, go on where it plays, and draw what the controls ask for, where that
        is not shown yet.
        """
        now = time.monotonic()
        if now - self._looked >= _LOOK_AGAIN:
            self._looked = now
            self.refresh()
        count = len(self._moving.frames)
        if self.playing.value and now - self._advanced >= 1 / self._moving.fps:
            self._advanced = now
            self.frame.value = (int(self.frame.value) + 1) % count
        if self._before is not None and now >= self._hide_at:
            self._before.visible = False
        k = min(int(self.frame.value), count - 1)
        wanted = (k, self.colour.value)
        if wanted != self._shown:
            self._draw(*wanted)
            self._shown = wanted

    def refresh(self):
        """Read the folder again where a file in it was written; what cannot be read now, since it
        is being replaced, is read later.
        """
        if self.source.changed():
            with contextlib.suppress(InputError, OSError):
                self._take(self.source.read())

    def _take(self, moving):
        """Show ``moving`` from now on."""
        self._moving, self._made, self._shown = moving, {}, None
        m, top = moving, len(moving.frames) - 1
        self.frame.max = max(top, 1)
        self.frame.disabled = top == 0
        if self.follow.value:
            self.frame.value = top
        if not m.state.startswith("at work"):
            self.follow.value = self.follow.visible = False
        names = list(m.colourings)
        self._picture = _picture(m.texture, 1024) if m.texture and m.texcoords else None
        if self._picture is not None:
            names.insert(0, _TEXTURE)
        if tuple(names) != self.colour.options:
            first = self.surface is None
            self.colour.options = names
            if first:
                self.colour.value = names[0]
        if m.texcoords is None:
            self._split = np.arange(m.vertices.shape[1]), None, m.faces
        else:
            self._split = m.texcoords.split(m.faces)

    def _place(self):
        """The place that a browser begins at: it shows the surface in all frames, and the video's
        camera.
        """
        points = self._moving.vertices.reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        for camera in self._moving.cameras:
            at = 0.9 * camera.pose[:3, 3] + 0.1 * (low + high) / 2
            low, high = np.minimum(low, at), np.maximum(high, at)
        centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
        start = self.server.initial_camera
        side = (0.8, -0.7, 0.5) if self._moving.body is None else (0.3, -1.0, 0.15)
        start.position = tuple(centre + size * np.array(side))
        start.look_at = tuple(centre)
        start.fov = np.radians(45)

    def _draw(self, k, colour):
        m, scene = self._moving, self.server.scene
        with self.server.atomic():
            self._about.content = f"**frame {int(m.frames[k])}**, {m.state}"
            self._show(self._glb(k, colour))
            if m.body is not None:
                if "body" not in self._nodes:
                    self._nodes["body"] = scene.add_mesh_simple(
                        "/body", m.body[0][k], m.body[1], color=(190, 180, 172)
                    )
                self._nodes["body"].vertices = m.body[0][k].astype(np.float32)
            self._frustums(k)

    def _show(self, data):
        """Show the GLB ``data`` in the node that is out of sight. A browser needs a moment to load
        it; for so long the other one stays (:meth:`step`).
        """
        self.surface, self._before = self._before, self.surface
        if self.surface is None:
            count = 0 if self._before is None else 1
            self.surface = self.server.scene.add_glb(f"/surface/{count}", data)
        else:
            self.surface.glb_data = data
            self.surface.visible = True
        self._hide_at = time.monotonic() + min(_LOADING, 0.7 / self._moving.fps)

    def _frustums(self, k):
        from viser.transforms import SO3

        m = self._moving
        distance = float(np.median(m.vertices[0, :, 1]))
        for camera in m.cameras:
            c, pose, name = camera.intrinsics, camera.pose, f"/camera/{camera.name}"
            image = _picture(camera.images[k], 640) if k < len(camera.images) else None
            image = None if image is None else np.asarray(image)
            if name in self._nodes:
                self._nodes[name].image = image
                continue
            self._nodes[name] = self.server.scene.add_camera_frustum(
                name,
                fov=2 * np.arctan(c.height / (2 * c.fy)),
                aspect=c.width * c.fy / (c.height * c.fx),
                scale=0.12 * distance,
                thickness=0.002 * distance,
                image=image,
                wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
                position=pose[:3, 3],
            )

    def _glb(self, k, colour):
        """The surface of frame k as glTF: with its texture, or with colours at its vertices."""
        import trimesh
        from trimesh.visual import TextureVisuals
        from trimesh.visual.material import PBRMaterial

        m, (source, uv, faces) = self._moving, self._split
        textured = colour == _TEXTURE
        material = PBRMaterial(
            baseColorTexture=self._picture if textured else None,
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=True,
        )
        visual = TextureVisuals(uv=np.nan_to_num(uv) if textured else None, material=material)
        legend = ""
        if not textured:
            if colour not in self._made:
                self._made[colour] = m.colourings[colour]()
            rgb = self._made[colour].rgb
            legend = self._made[colour].legend
            visual.vertex_attributes["color"] = _linear(rgb[min(k, len(rgb) - 1)])[source]
        self._legend.content = legend
        mesh = trimesh.Trimesh(
            m.vertices[k][source],
            faces,
            vertex_normals=vertex_normals(m.vertices[k].astype(np.float64), m.faces)[source],
            visual=visual,
            process=False,
        )
        return mesh.export(file_type="glb")


def _linear(rgb):
    """Colours (N, 3) uint8 sRGB as glTF has them at vertices: (N, 4) uint8, linear, opaque."""
    x = rgb / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return np.round(255 * np.pad(linear, ((0, 0), (0, 1)), constant_values=1)).astype(np.uint8)


def _picture(path, most):
    """The image as a PIL image in JPEG's form, at most ``most`` pixels wide and high; None where it
    is gone, or none.
    """
    from PIL import Image

    from polysft_mi.scene import read_rgb

    try:
        image = Image.fromarray(read_rgb(path))
    except (InputError, OSError):
        return None
    image.thumbnail((most, most))
    data = io.BytesIO()
    image.save(data, "JPEG", quality=85)
    return Image.open(data)
