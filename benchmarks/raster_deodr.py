"""DEODR (de La Gorce et al. 2011; ``pip install deodr``) as a contender of
``benchmarks/raster.py``: a rasteriser in C++ on one thread, whose gradient at silhouettes comes of
antialiased edges.

It renders the same sheet with the same texture, RGB and, as a fourth colour, alpha. Its texture is
interpolated in the image, without perspective: with perspective it has no gradient.
"""

import importlib.util

import numpy as np

AVAILABLE = importlib.util.find_spec("deodr") is not None


class DeodrContender:
    """As :class:`raster.Contender`, in NumPy; ``camera``: the sheet's
    :class:`polysft_mi.camera.Intrinsics`, ``texture`` (H, W, 3) linear.
    """

    name = "deodr"

    def __init__(self, vertices, faces, uv, camera, texture, bend):
        from deodr import differentiable_renderer as d
        from deodr.triangulated_mesh import ColoredTriMesh

        height, width = texture.shape[:2]
        pixels = uv * (width, height) - 0.5  # Mitsuba takes v of a PLY file as it is, downwards
        pixels = np.clip(pixels, 0, (width - 1.001, height - 1.001))
        texture = np.concatenate([texture, np.ones((height, width, 1))], 2).astype(np.float64)
        faces = faces.astype(np.uint32)
        a, b, c = camera.project(vertices)[faces[0]]
        clockwise = (b - a)[0] * (c - a)[1] > (b - a)[1] * (c - a)[0]
        self.mesh = ColoredTriMesh(
            faces, vertices, clockwise, faces_uv=faces, uv=pixels, texture=texture
        )
        self.mesh.vertices_colors = np.zeros((len(vertices), 4))
        self.scene = d.Scene3D(sigma=1, integer_pixel_centers=False)
        self.scene.set_light(None, 1.0)
        self.scene.set_mesh(self.mesh)
        self.scene.set_background_color(np.zeros(4))
        extrinsic = np.eye(3, 4)
        self.camera = d.Camera(extrinsic, camera.matrix(), camera.height, camera.width)
        self.rest, self.bend = vertices.copy(), bend
        self.place(0.5)
        self.target = self.forward(0)

    def place(self, amount):
        """Bend the sheet by ``amount`` [1/m]."""
        self.mesh.set_vertices(self.rest + amount * self.bend)

    def forward(self, seed):
        """The image (H, W, 4)."""
        return self.scene.render(self.camera)

    def forward_backward(self, seed):
        """Gradient of the loss to the vertex positions, (3N,)."""
        difference = self.forward(seed) - self.target
        # its backward pass asks for the light on coloured vertices, which textured ones have not
        light = "_compute_vertices_colors_with_illumination"
        self.scene.store_backward_current[light] = np.ones(len(self.rest))
        self.scene.clear_gradients()
        self.scene.render_backward(2 * difference)
        return self.mesh._vertices_b.ravel()
