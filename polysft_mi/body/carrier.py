"""How a body carries what it wears: linear blend skinning of a template's vertices, with the
derivatives by the pose. NumPy and SciPy only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

_FELT = 0.02  # of a vertex' weights: a joint that moves less of any vertex is left as it is


@dataclass(frozen=True)
class Pose:
    """A body in a ``frame`` (its number in the selection): ``rotation``, one of each of J joints,
    relative to its parent; ``translation`` (3,) [m] of the root; ``free`` (F,): the joints that the
    garment feels, which may be corrected.
    """

    frame: int
    rotation: Rotation
    translation: np.ndarray
    free: np.ndarray

    def after_step(self, step: np.ndarray) -> Pose:
        """The pose after a step (3 F + 3,): rotations of the free joints [rad], in the axes of
        their parents, and the root's way [m].
        """
        turn = np.zeros((len(self.rotation), 3))
        turn[self.free] = step[:-3].reshape(-1, 3)
        return replace(
            self,
            rotation=Rotation.from_rotvec(turn) * self.rotation,
            translation=self.translation + step[-3:],
        )

    def to_numpy(self) -> np.ndarray:
        """The frame, the rotations as vectors, and the translation, (1 + 3 J + 3,)."""
        return np.concatenate([[self.frame], self.rotation.as_rotvec().ravel(), self.translation])


@dataclass(frozen=True)
class Maps:
    """Affine maps of N points from the body's rest to a frame, x = A p + b: ``linear`` (N, 3, 3),
    ``shift`` (N, 3) [m, world].
    """

    linear: np.ndarray
    shift: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) [m, rest] in the frame [m, world]."""
        return np.einsum("nij,nj->ni", self.linear, points) + self.shift

    def back(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) [m, world] at rest."""
        return np.linalg.solve(self.linear, (points - self.shift)[..., None])[..., 0]


class Carrier:
    """Carries N vertices with a body.

    ``joints`` (J, 3) [m], ``parents`` (J,), ``rest_pose`` (J, 3) [rad]: the skeleton at rest;
    ``weights`` (N, J), rows that sum to one; ``poses`` (T, J, 3) [rad], ``translation`` (T, 3) [m]:
    what is known of its motion. ``draped`` (T, N, 3) [m, rest], or None: by what the garment's
    drape differs from the template in each frame, before it is carried; ``lengths`` (T, E) [m]: of
    the template's edges in the drape, or None, and ``length_errors`` (T,) how well they are known
    as a whole, shares. ``skin``: the body itself: vertices at rest (V, 3)
    [m], or of each frame, brought back to rest (T, V, 3), their weights (V, J), and faces (F, 3),
    or None. ``offsets`` (T, J, 3) [m]: of joints that do not keep their place on their parents,
    from there, along its axes. ``corrected``: the joints whose rotations may be corrected; None:
    all. ``fps``: frames a second. Maps, as :mod:`onefit.body.skinning` has them, are from the rest
    pose to a frame.
    """

    def __init__(
        self,
        joints,
        parents,
        rest_pose,
        weights,
        poses,
        translation,
        *,
        draped=None,
        lengths=None,
        length_errors=None,
        skin=None,
        offsets=None,
        corrected=None,
        fps=30.0,
    ):
        self.joints, self.weights = np.asarray(joints, float), np.asarray(weights, float)
        self.parents = tuple(parents)
        self.poses, self.translation = np.asarray(poses, float), np.asarray(translation, float)
        self.draped, self.skin, self.fps = draped, skin, fps
        self.lengths, self.length_errors = lengths, length_errors
        kept = self.joints - self.joints[np.maximum(parents, 0)]
        self._offsets = np.broadcast_to(kept, (len(self.poses), *kept.shape))
        if offsets is not None:
            self._offsets = np.asarray(offsets, float)
        self._rest = self._chained(Rotation.from_rotvec(rest_pose).as_matrix())
        count = len(self.parents)
        #: (J, J): whether the first joint moves the second one
        self._moves = np.zeros((count, count), dtype=bool)
        for k in range(count):
            j = k
            while j >= 0:
                self._moves[j, k] = True
                j = self.parents[j]
        #: (N, J): how much of each vertex each joint moves
        self._moved = self.weights @ self._moves.T.astype(float)
        felt = self._moved.max(0) > _FELT
        self.free = np.flatnonzero(felt if corrected is None else felt & corrected)

    def __len__(self):
        """How many unknowns a correction of the pose has."""
        return 3 * len(self.free) + 3

    def at(self, frame: int, corrected: np.ndarray | None = None) -> Pose:
        """The :class:`Pose` that is known of a frame, with a correction (3 F + 3,) as
        :meth:`correction` has it, or none.
        """
        rotation = Rotation.from_rotvec(self.poses[frame])
        pose = Pose(frame, rotation, self.translation[frame], self.free)
        return pose if corrected is None else pose.after_step(corrected)

    def pose(self, numbers: np.ndarray) -> Pose:
        """The reverse of :meth:`Pose.to_numpy`."""
        rotation = Rotation.from_rotvec(np.asarray(numbers[1:-3], float).reshape(-1, 3))
        return Pose(round(float(numbers[0])), rotation, np.asarray(numbers[-3:], float), self.free)

    def correction(self, pose: Pose) -> np.ndarray:
        """What leads from the known pose of a frame to this one, (3 F + 3,): rotations [rad] in the
        axes of the parents, and the root's way [m].
        """
        known = Rotation.from_rotvec(self.poses[pose.frame])
        turn = (pose.rotation * known.inv()).as_rotvec()[self.free]
        return np.concatenate([turn.ravel(), pose.translation - self.translation[pose.frame]])

    def maps(self, pose: Pose) -> Maps:
        """The :class:`Maps` of the vertices, the drape of the frame in them."""
        _, linear, shift, _ = self._joint_maps(pose)
        linear = (self.weights @ linear.reshape(-1, 9)).reshape(-1, 3, 3)
        shift = self.weights @ shift
        if self.draped is not None:
            shift = shift + np.einsum("nij,nj->ni", linear, self.draped[pose.frame])
        return Maps(linear, shift)

    def body(self, pose: Pose) -> np.ndarray:
        """The body's vertices (V, 3) [m, world]."""
        vertices, weights, _ = self.skin
        vertices = vertices[pose.frame] if vertices.ndim == 3 else vertices
        _, linear, shift, _ = self._joint_maps(pose)
        each = np.concatenate([linear, shift[..., None]], 2).reshape(len(linear), -1)
        maps = (weights @ each).reshape(-1, 3, 4)
        return np.einsum("vij,vj->vi", maps[..., :3], vertices) + maps[..., 3]

    def motion(self, poses: list[Pose]) -> dict[str, np.ndarray | float]:
        """The body in these poses, as a file of its motion has it: arrays by their names. One that
        was known as a mesh, whose skin has another form in each frame, is a mesh again.
        """
        if self.skin is not None and self.skin[0].ndim == 3:
            found = np.stack([self.body(pose) for pose in poses]).astype(np.float32)
            return dict(vertices=found, faces=self.skin[2], fps=self.fps)
        return dict(
            poses=np.stack([pose.rotation.as_rotvec() for pose in poses]),
            translation=np.stack([pose.translation for pose in poses]),
            fps=self.fps,
        )

    def columns(self, pose: Pose, points: np.ndarray) -> np.ndarray:
        """Derivatives (N, 3, 3 F + 3) of the carried vertices, at ``points`` (N, 3) [m, rest]
        before they are draped and carried, by a step of the pose (:meth:`Pose.after_step`).
        """
        turns, linear, shift, places = self._joint_maps(pose)
        if self.draped is not None:
            points = points + self.draped[pose.frame]
        each = (points @ linear.reshape(-1, 3).T).reshape(len(points), -1, 3) + shift
        # of what each joint moves of a vertex, the lever from the joint
        arm = self._moves[self.free].astype(float) @ (self.weights[..., None] * each)
        arm -= self._moved[:, self.free, None] * places[self.free]
        out = np.empty((len(points), 3, len(self)))
        for k, j in enumerate(self.free):
            axes = turns[self.parents[j]] if self.parents[j] >= 0 else np.eye(3)
            x, y, z = arm[:, k].T
            across = np.zeros((len(points), 3, 3))  # a step a turns the lever to a x lever
            across[:, 0, 1], across[:, 1, 0] = z, -z
            across[:, 0, 2], across[:, 2, 0] = -y, y
            across[:, 1, 2], across[:, 2, 1] = x, -x
            out[:, :, 3 * k : 3 * k + 3] = across @ axes
        out[:, :, -3:] = np.eye(3)
        return out

    def _joint_maps(self, pose):
        """(rotations (J, 3, 3) in the world, linear parts (J, 3, 3), shifts (J, 3), places (J, 3))
        of the joints.
        """
        turns = self._chained(pose.rotation.as_matrix())
        linear = turns @ self._rest.transpose(0, 2, 1)
        places, offsets = np.empty_like(self.joints), self._offsets[pose.frame]
        for j, p in enumerate(self.parents):
            if p < 0:
                places[j] = self.joints[j] + pose.translation
            else:
                places[j] = places[p] + linear[p] @ offsets[j]
        return turns, linear, places - np.einsum("jik,jk->ji", linear, self.joints), places

    def _chained(self, rotations):
        out = np.empty_like(rotations)
        for j, p in enumerate(self.parents):
            out[j] = rotations[j] if p < 0 else out[p] @ rotations[j]
        return out
