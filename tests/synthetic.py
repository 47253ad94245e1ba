"""Small sequences made on the spot, with known surfaces: a textured sheet that bends, turns and
moves, rendered by NumPy alone.

Folders in the three forms that ``polysft_mi.prepare`` knows: :func:`cloth`, :func:`phi_sft`,
:func:`kinect_paper`.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from surfaces import grid as grid_faces

from polyfit.mesh import TexCoords, vertex_normals

BACKGROUND = 0.03
SUPERSAMPLING = 4


@dataclass
class Truth:
    """``folder``; ``vertices`` (T, N, 3) [m, camera frame], frame 0 is the flat template; ``faces``
    (F, 3); ``uv`` (N, 2), v up, or :class:`polyfit.mesh.TexCoords`; K (3, 3).
    """

    folder: Path
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | TexCoords
    K: np.ndarray


def sheet(t, rows, columns, width=0.24, height=0.18, depth=0.5, bend=3.0, turn=0.15, shift=0.01):
    """Points (rows * columns, 3) [m] at the time t in [0, 1]: a cylinder of curvature t * bend
    [1/m] (an isometry of the flat sheet), moved.
    """
    x, y = np.meshgrid(
        np.linspace(-width / 2, width / 2, columns), np.linspace(-height / 2, height / 2, rows)
    )
    k = max(t * bend, 1e-9)
    p = np.stack([np.sin(k * x) / k, y, (1 - np.cos(k * x)) / k], axis=-1).reshape(-1, 3)
    c, s = np.cos(turn * t), np.sin(turn * t)
    return p @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (shift * t, -shift * t, depth)


def tube(t, rows, columns, radius=0.06, height=0.18, depth=0.5, bend=1.5, turn=0.25, shift=0.01):
    """Points (rows * columns, 3) [m] of a sleeve at the time t in [0, 1], row after row along its
    axis, x: it bends like an arm by the curvature t * bend [1/m], turns about x and moves.
    """
    x, a = np.meshgrid(
        np.linspace(-height / 2, height / 2, rows),
        2 * np.pi * np.arange(columns) / columns + turn * t,
        indexing="ij",
    )
    # the seam, at a = 0, lies on the far side
    ring, k = np.stack([-radius * np.sin(a), radius * np.cos(a)]), max(t * bend, 1e-9)
    out = 1 / k + ring[0]  # from the centre of the bend
    p = np.stack([out * np.sin(k * x), out * np.cos(k * x) - 1 / k, ring[1]], -1).reshape(-1, 3)
    return p + (shift * t, -shift * t, depth)


def tube_faces(rows, columns):
    """Triangles of :func:`tube`, outwards, and their :class:`polyfit.mesh.TexCoords`, with a seam
    along the tube.
    """
    open_faces = grid_faces(rows, columns + 1)
    row, column = np.divmod(open_faces, columns + 1)
    v, u = np.meshgrid(np.linspace(1, 0, rows), np.linspace(1, 0, columns + 1), indexing="ij")
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return row * columns + column % columns, TexCoords(uv, open_faces)


def texture_image(size=64):
    """A smooth colour image (size, size, 3) uint8 RGB, different in all four corners."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    channels = [
        0.5 + 0.25 * np.sin(9 * x + 2 * y) + 0.2 * np.sin(7 * y),
        0.5 + 0.25 * np.cos(8 * y - 3 * x) + 0.2 * np.sin(11 * x * y),
        0.2 + 0.6 * x * (1 - y) + 0.15 * np.sin(13 * (x + y)),
    ]
    return np.round(255 * np.clip(np.stack(channels, axis=-1), 0, 1)).astype(np.uint8)


def to_linear(x):
    x = np.asarray(x) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def to_srgb(x):
    return np.round(
        255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    ).astype(np.uint8)


def render(vertices, faces, uv, K, size, texture, light=None):
    """(sRGB image (H, W, 3) uint8, coverage (H, W)) of the textured mesh over a grey background;
    ``size`` is (width, height); ``light``: (l_0, l), by which a triangle with the unit normal n
    towards the camera has l_0 + l . n times the texture's colour.
    """
    if isinstance(uv, TexCoords):
        source, uv, faces = uv.split(faces)
        vertices = vertices[source]
    w, h = size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING
    x = vertices @ K.T
    inverse_depth = 1 / x[:, 2]
    x = x[:, :2] * inverse_depth[:, None] * SUPERSAMPLING
    nearest, at, lit = np.zeros((h, w)), np.zeros((h, w, 2)), np.ones((h, w))
    for face in faces:
        low = np.maximum(np.floor(x[face].min(0)).astype(int), 0)
        high = np.minimum(np.ceil(x[face].max(0)).astype(int), (w, h))
        if (low >= high).any():
            continue
        py, px = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
        a, b, c = x[face]
        edges = np.linalg.inv(np.stack([b - a, c - a], axis=1))
        s, t = edges @ np.stack([px.ravel() - a[0], py.ravel() - a[1]])
        weights = np.stack([1 - s - t, s, t], axis=1)
        z = weights @ inverse_depth[face]
        inside = (weights >= -1e-9).all(axis=1)
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        near = (inside & (z > nearest[window].ravel())).reshape(py.shape)
        nearest[window][near] = z.reshape(py.shape)[near]
        here = (weights * inverse_depth[face]) @ uv[face] / z[:, None]  # perspective-correct
        at[window][near] = here.reshape(*py.shape, 2)[near]
        if light is not None:
            a, b, c = vertices[face]
            n = np.cross(b - a, c - a)
            lit[window][near] = light[0] - np.sign(n @ a) * (n @ light[1:]) / np.linalg.norm(n)
    rows, columns = texture.shape[:2]
    maps = (at[..., 0] * columns - 0.5, (1 - at[..., 1]) * rows - 0.5)
    colour = cv2.remap(
        to_linear(texture),
        *(m.astype(np.float32) for m in maps),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    colour = np.where(nearest[..., None] > 0, colour * lit[..., None], BACKGROUND)
    mean = lambda image: image.reshape(size[1], SUPERSAMPLING, size[0], SUPERSAMPLING, -1).mean(
        axis=(1, 3)
    )
    return to_srgb(mean(colour)), mean((nearest > 0).astype(float))[..., 0]


def write_image(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[..., ::-1] if rgb.ndim == 3 else rgb)


def write_obj(path, vertices, uv, polygons):
    coordinates, corners = (
        (uv.coordinates, uv.faces) if isinstance(uv, TexCoords) else (uv, polygons)
    )
    lines = ["v {:.8f} {:.8f} {:.8f}".format(*p) for p in vertices] + [
        "vt {:.8f} {:.8f}".format(*t) for t in coordinates
    ]
    lines += [
        "f " + " ".join(f"{k + 1}/{c + 1}" for k, c in zip(polygon, corner))
        for polygon, corner in zip(np.asarray(polygons).tolist(), np.asarray(corners).tolist())
    ]
    path.write_text("\n".join(lines) + "\n")


def _make(folder, images, frames, size, rows, columns, masks, K, light=None, shape=sheet, **motion):
    folder.mkdir(parents=True, exist_ok=True)
    vertices = np.stack(
        [shape(k / max(frames - 1, 1), rows, columns, **motion) for k in range(frames)]
    )
    if shape is tube:
        faces, uv = tube_faces(rows, columns)
    else:
        v, u = np.meshgrid(np.linspace(1, 0, rows), np.linspace(0, 1, columns), indexing="ij")
        faces, uv = grid_faces(rows, columns), np.stack([u, v], axis=-1).reshape(-1, 2)
    truth = Truth(folder, vertices, faces, uv, K)
    texture = texture_image()
    for k in range(frames):
        image, coverage = render(vertices[k], truth.faces, truth.uv, K, size, texture, light)
        write_image(folder / images.format(k), image)
        if masks:
            write_image(
                folder / "masks" / f"{k:03d}.png", np.round(255 * coverage).astype(np.uint8)
            )
    return truth, texture


def _camera(size, aspect=1.0):
    return np.array(
        [
            [1.15 * size[0], 0, size[0] / 2 + 0.75],
            [0, 1.15 * aspect * size[0], size[1] / 2 - 0.5],
            [0, 0, 1],
        ]
    )


def _write_camera(folder, K, size):
    camera = {
        "width": size[0],
        "height": size[1],
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
    }
    (folder / "camera.json").write_text(json.dumps(camera))


def cloth(folder, frames=5, size=(96, 72), rows=9, columns=11, masks=True, **motion):
    """A sequence in the form ``cloth``, with ``gt.npz``; returns its :class:`Truth`. With ``shape``
    :func:`tube` that of a sleeve whose texture has a seam; then gt.npz has ``seen``.
    """
    K = _camera(size)
    truth, texture = _make(
        Path(folder), "frames/{:03d}.png", frames, size, rows, columns, masks, K, **motion
    )
    write_image(truth.folder / "texture.png", texture)
    write_obj(truth.folder / "template.obj", truth.vertices[0], truth.uv, truth.faces)
    _write_camera(truth.folder, K, size)
    seen = {}
    if motion.get("shape") is tube:  # whose normals point outwards
        normals = np.stack([vertex_normals(V, truth.faces) for V in truth.vertices])
        seen["seen"] = (normals * truth.vertices).sum(2) < 0
    np.savez(
        truth.folder / "gt.npz",
        vertices=truth.vertices.astype(np.float32),
        faces=truth.faces.astype(np.int32),
        **seen,
    )
    return truth


def phi_sft(
    folder, frames=5, size=(96, 72), rows=9, columns=11, masks=True, obj="0_S3_quad.obj", **motion
):
    """A sequence in the form ``phi-SfT``: quads, x and y negated, focal lengths that differ;
    returns its :class:`Truth`.
    """
    K = _camera(size, aspect=0.95)
    truth, texture = _make(
        Path(folder), "rgbs/rgb_{:03d}.png", frames, size, rows, columns, masks, K, **motion
    )
    write_image(truth.folder / "texture.png", texture)
    quads = truth.faces.reshape(-1, 6)[:, [0, 1, 4, 2]]
    write_obj(truth.folder / obj, truth.vertices[0] * (-1, -1, 1), truth.uv, quads)
    _write_camera(truth.folder, K, size)
    return truth


def kinect_paper(folder, frames=5, size=(96, 72), rows=5, columns=6, **motion):
    """A sequence in the form ``Kinect-Paper``: the sheet's own grid in mm in a frame of its own,
    its pose; returns its :class:`Truth`.
    """
    K = _camera(size)
    truth, _ = _make(
        Path(folder), "frame_{:03d}.png", frames, size, rows, columns, False, K, **motion
    )
    for k in reversed(range(frames)):  # images count from 1 there
        (truth.folder / f"frame_{k:03d}.png").rename(truth.folder / f"frame_{k + 1:03d}.png")
    turn = cv2.Rodrigues(np.array([0.0, 0.0, 0.1]))[0] @ np.diag([1.0, -1.0, -1.0])
    shift = 1000 * truth.vertices[0].mean(0)
    np.savetxt(truth.folder / "mesh.pts", (1000 * truth.vertices[0] - shift) @ turn)
    np.savetxt(truth.folder / "mesh.tri", truth.faces, fmt="%d")
    np.savetxt(truth.folder / "cam.ext", np.hstack([turn, shift[:, None]]))
    np.savetxt(truth.folder / "cam.intr", K)
    return truth
