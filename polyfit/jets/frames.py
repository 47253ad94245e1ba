"""Canonical frames: the orientations O = (s, R, T) that take patches to their charts and back
(paper, section "PolyFit"), of arrays of NumPy or torch; and rotations by quaternions.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from polyfit.errors import InputError

from .backends import namespace


@dataclass(frozen=True)
class CanonicalFrame:
    """p = s R x + T, with x in the chart (u, v, z) and p in the surface's own frame [m].

    ``s`` (...,) [m], ``R`` (..., 3, 3) rotations whose columns are the chart's axes, ``T`` (..., 3)
    the charts' origins [m]: one frame, or a batch of them, of NumPy or torch.
    """

    s: Any
    R: Any
    T: Any

    @classmethod
    def from_points(cls, points: Any, mask: Any = None, *, weights: Any = None) -> "CanonicalFrame":
        """By principal components of points (..., P, 3): T is their mean, s their largest distance
        from it, z the direction of least spread.

        ``mask`` (..., P) bool: the points that exist; ``weights`` (..., P) not negative, for mean
        and spread. The data fix the signs, so that the frame turns with the points: u and v point
        to the side where the third moment of the coordinate is positive. For a symmetric patch they
        point to the first point that is at least half as far out as the farthest. z follows by the
        right hand. Computed in float64, returned in the points' dtype. Without gradient: a frame is
        a choice of coordinates. Raises InputError where a patch has no points or weight, or points
        that are not finite or all the same, and for a mask or weights of another kind.
        """
        check_points(points)
        xp = namespace(points)
        m, where = xp.module, xp.module.where
        with xp.no_grad():
            dtype, points = points.dtype, m.asarray(points, dtype=m.float64)
            if points.shape[-2] == 0:
                raise InputError("patches without points")
            mask, weights = of_points(points, "mask", mask), of_points(points, "weights", weights)
            w = None if weights is None else m.asarray(weights, dtype=m.float64)
            if mask is not None:
                w = where(mask, m.ones_like(points[..., 0]) if w is None else w, 0)
                points = where(mask[..., None], points, 0)
            weighed = None
            if w is not None:
                total = w.sum(-1)
                weighed = (w >= 0).all(-1) & (total > 0) & m.isfinite(total)
                w = w / where(weighed, total, 1)[..., None]
            T = points.mean(-2) if w is None else (w[..., None, :] @ points)[..., 0, :]
            centred = points - T[..., None, :]
            distance = (centred**2).sum(-1)
            if mask is not None:
                distance = where(mask, distance, 0)
            s = m.sqrt(m.amax(distance, -1))
            _check(points, mask, s, weighed)
            x = centred / s[..., None, None]
            spread = x.mT @ x / x.shape[-2] if w is None else (w[..., None] * x).mT @ x
            axes = m.linalg.eigh(spread)[1]
            if mask is not None:
                x = where(mask[..., None], x, 0)
            # float32 points are symmetric only to their rounding
            level = 1e-9 if dtype == m.float64 else 1e-6
            u, v = (_pointed(x, axes[..., k], w, level) for k in (2, 1))
            R = xp.stack([u, v, m.linalg.cross(u, v)])
            return cls(*(m.asarray(a, dtype=dtype) for a in (s, R, T)))

    @classmethod
    def over(cls, points: np.ndarray, normal: np.ndarray, radius: float) -> "CanonicalFrame":
        """Of points (P, 3) of NumPy with z along the unit ``normal`` (3,): T is their mean, u their
        largest extent across z, s their largest distance from T across z, or ``radius`` [m] where
        that is 0.
        """
        T = points.mean(0)
        centred = points - T
        flat = centred - (centred @ normal)[:, None] * normal
        s = np.sqrt((flat**2).sum(1).max())
        u = np.linalg.eigh(flat.T @ flat)[1][:, 2] if s > 0 else np.eye(3)[np.abs(normal).argmin()]
        u = _pointed(centred, u, None, 1e-9)
        u = u - (u @ normal) * normal
        u /= np.linalg.norm(u)
        return cls(s if s > 0 else radius, np.stack([u, np.cross(normal, u), normal], 1), T)

    def to_chart(self, points: Any) -> Any:
        """Chart coordinates (..., P, 3) of points (..., P, 3) [m]."""
        return (points - self.T[..., None, :]) @ self.R / self.s[..., None, None]

    def from_chart(self, x: Any) -> Any:
        """Points (..., P, 3) [m] of chart coordinates (..., P, 3)."""
        return self.s[..., None, None] * x @ self.R.mT + self.T[..., None, :]

    def rotated(self, quaternion: Any) -> "CanonicalFrame":
        """The frame whose chart is turned by the unit quaternion (..., 4) in the order (x, y, z,
        w): R Q, so that a point of chart coordinates x has Q^T x in the new chart. Differentiable;
        the quaternion is divided by its norm.
        """
        return CanonicalFrame(self.s, self.R @ rotation_matrix(quaternion), self.T)

    def turned_over(self) -> "CanonicalFrame":
        """The frame with v and z pointing the other way: a half turn about u.
        :func:`polyfit.jets.turned_over` does it to a jet.
        """
        xp = namespace(self.R)
        u, v, z = xp.parts(self.R)
        return CanonicalFrame(self.s, xp.stack([u, -v, -z]), self.T)

    def __getitem__(self, index: Any) -> "CanonicalFrame":
        return CanonicalFrame(self.s[index], self.R[index], self.T[index])

    def to(self, *args: Any, **kwargs: Any) -> "CanonicalFrame":
        """The frame, of torch, with another dtype or on another device."""
        return CanonicalFrame(*(x.to(*args, **kwargs) for x in (self.s, self.R, self.T)))


def rotation_matrix(quaternion: Any) -> Any:
    """Rotations (..., 3, 3) of quaternions (..., 4) in the order (x, y, z, w), which are divided by
    their norm.
    """
    xp = namespace(quaternion)
    return xp.matrix(rotation_rows(*xp.parts(quaternion)))


def rotation_rows(x: Any, y: Any, z: Any, w: Any) -> list[tuple[Any, Any, Any]]:
    """The rows of :func:`rotation_matrix`, of numbers of NumPy, torch or Dr.Jit."""
    twice = 2 / (x * x + y * y + z * z + w * w)
    return [
        (1 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)),
        (twice * (x * y + z * w), 1 - twice * (x * x + z * z), twice * (y * z - x * w)),
        (twice * (x * z - y * w), twice * (y * z + x * w), 1 - twice * (x * x + y * y)),
    ]


def _pointed(x: Any, axis: Any, w: Any, level: float) -> Any:
    """``axis`` (..., 3), or the opposite, as the points x (..., P, 3) of weights w lie along it;
    third moments up to ``level`` are none.
    """
    m = namespace(x).module
    along = (x @ axis[..., None])[..., 0]
    skew = (along**3).mean(-1) if w is None else (w * along**3).sum(-1)
    far = abs(along) >= 0.5 * m.amax(abs(along), -1)[..., None]
    first = m.where(far & (far.cumsum(-1) == 1), along, 0).sum(-1)
    side = m.where(abs(skew) > level, skew, first)
    return m.where((side < 0)[..., None], -axis, axis)


def check_points(points: Any) -> None:
    """Raises InputError where ``points`` are no array of NumPy or torch (..., P, 3) of floats, or
    of no patch.
    """
    shape, kind = tuple(getattr(points, "shape", ())), getattr(points, "dtype", type(points))
    if len(shape) < 2 or shape[-1] != 3 or "float" not in str(kind):
        raise InputError(f"points of shape {shape}, {kind}; (..., points, 3) of floats is needed")
    if 0 in shape[:-2]:
        raise InputError(f"points of shape {shape}; one patch or more is needed")


def of_points(points: Any, name: str, given: Any) -> Any:
    """What is ``given`` of each of the ``points`` (..., P, 3), a "mask" or "weights", as an array
    (..., P) like theirs; None stays. Raises InputError, also for a mask that is not of bool.
    """
    if given is None:
        return None
    xp, shape = namespace(points), tuple(points.shape[:-1])
    try:
        if not hasattr(given, "shape") or namespace(given) is not xp:
            given = xp.module.asarray(given, device=points.device)
        array = xp.module.broadcast_to(given, shape)
    except (TypeError, ValueError, RuntimeError):
        array = None
    kinds = ("bool",) if name == "mask" else ("float", "int", "bool")
    if array is None or not any(kind in str(array.dtype) for kind in kinds):
        found = (
            f"shape {tuple(getattr(given, 'shape', ()))}, {getattr(given, 'dtype', type(given))}"
        )
        raise InputError(f"{name} of {found}; {shape} of {kinds[0]} is needed")
    return array


def _check(points: Any, mask: Any, s: Any, weighed: Any) -> None:
    m = namespace(points).module
    bad = ~((s > 1e-12 * m.amax(abs(points), (-1, -2))) & m.isfinite(s))
    bad = bad if weighed is None else bad | ~weighed
    if not bad.any():
        return
    at = tuple(np.argwhere(bad.tolist())[0].tolist())
    name = f"patch {at[0] if len(at) == 1 else at}" if at else "the patch"
    count = int(mask[at].sum()) if mask is not None else points.shape[-2]
    if count == 0:
        raise InputError(f"{name} has no points")
    if not m.isfinite(points[at]).all():
        raise InputError(f"{name} has points that are not finite")
    if weighed is not None and not weighed[at]:
        raise InputError(f"{name} has weights that are negative, not finite, or all 0")
    raise InputError(f"{name}: its {count} points coincide")
