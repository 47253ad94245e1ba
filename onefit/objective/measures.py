"""Figures of a drape: collisions, changes of lengths and areas, jitter, physical energy (paper,
section "Experiments", OneFit).
"""

from dataclasses import asdict, dataclass

import numpy as np
import torch

from onefit.body import ClosestSurface
from polyfit import mesh

from . import losses

_BENEATH_REACH = 0.05  # [m]


@dataclass(frozen=True)
class Measures:
    """``collision``: % of the vertices inside the body (the paper's epsilon_c); ``edge``, ``area``:
    mean % by which edges and faces change (epsilon_e, epsilon_a), against the garment graded to the
    body; ``energy``: stretching, gravity and inertia [J], a mean over frames; ``jitter``: mean
    length of the vertices' second differences in time [mm]."""

    collision: float
    edge: float
    area: float
    energy: float
    jitter: float

    def as_dict(self):
        return asdict(self)


def areas(vertices, faces):
    """Areas (T, F) of the faces (F, 3) of vertices (T, N, 3)."""
    a, b, c = (vertices[:, faces[:, k]] for k in range(3))
    return torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2


def lengths(vertices, edges):
    """Lengths (T, E) of the edges (E, 2) of vertices (T, N, 3)."""
    return (vertices[:, edges[:, 0]] - vertices[:, edges[:, 1]]).norm(dim=-1)


def _physical_energy(vertices, rest, faces, root, dt, density):
    """Stretching, gravity and inertia [J], each (T - 2,), of vertices (T, N, 3) of a garment that
    rests at ``rest`` (N, 3).

    They are the terms of the paper's objective, frame by frame: k_mi sum of squared changes of edge
    lengths; m g (z - z of the ``root`` (T, 3)); m |second difference|^2 / (2 dt^2).
    """
    edges = torch.as_tensor(mesh.edges_of(faces.numpy())[0])
    change = lengths(vertices[2:], edges) - lengths(rest[None], edges)
    stretch = losses.Weights.k_mi * change.square().sum(1)
    face_area = areas(rest[None], faces)[0]
    mass = density * torch.zeros(len(rest)).index_add(
        0, faces.flatten(), (face_area / 3).repeat_interleave(3)
    )
    gravity = losses.GRAVITY * ((vertices[2:, :, 2] - root[2:, None, 2]) * mass).sum(1)
    second = vertices[2:] - 2 * vertices[1:-1] + vertices[:-2]
    inertia = (second.square().sum(-1) * mass).sum(1) / (2 * dt * dt)
    return stretch, gravity, inertia


def measure(vertices, faces, rest, body_vertices, collider, root, fps, density=losses.DENSITY):
    """:class:`Measures` of the vertices (T, N, 3) [m] of a garment with ``faces`` (F, 3), at
    ``rest`` (N, 3), on bodies (T, V, 3) whose roots are at ``root`` (T, 3), in at least three
    frames; ``density`` [kg/m^2] of the cloth."""
    edges = torch.as_tensor(mesh.edges_of(faces.numpy())[0])
    inside = (
        torch.stack(
            [collider.distances(v[None], b[None])[0] < 0 for v, b in zip(vertices, body_vertices)]
        )
        .float()
        .mean()
    )
    change = lambda now, then: ((now - then).abs() / then).mean()
    energy = sum(_physical_energy(vertices, rest, faces, root, 1 / fps, density)).mean()
    second = (vertices[2:] - 2 * vertices[1:-1] + vertices[:-2]).norm(dim=-1).mean()
    return Measures(
        100 * float(inside),
        100 * float(change(lengths(vertices, edges), lengths(rest[None], edges))),
        100 * float(change(areas(vertices, faces), areas(rest[None], faces))),
        float(energy),
        1e3 * float(second),
    )


def depths_beneath(vertices, inner, faces):
    """How far vertices (T, N, 3) [m] of an outer garment lie beneath an ``inner`` one (T, M, 3) [m]
    with ``faces`` (F, 3), an array (T, N) [m]: 0 for those that do not. One does where the point of
    the inner one nearest to it, within 5 cm, is not on its rim, and it is on the inner side there.
    """
    faces, surface = np.asarray(faces), ClosestSurface(inner[0], faces)
    on_rim = np.zeros(inner.shape[1], dtype=bool)
    on_rim[mesh.boundary_edges(faces)] = True
    depths = []
    for x, at in zip(vertices.numpy(), inner):
        surface.follow(at)
        found = surface(x, _BENEATH_REACH)
        rim = (on_rim[faces[found.face]] | (found.barycentric < 1e-4)).all(1)
        depths.append(np.where((found.face >= 0) & ~rim, np.maximum(-found.distance, 0), 0.0))
    return np.stack(depths)
