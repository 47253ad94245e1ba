"""nvdiffrast (Laine et al. 2020) and DRTK (Pidhorskyi et al. 2024) as contenders of
``benchmarks/raster.py``: differentiable rasterisers in CUDA under torch's AD. Each is built from
its source; neither comes with this package.

Both render the same sheet with the same texture, RGB and, as a fourth channel, alpha, with
perspective and bilinear look-ups; all of it stays on the device. nvdiffrast's gradient at
silhouettes comes of antialiased edges (``antialias``), DRTK's of ``edge_grad_estimator``.
"""

import importlib.util

import numpy as np

AVAILABLE = {name: importlib.util.find_spec(name) is not None for name in ("nvdiffrast", "drtk")}
NEAR, FAR = 0.1, 10.0  # of nvdiffrast's depth buffer [m]


def clip_from_camera(camera):
    """(A (3, 4), b (4,)): ``points @ A + b`` are clip coordinates of the points (N, 3) [m, camera
    frame] for nvdiffrast, whose row 0 of the image is at y = -1: rows then run downwards, as ours.
    """
    matrix = np.zeros((3, 4))
    matrix[0, 0], matrix[2, 0] = 2 * camera.fx / camera.width, 2 * camera.cx / camera.width - 1
    matrix[1, 1], matrix[2, 1] = 2 * camera.fy / camera.height, 2 * camera.cy / camera.height - 1
    matrix[2, 2], matrix[2, 3] = (FAR + NEAR) / (FAR - NEAR), 1
    return matrix, np.array([0, 0, -2 * FAR * NEAR / (FAR - NEAR), 0])


class TorchContender:
    """As :class:`raster.Contender`, in torch; ``camera``: the sheet's
    :class:`polysft_mi.camera.Intrinsics`, ``texture`` (H, W, 3) linear.
    """

    def __init__(self, vertices, faces, uv, camera, texture, bend, device="cuda"):
        self.camera, self.device = camera, device
        self.faces = self.tensor(faces, np.int32)
        self.uv = self.tensor(uv)[None]  # Mitsuba takes v of a PLY file as it is, downwards
        # alpha is looked up too, and spares a concatenation
        self.texture = self.tensor(np.concatenate([texture, np.ones_like(texture[..., :1])], 2))
        self.rest, self.bend = self.tensor(vertices), self.tensor(bend)
        self.prepare()
        self.place(0.5)
        self.target = self.forward(0)

    def tensor(self, values, dtype=np.float32):
        import torch

        return torch.tensor(np.ascontiguousarray(values, dtype), device=self.device)

    def synchronise(self):
        import torch

        if self.device == "cuda":
            torch.cuda.synchronize()

    def prepare(self):
        """What is made once."""

    def render(self):
        """The image (H, W, 4) under torch's AD."""
        raise NotImplementedError

    def place(self, amount):
        """Bend the sheet by ``amount`` [1/m], attached to its vertex positions."""
        self.positions = (self.rest + float(amount) * self.bend).requires_grad_()
        self.synchronise()

    def forward(self, seed):
        """The image (H, W, 4), a tensor."""
        import torch

        with torch.no_grad():
            image = self.render()
        self.synchronise()
        return image

    def forward_backward(self, seed):
        """Gradient of the loss to the vertex positions, (3N,), a tensor."""
        self.positions.grad = None
        (self.render() - self.target).square().sum().backward()
        self.synchronise()
        return self.positions.grad.ravel()


class NvdiffrastContender(TorchContender):
    name = "nvdiffrast"

    def prepare(self):
        import nvdiffrast.torch as dr

        self.context = dr.RasterizeCudaContext()
        self.edges = dr.antialias_construct_topology_hash(self.faces)
        self.texture = self.texture[None].contiguous()
        self.matrix, self.offset = (self.tensor(part) for part in clip_from_camera(self.camera))

    def render(self):
        import nvdiffrast.torch as dr

        clip = (self.positions @ self.matrix + self.offset)[None].contiguous()
        size = self.camera.height, self.camera.width
        found, _ = dr.rasterize(self.context, clip, self.faces, size, grad_db=False)
        uv, _ = dr.interpolate(self.uv, found, self.faces)
        image = dr.texture(self.texture, uv, filter_mode="linear", boundary_mode="clamp")
        image = image * (found[..., 3:] > 0)
        return dr.antialias(image, found, clip, self.faces, topology_hash=self.edges)[0]


class DrtkContender(TorchContender):
    name = "drtk"

    def prepare(self):
        camera = self.camera
        self.texture = self.texture.permute(2, 0, 1)[None].contiguous()
        self.uv = 2 * self.uv - 1  # from -1 to 1 between the outer borders of the texture
        self.focal = self.tensor([camera.fx, camera.fy])
        # the centre of its first pixel is (0, 0)
        self.centre = self.tensor([camera.cx - 0.5, camera.cy - 0.5])

    def pixels(self):
        """Pixels as it counts them, and depth [m]: (1, N, 3)."""
        import torch

        depth = self.positions[:, 2:]
        at = self.positions[:, :2] / depth * self.focal + self.centre
        return torch.cat([at, depth], 1)[None]

    def render(self):
        import drtk
        from torch.nn.functional import grid_sample

        pixels = self.pixels()
        index = drtk.rasterize(pixels, self.faces, self.camera.height, self.camera.width)
        _, weights = drtk.render(pixels, self.faces, index)
        uv = drtk.interpolate(self.uv, self.faces, index, weights).permute(0, 2, 3, 1)
        image = grid_sample(self.texture, uv, padding_mode="border", align_corners=False)
        image = image * (index != -1)[:, None]
        image = drtk.edge_grad_estimator(
            v_pix=pixels, vi=self.faces, bary_img=weights, img=image, index_img=index
        )
        return image[0].permute(1, 2, 0)


CONTENDERS = {one.name: one for one in (NvdiffrastContender, DrtkContender)}
