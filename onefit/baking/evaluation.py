"""A baked drape: plain arrays, and their evaluation from poses by NumPy alone."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from polyfit.errors import InputError
from polyfit.files import NOT_NPZ, aside

_BATCH = 4  # frames at once: what they need stays in a core's cache
_LAYERS = 3  # of the network


@dataclass(frozen=True, eq=False)
class Baked:
    """The drape of one garment on one body, as a game has it: joints, a skinned mesh, corrective
    shapes, and the little that finds the shapes' weights from the poses.

    ``name``; ``fps`` frames a second it was baked at; ``faces`` (F, 3) int64. In the rest space
    [m]: ``mean`` (N, 3), the mesh with all weights zero, and ``shapes`` (R, N, 3), displacements.
    Skinning: ``joint_of`` (N, 4) int64 and ``joint_weights`` (N, 4), rows that sum to one. The
    skeleton: ``joints`` (24, 3) [m] at rest, ``parents`` (24,) int64, -1 of the root,
    ``rest_rotations`` (24, 3, 3), of the joints in the world at rest, counted from the T-pose;
    ``pace``, by which a motion's translation is multiplied. ``seen`` (J,) int64: the joints that
    the network sees, each behind its parent.

    ``layers``: the network's matrices (in, out), and ``biases`` (out,): from features of a pose to
    G numbers, the *guide*. Pendulums: the vertices ``hung`` (P,) int64; where the guide has them at
    rest, ``points`` (P, 3) [m] with all of it zero, and ``point_shapes`` (G, P, 3); ``pull`` (P,)
    [1/s^2] towards there; ``drag`` [1/m] of the air. ``answer`` (G + 3 P, R), from the guide and
    the pendulums to the weights of the shapes. All float32 unless said otherwise.

    A frame is skin(mean + Σ_i w_i shapes_i).
    """

    name: str
    fps: float
    faces: np.ndarray
    mean: np.ndarray
    shapes: np.ndarray
    joint_of: np.ndarray
    joint_weights: np.ndarray
    joints: np.ndarray
    parents: np.ndarray
    rest_rotations: np.ndarray
    pace: float
    seen: np.ndarray
    layers: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    hung: np.ndarray
    points: np.ndarray
    point_shapes: np.ndarray
    pull: np.ndarray
    drag: float
    answer: np.ndarray

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all as arrays of a ``.npz``, those of the layers as ``layers0`` and so on."""
        arrays: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple):
                arrays |= {f"{field.name}{k}": x for k, x in enumerate(value)}
            else:
                arrays[field.name] = value
        with aside(path) as temporary:
            np.savez(temporary, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Baked:
        """A baked drape that :meth:`save` wrote. Raises InputError for another file."""
        needed = "a baked.npz that onefit.bake wrote is needed"
        try:
            with np.load(path) as file:
                layered = lambda name: tuple(file[f"{name}{k}"] for k in range(_LAYERS))
                values: dict[str, Any] = {
                    f.name: layered(f.name) if f.name in ("layers", "biases") else file[f.name]
                    for f in fields(cls)
                }
            scalars: dict[str, Any] = {k: float(values[k]) for k in ("fps", "pace", "drag")}
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}; {needed}") from None
        except (*NOT_NPZ, KeyError):
            raise InputError(f"{path}: not a baked drape, or cut off; {needed}") from None
        return cls(**(values | scalars | {"name": str(values["name"])}))

    def vertices(self, poses: Any, translation: Any, fps: float | None = None) -> np.ndarray:
        """Vertices (T, N, 3) float32 [m] in the world of a motion: ``poses`` (T, 24, 3) [rad] and
        ``translation`` (T, 3) [m] as :class:`onefit.Motion` has them, ``fps`` a second. Raises
        InputError where they are not so.
        """
        weights, maps = self._played(poses, translation, fps)
        out, skinned = np.empty((len(maps), 3, len(self.mean)), np.float32), self._skinning()
        for k in range(0, len(maps), _BATCH):
            skinned(weights[k : k + _BATCH], maps[k : k + _BATCH], out[k : k + _BATCH])
        return out.transpose(0, 2, 1)

    def weights(self, poses: Any, translation: Any, fps: float | None = None) -> np.ndarray:
        """Weights (T, R) of the shapes in a motion; arguments as in :meth:`vertices`."""
        return self._played(poses, translation, fps)[0]

    def _played(self, poses, translation, fps):
        """Weights (T, R) and maps (T, K, 12) of a motion."""
        poses, translation = self._checked(poses, translation, many=True)
        fps = self._rate(fps)
        features, placed = self.features(poses, translation, fps)
        maps, guide, swung = self.maps(placed), self.guide(features), self.swings(fps)
        swings = [swung(m, g) for m, g in zip(maps, guide)]
        return self.answered(guide, np.stack(swings)), maps

    def _checked(self, poses, translation, many=False):
        """A pose and a translation, or ``many`` frames of them, as float32 arrays."""
        try:
            poses, translation = (np.asarray(x, np.float32) for x in (poses, translation))
        except (TypeError, ValueError):
            raise InputError("poses and translation: arrays of numbers are needed") from None
        count, lead = len(self.parents), poses.shape[:1] if many else ()
        if poses.shape != (*lead, count, 3) or translation.shape != (*lead, 3) or 0 in lead:
            frames = "T, " if many else ""
            raise InputError(
                f"poses of shape {poses.shape} and a translation of shape {translation.shape};"
                f" ({frames}{count}, 3) and ({frames}3{'' if many else ','}) are needed"
            )
        if not (np.isfinite(poses).all() and np.isfinite(translation).all()):
            raise InputError("poses and translation: all numbers must be finite")
        return poses, translation

    def _rate(self, fps):
        """``fps``, or what the drape was baked at."""
        if fps is not None and not 0 < fps < 10_000:
            raise InputError(f"{fps} frames a second; a positive number is needed")
        return self.fps if fps is None else fps

    def size(self) -> int:
        """Bytes of all its arrays."""
        arrays = [getattr(self, f.name) for f in fields(self)]
        arrays = [*arrays, *self.layers, *self.biases]
        return sum(x.nbytes for x in arrays if isinstance(x, np.ndarray))

    def stream(self, fps: float | None = None) -> Stream:
        """A :class:`Stream`, which takes poses one at a time, ``fps`` of them a second. Raises
        InputError for an ``fps`` that is not positive.
        """
        return Stream(self, fps)

    def features(
        self, poses: np.ndarray, translation: np.ndarray, fps: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What the network sees of each frame, (T, C), and the places (T, J + 1, 4, 4) of
        :meth:`placed`; arguments as in :meth:`vertices`, float32.

        In the root's axes: of each joint two columns of its rotation against its parent; the root's
        turn [rad/s]; which way is up; the root's velocity [m/s]; each joint's place [m]. Neither
        where the root is, nor where it faces: cloth does not know.
        """
        rotations, placed = self.placed(poses, translation)
        before = np.concatenate([placed[:1], placed[:-1]])
        return _features(rotations, placed, before, self._rate(fps)), placed

    def guide(self, features: np.ndarray) -> np.ndarray:
        """The guide (..., G), from :meth:`features` (..., C): where cloth without mass would be."""
        x = features
        for matrix, bias in zip(self.layers[:-1], self.biases):
            x = np.maximum(x @ matrix + bias, 0)
        return x @ self.layers[-1] + self.biases[-1]

    def swings(self, fps: float | None = None) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """A function that is called frame after frame, with the joints' maps (K, 12) of
        :meth:`maps` and the guide (G,), and says how far the pendulums are from the guide, (3 P,)
        [m], turned back to the rest space.

        As in post-processing (:mod:`onefit.draping.post`): a pendulum goes on as it did, slowed
        down by the air, and is pulled to where the guide has its vertex, by one step of the
        implicit Euler method. It begins there, and moves with it.
        """
        dt = 1 / self._rate(fps)
        share = (1 / (1 + self.pull * dt * dt)).astype(np.float32)
        shapes = self.point_shapes.swapaxes(1, 2).reshape(len(self.point_shapes), -1)
        points = np.ascontiguousarray(self.points.T).ravel()
        dense = np.ascontiguousarray(self._skin[2][:, self.hung])
        drag, count = np.float32(self.drag), len(self.hung)
        at: list[np.ndarray] = []  # in the two frames before, (3, P) [m]

        def swung(maps, guide):
            blended = (maps.T @ dense).reshape(3, 4, count)
            rest = (guide @ shapes + points).reshape(3, count)
            goal = np.einsum("ijn,jn->in", blended[:, :3], rest) + blended[:, 3]
            if not at:
                at[:] = goal, None
                return np.zeros(3 * count, np.float32)
            way = at[0] - at[1] if at[1] is not None else goal - at[0]
            length = np.sqrt(np.einsum("in,in->n", way, way))
            away = share * (at[0] + way / (1 + drag * length) - goal)
            at[:] = goal + away, at[0]
            return np.einsum("ijn,in->jn", blended[:, :3], away).ravel()

        return swung

    def answered(self, guide: np.ndarray, swings: np.ndarray) -> np.ndarray:
        """Weights (..., R) of the shapes, from the guide (..., G) and the swings (..., 3 P)."""
        return np.concatenate([guide, swings], -1) @ self.answer

    def placed(self, poses: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (..., J, 3, 3) against the parents, and places (..., J + 1, 4, 4) in the world,
        of the joints that are seen, from poses (..., 24, 3) and translation (..., 3).
        """
        offsets, above = self._chain
        rotations = _rotations(poses[..., self.seen, :])
        placed = np.empty((*rotations.shape[:-3], *offsets.shape), np.float32)
        placed[...] = offsets
        placed[..., :-1, :3, :3] = rotations
        placed[..., 0, :3, 3] += self.pace * translation
        for up in above:
            placed = placed[..., up, :, :] @ placed
        return rotations, placed

    def maps(self, placed: np.ndarray) -> np.ndarray:
        """Maps (..., K, 12), by rows of (3, 4), from the rest space to the world, of the joints
        that skin, from :meth:`placed`.
        """
        at, inverse, _ = self._skin
        maps = placed[..., at, :3, :] @ inverse
        return maps.reshape(*maps.shape[:-2], 12)

    def _skinning(self):
        """A function that fills ``out`` (n, 3, N), of at most _BATCH frames, from weights (n, R)
        and maps (n, K, 12); it keeps its memory, for new memory costs more than the products.
        """
        mean, shapes = self._flat
        dense, count = self._skin[2], len(self.mean)
        rest = np.ones((_BATCH, 4, count), np.float32)  # the fourth coordinate stays
        shaped = rest.reshape(_BATCH, -1)[:, : 3 * count]
        blended = np.empty((12, count), np.float32)

        def skinned(weights, maps, out):
            np.matmul(weights, shapes, out=shaped[: len(weights)])
            for flat, points, m, x in zip(shaped, rest, maps, out):
                flat += mean
                np.matmul(m.T, dense, out=blended)
                np.einsum("ijn,jn->in", blended.reshape(3, 4, count), points, out=x)

        return skinned

    @cached_property
    def _flat(self):
        """The mean (3 N,) and the shapes (R, 3 N), coordinate by coordinate."""
        flat = lambda x: np.ascontiguousarray(x.swapaxes(-1, -2)).reshape(*x.shape[:-2], -1)
        return flat(self.mean), flat(self.shapes)

    @cached_property
    def steps(self) -> np.ndarray:
        """Each joint's place (24, 3) [m] from its parent, in the parent's axes; of the root, from
        the world's origin.
        """
        root = self.parents[:, None] < 0
        step = self.joints - np.where(root, 0, self.joints[self.parents])
        turn = np.where(root[..., None], np.eye(3), self.rest_rotations[self.parents])
        return np.einsum("jki,jk->ji", turn, step).astype(np.float32)

    @cached_property
    def inverse(self) -> np.ndarray:
        """Maps (24, 4, 4) from the rest space to each joint's own axes there."""
        rest = np.tile(np.eye(4), (len(self.joints), 1, 1))
        rest[:, :3, :3], rest[:, :3, 3] = self.rest_rotations, self.joints
        return np.linalg.inv(rest).astype(np.float32)

    @cached_property
    def _skin(self):
        """Joints (K,) that skin, as places in ``seen``; their maps from the rest space (K, 4, 4);
        the weights (K, N).
        """
        used = np.unique(self.joint_of[self.joint_weights > 0])
        dense = np.zeros((len(self.mean), len(self.parents)), np.float32)
        rows = np.arange(len(dense))[:, None]
        np.add.at(dense, (rows, self.joint_of), self.joint_weights)
        at = np.searchsorted(self.seen, used)
        return at, self.inverse[used], np.ascontiguousarray(dense[:, used].T)

    @cached_property
    def _chain(self):
        """Places (J + 1, 4, 4) of the joints against their parents, without rotation, the world's
        last; and, as often as is needed for the longest chain, which place stands above each: first
        the parent, then the parent's parent, then that one's.
        """
        last, parent = len(self.seen), self.parents[self.seen]
        offsets = np.tile(np.eye(4, dtype=np.float32), (last + 1, 1, 1))
        offsets[:-1, :3, 3] = self.steps[self.seen]
        up = np.append(np.where(parent < 0, last, np.searchsorted(self.seen, parent)), last)
        above = []
        while (up != last).any():
            above.append(up)
            up = up[up]
        return offsets, above


class Stream:
    """Poses of one body go in, one at a time, and vertices come out; remembers how the cloth
    swings. ``fps``: poses a second, by default as many as the ``baked`` drape was made at. Made by
    :meth:`Baked.stream`.
    """

    def __init__(self, baked: Baked, fps: float | None = None) -> None:
        self._baked, self._fps, self._skinned = baked, baked._rate(fps), baked._skinning()
        self.reset()

    def reset(self) -> None:
        """Forget the poses so far: with the next one a motion begins, as with the first."""
        self._swings = self._baked.swings(self._fps)
        self._before: np.ndarray | None = None

    def __call__(self, pose: Any, translation: Any) -> np.ndarray:
        """Vertices (N, 3) float32 [m] in the world, for the next ``pose`` (24, 3) [rad] and
        ``translation`` (3,) [m]. Raises InputError where they are not so.
        """
        baked = self._baked
        pose, translation = baked._checked(pose, translation)
        rotations, placed = baked.placed(pose, translation)
        before = placed if self._before is None else self._before
        self._before, maps = placed, baked.maps(placed)
        guide = baked.guide(_features(rotations, placed, before, self._fps))
        out = np.empty((1, 3, len(baked.mean)), np.float32)
        weights = baked.answered(guide, self._swings(maps, guide))
        self._skinned(weights[None], maps[None], out)
        return out[0].T


# Of a quaternion (w, x, y, z), the products of its parts two by two, row by row, to the matrix'
# rows; and from a rotation's rows to twice its axis, by the sine of its angle
_FROM_PRODUCTS, _AXIS = np.zeros((16, 9), np.float32), np.zeros((9, 3), np.float32)
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _FROM_PRODUCTS[[0, 5 * _i + 5, 5 * _j + 5, 5 * _k + 5], 4 * _i] = 1, 1, -1, -1
    _FROM_PRODUCTS[4 * _i + _j + 5, [3 * _i + _j, 3 * _j + _i]] = 2
    _FROM_PRODUCTS[_k + 1, [3 * _i + _j, 3 * _j + _i]] = -2, 2
    _AXIS[[3 * _j + _i, 3 * _i + _j], _k] = 1, -1


def _rotations(vectors):
    """Matrices (..., 3, 3) of axis-angle vectors (..., 3) [rad]."""
    angle = np.sqrt(np.einsum("...i,...i->...", vectors, vectors) + np.float32(1e-12))
    half = np.float32(0.5) * angle
    quaternions = np.empty((*angle.shape, 4), np.float32)
    quaternions[..., 0] = np.cos(half)
    np.multiply(vectors, (np.sin(half) / angle)[..., None], out=quaternions[..., 1:])
    products = quaternions[..., :, None] * quaternions[..., None, :]
    return (products.reshape(*angle.shape, 16) @ _FROM_PRODUCTS).reshape(*angle.shape, 3, 3)


def _features(rotations, placed, before, fps):
    """See :meth:`Baked.features`: (..., 6 (J - 1) + 6 + 3 J), from rotations (..., J, 3, 3) and
    places now and in the frame before, (..., J + 1, 4, 4).
    """
    root, lead = placed[..., 0, :3, :3], placed.shape[:-3]
    moved = placed[..., :-1, :3, 3] - placed[..., :1, :3, 3]
    moved[..., 0, :] = fps * (placed[..., 0, :3, 3] - before[..., 0, :3, 3])
    step = before[..., 0, :3, :3].swapaxes(-1, -2) @ root
    turn = step.reshape(*lead, 9) @ (np.float32(fps / 2) * _AXIS)
    columns = rotations[..., 1:, :, :2].reshape(*lead, -1)
    seen = (moved @ root).reshape(*lead, -1)  # each by the root's rotation, transposed
    return np.concatenate([columns, turn, root[..., 2, :], seen], -1)
