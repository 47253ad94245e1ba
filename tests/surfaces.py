"""Small meshes of known shape: vertices (N, 3) float64 [m] and faces (F, 3)."""

import numpy as np
import trimesh


def grid(rows, columns, wrap=False):
    """Faces of a grid of points, row after row; ``wrap`` joins the last column to the first."""
    k = np.arange(rows * columns).reshape(rows, columns)
    if wrap:
        k = np.concatenate([k, k[:, :1]], axis=1)
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    return np.stack([a, b, c, b, d, c], axis=1).reshape(-1, 3)


def sheet(height=lambda x, y: 0 * x, size=0.3, n=15):
    y, x = np.meshgrid(*[np.linspace(-size, size, n)] * 2, indexing="ij")
    return np.stack([x, y, height(x, y)], -1).reshape(-1, 3), grid(n, n)


def tube(radius=0.05, length=0.4, around=24, along=20):
    """A sleeve about z, open at both ends, its normals outwards."""
    z, a = np.meshgrid(
        np.linspace(0, length, along), np.arange(around) * 2 * np.pi / around, indexing="ij"
    )
    return np.stack([radius * np.cos(a), radius * np.sin(a), z], -1).reshape(-1, 3), grid(
        along, around, wrap=True
    )


def sphere(radius=0.2, subdivisions=3):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(ball.vertices), np.array(ball.faces)


def ball(radius, subdivisions=4):
    """A :func:`sphere` as tensors, single precision."""
    import torch

    vertices, faces = sphere(radius, subdivisions)
    return torch.as_tensor(vertices, dtype=torch.float32), torch.as_tensor(faces)


def joined(*meshes):
    """Several meshes as one, each with vertices of its own."""
    start = np.cumsum([0] + [len(V) for V, _ in meshes])
    return np.concatenate([V for V, _ in meshes]), np.concatenate(
        [F + k for (_, F), k in zip(meshes, start)]
    )


def with_fin(n=11):
    """A sheet with a second one standing on its middle row: an edge of three faces along it. Some
    of the fin's faces are wound the other way."""
    V, F = sheet(n=n)
    row = np.arange(n) + n * (n // 2)
    fin = np.concatenate([row] + [np.arange(n) + len(V) + n * k for k in range(4)])
    points = np.concatenate([V[row] + (0, 0, 0.06 * (k + 1)) for k in range(4)])
    faces = fin[grid(5, n)]
    faces[::3] = faces[::3, ::-1]
    return np.concatenate([V, points]), np.concatenate([F, faces])


def moebius(around=40, across=5):
    a, t = np.meshgrid(
        np.arange(around) * 2 * np.pi / around, np.linspace(-0.05, 0.05, across), indexing="ij"
    )
    r = 0.2 + t * np.cos(a / 2)
    V = np.stack([r * np.cos(a), r * np.sin(a), t * np.sin(a / 2)], -1).reshape(-1, 3)
    k = np.arange(around * across).reshape(around, across)
    k = np.concatenate([k, k[:1, ::-1]])
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]))
    return V, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
