"""A garment's place on the standard body: units, axes and stand found by the distance to it, other
bodies and stands turned into it.

The paper's "Garment preprocessing" (supplement). Distances to the body tell whether a garment lies
on it; where it does not, other units, axes, places and the T-pose are tried on a few hundred of its
vertices, and the error names the one with which it would.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from onefit.body import skeleton, skinning
from onefit.contact import MADE
from onefit.objective import crossing_faces
from polyfit import mesh
from polyfit.errors import InputError, as_number

from .binding import (
    Binding,
    cotangent_laplacian,
    smoother,
    standard_body,
    standard_surface,
    surface_of,
)
from .reading import parts

_PUSHED_DEPTH = 0.03  # vertices inside the body by less than this are pushed out [m]
_HELD = 0.1  # of a garment's vertices that the body is near to, so that it holds the rest
_FARTHEST = 5.0  # of cloth from the body: beyond that nothing tells what it hangs on [m]
_PUSH_RADIUS = 0.02  # how far a vertex pushed out takes its neighbours with it [m]
UNITS = {
    1.0: "metres",
    0.01: "centimetres",
    0.001: "millimetres",
    0.1: "decimetres",
    0.0254: "inches",
    100.0: "hundreds of metres",
}
T_POSE = "T-pose"
_GROUND_OFFSET = np.array([0.0, 0.0, -0.82])  # from a world in which the body stands at z = 0 [m]
_PLACES = 10  # of the most likely, of which one must fit as check_place wants it
_TRIAL_VERTICES = 400  # vertices that places are tried on
_SMOOTHINGS = 30  # of cloth that passes through itself, at most


def up_of(path, up=None):
    """The axis that points up in the mesh of a file, if ``up`` does not say it: y in glTF, or z."""
    return up or ("y" if Path(path).suffix.lower() in (".glb", ".gltf") else "z")


@dataclass(frozen=True)
class Place:
    """How a mesh is brought to metres and OneFit's axes: the arguments of :func:`placed`, ``turn``
    in degrees, ``offset`` (3,) [m]. ``usual``: the axis that is up in its file where nothing is
    said.
    """

    scale: float = 1.0
    up: str = "z"
    turn: float = 0.0
    offset: Any = (0.0, 0.0, 0.0)
    usual: str = "z"

    def apply(self, V):
        """Vertices (N, 3) of the file, in metres and OneFit's axes."""
        return placed(V, self.scale, self.up, self.turn, self.offset)

    def back(self, V):
        """Vertices (N, 3) [m] as the file has them: the inverse of :meth:`apply`."""
        V = placed(np.asarray(V) - np.asarray(self.offset), turn=-self.turn)
        if self.up == "y":
            V = V[:, [0, 2, 1]] * (1, 1, -1)
        return V / self.scale


def placed(V, scale=1.0, up="z", turn=0.0, offset=(0.0, 0.0, 0.0)):
    """Vertices (N, 3) scaled to metres, turned from ``up`` ("z" or "y") to z up and by ``turn``
    [degrees] about z, then moved by ``offset`` [m].
    """
    if up not in ("y", "z"):
        raise InputError(f"up={up!r}; 'z' or 'y' is needed")
    if not 0 < as_number(scale) < np.inf:
        raise InputError(f"scale={scale!r}; more than 0 is needed")
    moved = np.array([as_number(x) for x in offset] if np.iterable(offset) else [])
    if moved.shape != (3,):
        raise InputError(f"offset={offset!r}; three numbers (x, y, z) are needed")
    if not np.isfinite([as_number(turn), *moved]).all():
        raise InputError(f"turn={turn!r}, offset={tuple(offset)}; finite numbers are needed")
    x, y, z = scale * np.asarray(V, dtype=np.float64).T
    if up == "y":
        y, z = -z, y
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1) + moved


def in_pose(body, pose):
    """``body`` standing in ``pose`` (24, 3) [rad]: its vertices, joints and rest pose."""
    maps = skinning.transforms(body, pose[None].to(body.vertices), body.vertices.new_zeros(1, 3))
    vertices, joints = (
        skinning.skin(body.vertices, body.blend_weights, maps)[0],
        skinning.posed_joints(body, maps)[0],
    )
    return replace(body, vertices=vertices, joints=joints, rest_pose=pose.to(body.rest_pose))


@lru_cache(maxsize=1)
def t_posed():
    """The standard body in the T-pose."""
    return in_pose(standard_body(), torch.zeros(len(skeleton.JOINTS), 3))


@lru_cache(maxsize=1)
def _t_surface():
    return surface_of(t_posed())


def misfit(surface, V):
    """How far vertices (N, 3) are from lying on the body [m]: the mean distance, and five times the
    mean depth of those inside.
    """
    d = surface(V, 1.0).distance
    return np.abs(d).mean() + 5 * np.maximum(-d, 0).mean()


@dataclass(frozen=True)
class Stand:
    """Another stand in which a garment may have been made: the body's ``surface`` there, what a
    garment is that was made for it, ``looks``, and what to ``give`` then, in Python or by
    ``flags``.
    """

    surface: Callable[..., Any]
    looks: str
    give: str
    flags: tuple[str, ...] = ()


def t_stand():
    """The :class:`Stand` of the standard body in the T-pose."""
    flags = (f"--made-for {T_POSE}",)
    return Stand(_t_surface(), "made for the T-pose", f"made_for='{T_POSE}'", flags)


def lowered_stand(surface=None, give="made_for=None (no --made-for)"):
    """The :class:`Stand` with lowered arms, in which bodies rest: of a body's ``surface`` there, by
    default the standard one's.
    """
    looks = "made for the stand with lowered arms"
    return Stand(surface or standard_surface(), looks, give)


class OffBody(InputError):
    """A garment does not lie on the body; ``why``: how it lies, in words."""

    def __init__(self, message, why=""):
        super().__init__(message)
        self.why = why


def check_place(V, surface, where, other=None, place=None):
    """Raises InputError, with a suggestion, where vertices (N, 3) [m] do not lie on the body of
    ``surface``, to which a :class:`Place` has brought them.

    They do if they are 15 cm from it on average at most, a tenth of them within 3 cm, for cloth
    hangs on something, at most 2 % of them more than 3 cm inside, and no other place or stand would
    fit much better: half the misfit where it is above 4 cm, 0.87 times of it for the ``other``
    :class:`Stand`, if any.
    """
    seen = V[np.linspace(0, len(V) - 1, min(_TRIAL_VERTICES, len(V))).astype(int)]
    d, own = surface(V, 1e9).distance, misfit(surface, seen)
    lies = _lies(d)
    there = misfit(other.surface, seen) if lies and other else np.inf
    stands = not (there < 0.87 * own and own - there > 0.005)
    if lies and stands and own < 0.04:
        return
    place = place or Place()
    scales = [place.scale] if lies else sorted({*UNITS, place.scale}, reverse=True)
    best = _best_place(place, place.back(seen), surface, scales, other)
    if not stands and (there < 0.04 or not (best and best[0] < 0.5 * there)):
        fits = f"{_mm(there)} from the body there, {_mm(own)} from it in the stand it is read in"
        give = _advice([other.give], other.flags)
        raise InputError(f"{where}: looks {other.looks} ({fits}): give {give}")
    if lies and not (best and best[0] < 0.5 * own):
        return
    size = " x ".join(f"{s:.3g}" for s in np.ptp(V, axis=0))
    deep = 100 * (d < -_PUSHED_DEPTH).mean()
    mean, nearest = np.abs(d).mean(), np.quantile(np.abs(d), _HELD)
    why = (
        f"{_mm(mean)} from it on average, {_mm(nearest)} where it is nearest, {deep:.0f} % of the"
        " vertices deep inside"
    )
    advice = f"it spans {size} m; the body is 1.63 m tall (z from -0.82 to 0.81), z up, faces -y"
    if best:
        advice = f"it looks like {best[1]}: give {best[2]}"
    raise OffBody(f"{where}: does not lie on the body: {why}; {advice}", why)


def _lies(distances):
    """Whether vertices at such ``distances`` (N,) [m] from a body lie on it, and hang on it."""
    near = np.abs(distances)
    held = np.quantile(near, _HELD) < _PUSHED_DEPTH
    return held and near.mean() < 0.15 and (distances < -_PUSHED_DEPTH).mean() <= 0.02


def check_reach(V, surface, where):
    """Raises InputError where any of the cloth's vertices (N, 3) [m] lies far from the body of
    ``surface``.
    """
    far = np.abs(surface(V, 1e9).distance) > _FARTHEST
    if far.any():
        at = ", ".join(f"{x:.3g}" for x in V[far.argmax()])
        raise InputError(
            f"{where}: {far.sum()} of {len(V)} vertices of the cloth lie more than"
            f" {_FARTHEST:g} m from the body, the first at ({at}) m; delete them, or put them back"
        )


def _mm(distance):
    return (
        f"{1000 * distance:.0f} mm"
        if distance < 0.1
        else f"{distance:.2f} m"
        if distance < 1
        else f"{distance:,.0f} m"
    )


def _best_place(place, seen, surface, scales, other):
    """``(misfit [m], what it looks like, what to give)`` of the plainest place in which the
    vertices, as their file has them, lie on a body, or None. What ``place`` has beside what is
    usual is told, too, if only to leave it out.
    """
    bodies = [(surface, None)] + ([(other.surface, other)] if other else [])
    found = []
    turns, given = sorted({0, 180, place.turn}), np.asarray(place.offset, dtype=np.float64)
    for scale, up, turn in product(scales, ("z", "y"), turns):
        V = placed(seen, scale, up, turn)
        if not 0.15 < np.ptp(V, axis=0).max() < 2.3:
            continue
        # what was given is as plain as what is usual
        plain = (scale in (1, place.scale), up in (place.usual, place.up), turn in (0, place.turn))
        for at, pose in bodies:
            offsets = (0, np.zeros(3)), (1, _GROUND_OFFSET), (2, _offset(V, at)), (0, given)
            for moved, offset in offsets:
                worse = plain.count(False) + 0.5 * (pose is not None) + moved
                value = misfit(at, V + offset)
                found.append((value * 1.25**worse, value, scale, up, turn, pose, offset))
    if not found:
        return None
    found.sort(key=lambda f: f[0])
    for _, value, scale, up, turn, pose, offset in found[:_PLACES]:
        d = (pose.surface if pose else surface)(placed(seen, scale, up, turn, offset), 1e9).distance
        if value <= 0.12 and _lies(d):
            break
    else:
        return None
    looks, give, flags = [], [], []
    if scale != 1 or place.scale != 1:
        looks.append(UNITS.get(scale, f"units of {scale:g} m"))
        give.append(f"scale={scale:g}")
        flags.append(f"--scale {scale:g}")
    if up != place.usual or place.up != place.usual:
        looks.append(f"{up} up")
        give.append(f"up='{up}'")
        flags.append(f"--up {up}")
    if turn or place.turn:
        looks.append("facing backwards" if turn else "facing forward")
        give.append(f"turn={turn}")
        flags.append(f"--turn {turn}")
    if pose:
        looks.append(pose.looks)
        give.append(pose.give)
        flags.extend(pose.flags)
    if offset.any() or np.any(place.offset):
        known = {(0.0, 0.0, 0.0): "in its place"}
        known[tuple(_GROUND_OFFSET)] = "on a body that stands on the ground"
        looks.append(known.get(tuple(offset), "in another place"))
        give.append(f"offset=({', '.join(f'{o:g}' for o in offset)})")
        flags.append(f"--offset {' '.join(f'{o:g}' for o in offset)}")
    same = scale == place.scale and up == place.up and turn == place.turn and not pose
    same &= np.array_equal(offset, place.offset)
    return None if same else (value, ", ".join(looks), _advice(give, flags))


def _advice(give, flags):
    """What to ``give`` in Python, or by ``flags``, where there are some."""
    return ", ".join(give) + (f", or {' '.join(flags)}" if flags else "")


def _offset(V, surface):
    """The translation (3,) [m], in centimetres, with which vertices fit the body best."""
    low, high = surface.vertices[:, 2].min(), surface.vertices[:, 2].max()
    centre = (V.min(axis=0) + V.max(axis=0)) / 2
    start = np.array([-centre[0], -0.03 - centre[1], 0])
    half = np.ptp(V[:, 2]) / 2
    heights = np.arange(low + half, max(high - half, low + half) + 0.04, 0.04) - centre[2]
    best = min((misfit(surface, V + start + [0, 0, h]), h) for h in heights)[1]
    offset = np.round(start + [0, 0, best], 2)
    step, value = 0.02, misfit(surface, V + offset)
    while step >= 0.01:
        tried = [
            (misfit(surface, V + offset + step * sign * e), sign, k)
            for k, e in enumerate(np.eye(3))
            for sign in (-1, 1)
            if k
        ]
        least, sign, k = min(tried)
        if least < value:
            offset, value = np.round(offset + step * sign * np.eye(3)[k], 2), least
        else:
            step /= 2
    return offset + 0.0


def inward(V, F, surface):
    """Which faces (F,) of V (N, 3) [m] are of a part whose normals, in most of it, are against
    those of the nearest points of the body's ``surface``.
    """
    part = parts(F)
    found = surface(V)
    agree = (found.normal * mesh.vertex_normals(V, F)).sum(axis=1)
    agree /= 1 + (found.distance / 0.02) ** 2
    return (np.bincount(part, mesh.areas(V, F) * agree[F].mean(axis=1)) < 0)[part]


def to_standard(V, F, made_for, loose=False, smooth=True):
    """Vertices (N, 3) [m] of a garment made on the body ``made_for``, in the stand and shape of the
    standard body.

    The paper displaces each vertex by the difference of its nearest body vertex between the two
    bodies. That shears sleeves where the stand differs, so the stand is changed by skinning with
    the garment's smoothed blend weights, and the rest, the difference in shape, by the displacement
    (smoothed too); one step of Laplacian smoothing follows. Of ``loose`` garments, which do not
    follow the legs, the legs' pose is left as it is. Without ``smooth`` that step is left out, for
    cloth that hangs in folds.
    """
    standard = standard_body()
    pose = standard.rest_pose.clone()
    if loose:
        legs = [
            skeleton.INDEX[f"{side}_{joint}"]
            for side in ("left", "right")
            for joint in ("hip", "knee", "ankle", "foot")
        ]
        pose[legs] = made_for.rest_pose[legs]
    weights = Binding(V, F, surface_of(made_for)).blend_weights(made_for.blend_weights.numpy())
    maps = skinning.transforms(made_for, pose[None], torch.zeros(1, 3))
    V = (
        skinning.skin(
            torch.as_tensor(V, dtype=torch.float32),
            torch.as_tensor(weights, dtype=torch.float32),
            maps,
        )[0]
        .double()
        .numpy()
    )
    stands = in_pose(made_for, pose)
    target = standard if not loose else in_pose(standard, pose)
    difference = _counterpart(stands, target) - stands.vertices.numpy()
    V = V + Binding(V, F, surface_of(stands)).displacement(difference)
    if not smooth:
        return V
    return 0.5 * (V + mesh.neighbour_mean(F, len(V), boundary_apart=True) @ V)


def _counterpart(source, target):
    """Where the vertices of the body ``source`` (V, 3) lie on the body ``target``, in the same
    stand [m].

    Bodies of the same kind have the same vertices. Otherwise the source is warped through the
    joints (thin-plate spline), then drawn to the nearest points of the target that face the same
    way, over shorter and shorter lengths.
    """
    if source.kind == target.kind and source.vertices.shape == target.vertices.shape:
        return target.vertices.numpy().astype(np.float64)
    from scipy.interpolate import RBFInterpolator

    F = source.faces.numpy()
    rest = source.vertices.numpy().astype(np.float64)
    a, b = source.joints.numpy().astype(np.float64), target.joints.numpy().astype(np.float64)
    x = rest + RBFInterpolator(a, b - a, kernel="thin_plate_spline", smoothing=1e-4)(rest)
    surface = surface_of(target)
    for length in (0.08, 0.04, 0.02, 0.01):
        found = surface(x)
        area, stiffness = cotangent_laplacian(x, F)
        facing = (found.normal * mesh.vertex_normals(x, F)).sum(axis=1)
        x = x + smoother(area * np.clip(facing, 1e-3, 1), stiffness, length)(found.point - x)
    return surface(x).point.astype(np.float64)


def pushed_out(V, F, where="garment"):
    """``(vertices (N, 3), sentences)``: vertices up to 3 cm inside the standard body are taken out
    of it, with the faces that it pokes through and their neighbours. Raises InputError for more
    than 2 % deeper ones.
    """
    surface = standard_surface()
    d = surface(V).distance
    if (d >= 0).all():
        return V, ()
    if (deep := (d < -_PUSHED_DEPTH).mean()) > 0.02:
        raise InputError(
            f"{where}: {100 * deep:.0f} % of the vertices are more than"
            f" {100 * _PUSHED_DEPTH:.0f} cm inside the body"
        )
    area, stiffness = cotangent_laplacian(V, F)
    out = V
    for _ in range(8):
        found, middle = surface(out), surface(out[F].mean(axis=1))
        move = np.where(
            found.distance[:, None] < 0, (MADE - found.distance)[:, None] * found.normal, 0
        )
        poked = np.flatnonzero(middle.distance < 0)
        if not move.any() and not len(poked):
            break
        move[F[poked].ravel()] += (
            np.repeat((MADE - middle.distance[poked])[:, None] * middle.normal[poked], 3, axis=0)
            / 2
        )
        out = out + smoother(area * np.where(move.any(axis=1), 1.0, 0.1), stiffness, _PUSH_RADIUS)(
            move
        )
    for _ in range(8):
        found = surface(out)
        out = np.where((found.distance < MADE / 4)[:, None], found.point + MADE * found.normal, out)
    return out, (
        f"pushed {(d < 0).sum()} vertices out of the body, by up to {-1000 * d.min():.1f} mm",
    )


_correspondences: dict = {}


def standard_on(body):
    """Where the standard body's vertices (V, 3) [m] lie on ``body``, which rests in the standard
    stand.

    For bodies of another kind the correspondence is found on the first body of that kind seen, and
    kept for its other shapes.
    """
    standard = standard_body()
    vertices = body.vertices.detach().cpu().double().numpy()
    if body.kind == standard.kind and body.vertices.shape == standard.vertices.shape:
        return vertices
    key = body.kind, len(vertices), int(body.faces.sum()), int(body.faces[:, 0].sum())
    if key not in _correspondences:
        body = body.to("cpu")
        found = surface_of(body)(_counterpart(standard, body))
        _correspondences[key] = body.faces.numpy()[found.face], found.barycentric.astype(np.float64)
    corners, barycentric = _correspondences[key]
    return np.einsum("nk,nkd->nd", barycentric, vertices[corners])


def untangled(V, F):
    """Vertices ``V`` (N, 3) [m] of cloth with faces ``F`` (F, 3) whose layers came through each
    other, when it was brought to another body or over another garment: smoothed there, as long as
    it takes.
    """
    mean = mesh.neighbour_mean(F, len(V), boundary_apart=True)
    for _ in range(_SMOOTHINGS):
        through = crossing_faces(V, F)
        if not len(through):
            break
        near = np.zeros(len(V))
        near[F[through]] = 1
        share = np.minimum(1, near + mean @ near)[:, None] / 2
        V = V + share * (mean @ V - V)
    return V
