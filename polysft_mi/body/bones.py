"""A moving mesh as bones: small pieces of it, each of which moves as a rigid body. What lies on the
mesh is carried by them, as by a skeleton's joints. NumPy and SciPy only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from polyfit.mesh import edges_of

from .carrier import Carrier

_BONES = 96
_SHARED = 4  # bones that move a vertex


@dataclass(frozen=True)
class Bones:
    """B bones of a mesh of V vertices in T frames, below a root that moves with the whole: what a
    :class:`polysft_mi.body.carrier.Carrier` takes.

    ``joints`` (1 + B, 3) [m]: where they are at rest, the root first; ``weights`` (V, 1 + B), rows
    that sum to one; ``poses`` (T, 1 + B, 3) [rad]: the root's rotations, and those of the bones in
    its axes; ``offsets`` (T, 1 + B, 3) [m] of the bones from the root, along its axes;
    ``translation`` (T, 3) [m] of the root.
    """

    joints: np.ndarray
    weights: np.ndarray
    poses: np.ndarray
    offsets: np.ndarray
    translation: np.ndarray

    @classmethod
    def of(cls, rest: np.ndarray, faces: np.ndarray, frames: np.ndarray, count=_BONES) -> Bones:
        """The bones of a mesh at ``rest`` (V, 3) [m] with ``faces`` (F, 3), which is at ``frames``
        (T, V, 3) [m] later: ``count`` vertices that lie as far from each other as can be, along the
        mesh, and what surrounds them.
        """
        centres, weights = _surroundings(rest, faces, min(count, len(rest) - 1))
        joints = np.concatenate([rest.mean(0, keepdims=True), rest[centres]])
        shares = np.concatenate([np.full((len(rest), 1), 1 / len(rest)), weights], 1)
        poses = np.empty((len(frames), len(joints), 3))
        offsets, translation = np.empty_like(poses), np.empty((len(frames), 3))
        for k, frame in enumerate(frames):
            turn, place = _rigid(rest, frame, shares, joints)
            translation[k] = place[0] - joints[0]
            offsets[k] = (place - place[0]) @ turn[0]
            turn[1:] = turn[0].T @ turn[1:]
            poses[k] = Rotation.from_matrix(turn).as_rotvec()
        return cls(joints, np.pad(weights, ((0, 0), (1, 0))), poses, offsets, translation)

    def carrier(self, weights: np.ndarray, **how) -> Carrier:
        """The :class:`polysft_mi.body.carrier.Carrier` of points with such ``weights`` (N, 1 + B);
        ``how`` as that takes it.
        """
        parents, rest = (-1,) + (0,) * (len(self.joints) - 1), np.zeros_like(self.joints)
        known = self.poses, self.translation
        return Carrier(self.joints, parents, rest, weights, *known, offsets=self.offsets, **how)

    def led_in(self, count: int) -> Bones:
        """The same with ``count`` frames before the first one, in which the mesh, standing where it
        does and turned as there, goes from its rest to that frame.
        """
        share = np.linspace(0, 1, count + 1)[:-1, None, None]
        share = share * share * (3 - 2 * share)
        root = np.arange(len(self.joints))[:, None] == 0
        rest = self.joints - self.joints[0]
        return replace(
            self,
            poses=np.concatenate([np.where(root, 1, share) * self.poses[:1], self.poses]),
            offsets=np.concatenate([rest + share * (self.offsets[:1] - rest), self.offsets]),
            translation=np.concatenate([self.translation[:1].repeat(count, 0), self.translation]),
        )


def _surroundings(rest, faces, count):
    """Vertices (B,), and how much each moves each other one, (V, B). A part of the mesh that holds
    none is moved by those that lie nearest in space.
    """
    edges = edges_of(faces)[0]
    length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    graph = coo_matrix((np.maximum(length, 1e-9), edges.T), (len(rest),) * 2).tocsr()
    used = np.unique(faces)
    centres, apart = [], np.full(len(rest), -np.inf)
    apart[used] = np.inf
    away = []
    for _ in range(count):
        centres.append(int(apart.argmax()))
        away.append(dijkstra(graph, directed=False, indices=centres[-1]))
        apart = np.minimum(apart, away[-1])
    away = np.stack(away, 1)
    lost = ~np.isfinite(away).any(1)
    away[lost] = np.linalg.norm(rest[lost, None] - rest[centres], axis=2)
    # nought where one more bone begins to be as near, so that weights are smooth
    reach = np.sort(away, 1)[:, min(_SHARED, count - 1), None]
    reach = np.where(np.isfinite(reach) & (reach > 0), reach, 1e9)
    weights = np.maximum(1 - away / reach, 0) ** 2
    return np.array(centres), weights / weights.sum(1, keepdims=True)


def _rigid(rest, frame, shares, joints):
    """Rotations (J, 3, 3) and places (J, 3) of rigid bodies, whose ``shares`` (V, J) of the
    vertices they take from ``rest`` to the ``frame``, by least squares (Kabsch).
    """
    total = shares.sum(0)[:, None]
    before, after = shares.T @ rest / total, shares.T @ frame / total
    product = np.einsum("vi,vb,vj->bij", frame, shares, rest, optimize=True)
    product -= total[..., None] * after[:, :, None] * before[:, None]
    u, _, vh = np.linalg.svd(product)
    u[..., -1] *= np.linalg.det(u @ vh)[:, None]
    turn = u @ vh
    return turn, after + np.einsum("bij,bj->bi", turn, joints - before)
