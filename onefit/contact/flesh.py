"""Flesh that yields: where the skins of limbs and trunk overlap, as they do on a skinned body whose
arm comes near to its side, both draw back, and cloth has room between them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.sparse import csr_matrix

from onefit.body import Body, ClosestSurface, Nearest, skeleton
from polyfit.mesh import boundary_edges, neighbour_mean

DEEPEST = 0.03  # [m] that a vertex may lie in another part to yield
_PASSES = 3  # in a frame, at most
_ON_EDGE = 1e-4  # barycentric coordinates below it
_SMOOTHING = 3  # times, of the ways of a pass
_LIMBS = "left_shoulder", "right_shoulder", "left_hip", "right_hip"


@dataclass(frozen=True)
class _Part:
    """A part of the skin: which of the body's vertices it ``has`` (V,), ``own`` (P,), their
    numbers, and its ``faces`` (F, 3), numbers among these. It is open where it was cut off: at its
    ``rim`` (P,). ``surface``: where it is now.
    """

    has: np.ndarray
    own: np.ndarray
    faces: np.ndarray
    rim: np.ndarray
    surface: ClosestSurface


class Flesh:
    """The flesh of a ``body``: skin that is nearer than ``room`` [m] to that of another part, or
    inside it, yields. The parts are the four limbs and the rest of the body.

    A vertex goes half of the way that is missing along the other part's normal; the other part's
    vertices go the other half. The ways are smoothed over the mesh. What is nearer to the other
    part than ``room`` at rest is the same skin, as at the armpit, and does not yield; what is three
    times as far yields wholly.
    """

    def __init__(self, body: Body, room: float) -> None:
        self.room, self._rest = room, body.vertices.double().cpu().numpy()
        faces = body.faces.cpu().numpy()
        of = _part_of_joint()[body.blend_weights.cpu().numpy().argmax(1)]
        self._parts = [_cut_off(self._rest, faces, of == p) for p in np.unique(of)]
        self._mean = neighbour_mean(faces, len(self._rest))

    def __call__(self, bodies: torch.Tensor) -> torch.Tensor:
        """The skin (T, V, 3) [m] in the frames of ``bodies`` (T, V, 3) [m] after it yielded; the
        same where there is room.
        """
        out = bodies.cpu().clone()
        for frame in out.numpy():  # torch's threads would wait for each other at each step
            for _ in range(_PASSES):
                x = frame.astype(float)
                ways = self.missing(x)
                if not ways.any():
                    break
                frame[:] = x + spread(ways, self._mean, _SMOOTHING)
        return out.to(bodies)

    def missing(self, x: np.ndarray) -> np.ndarray:
        """The ways (V, 3) [m] that the vertices of a body at (V, 3) [m] are to yield."""
        ways, longest = np.zeros_like(x), np.zeros(len(x))
        columns = np.ascontiguousarray(x.T)
        for part in self._parts:
            skin = columns[:, part.own]
            part.surface.follow(skin.T)
            near = ~part.has
            for column, values in zip(columns, skin):
                near &= (column > values.min() - self.room) & (column < values.max() + self.room)
            some = np.flatnonzero(near)
            if not len(some):
                continue
            found = part.surface(x[some].astype(np.float32), DEEPEST)
            some, found = some[found.face >= 0], _of(found, found.face >= 0)
            corners = part.faces[found.face]
            at_rest = np.einsum("sk,ski->si", found.barycentric, self._rest[part.own[corners]])
            apart = np.linalg.norm(at_rest - self._rest[some], axis=1)
            on_rim = (part.rim[corners] | (found.barycentric < _ON_EDGE)).all(1)
            firm = np.where(on_rim, 0, np.clip((apart / self.room - 1) / 2, 0, 1))
            length = 0.5 * firm * np.maximum(self.room - found.distance, 0)
            more = length > longest[some]
            ways[some[more]] = length[more, None] * found.normal[more]
            longest[some[more]] = length[more]
        return ways


def spread(push: np.ndarray, mean: csr_matrix, times: int) -> np.ndarray:
    """Pushes (N, 3) [m], smoothed over the mesh so many ``times``; none becomes shorter. ``mean``
    (N, N): :func:`polyfit.mesh.neighbour_mean`.
    """
    for _ in range(times):
        around = mean @ push
        longer = np.einsum("ni,ni->n", push, push) > np.einsum("ni,ni->n", around, around)
        push = np.where(longer[:, None], push, around)
    return push


def _of(found: Nearest, which: np.ndarray) -> Nearest:
    """What was found of some of the points."""
    return Nearest(*(getattr(found, field.name)[which] for field in fields(found)))


def _part_of_joint() -> np.ndarray:
    """The part (24,) that each joint moves: 0, or the number of the limb that it is in."""
    part = np.zeros(len(skeleton.JOINTS), dtype=int)
    for joint, (name, parent) in enumerate(zip(skeleton.JOINTS, skeleton.PARENTS)):
        part[joint] = 1 + _LIMBS.index(name) if name in _LIMBS else part[max(parent, 0)]
    return part


def _cut_off(vertices: np.ndarray, faces: np.ndarray, has: np.ndarray) -> _Part:
    own = np.flatnonzero(has)
    number = np.cumsum(has) - 1
    faces = number[faces[has[faces].all(1)]]
    rim = np.zeros(len(own), dtype=bool)
    rim[boundary_edges(faces)] = True
    return _Part(has, own, faces, rim, ClosestSurface(vertices[own], faces))
