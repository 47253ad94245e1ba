"""The best that one jet can do: jets fitted to the true vertices of each frame."""

import dataclasses

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from polyfit import jets
from polyfit.jets import CanonicalFrame
from polysft_mi.errors import InputError
from polysft_mi.results import metrics
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.template import Template


def best_jets(template, truth):
    """The jets of the template's order that come closest to the true vertices (T, N, 3) [m], at the
    vertices: (T, N, 3) [m].

    A jet may turn and move, and each vertex may slide on it. What comes closest in the end, by
    least squares, is kept of three starts: the template's orientation laid over the truth, the
    truth's own principal axes, and the jet of the frame before. From the first two the order rises
    by and by; at once, it ends farther off. The search is local all the same.
    """
    orders = [*range(2, template.order, 2), template.order]
    atlases = [Atlas(_one_patch(template, n)) for n in orders]
    previous, surfaces = None, []
    for V in np.asarray(truth, dtype=np.float64):
        over = _rotation_onto(template.vertices, V) @ template.rotation[0]
        axes = CanonicalFrame.from_points(torch.as_tensor(V)).R.numpy()
        found = [
            _risen(atlases, _standing_in(atlases[0].template, V, turn), V)
            for turn in (over, _turned_to(over, axes[:, 2]))
        ]
        if previous is not None:
            found.append(_refined(atlases[-1], previous, V))
        previous = min(found, key=lambda x: x[1])[0]
        surfaces.append(atlases[-1].surface(previous).vertices)
    return np.stack(surfaces)


def _one_patch(template, order):
    """A template of one jet of ``order``, whose undeformed surface is that jet alone."""
    made = template
    if order != template.order:
        uv = template.texcoords
        made = Template.fit(template.vertices, template.faces, uv, order)
    if len(made) != 1:
        raise InputError(f"the template has {len(made)} patches; one jet is fitted to sheets alone")
    return dataclasses.replace(made, rest=np.zeros_like(made.rest))


def _risen(atlases, arrays, V):
    """(state, distance [m]) as of :func:`_refined` in the last atlas, by way of those before it;
    ``arrays`` are unknowns of the first.
    """
    for k, atlas in enumerate(atlases):
        if k:  # the same jet in the higher order
            lower = atlases[k - 1].template.alpha + arrays["delta_alpha"]
            alpha = np.pad(lower, ((0, 0), (0, atlas.template.alpha.shape[1] - lower.shape[1])))
            arrays = {**arrays, "delta_alpha": alpha - atlas.template.alpha}
        state, distance = _refined(atlas, atlas.state(arrays), V)
        arrays = atlas.arrays(state)
    return state, distance


def _rotation_onto(A, B):
    """The rotation (3, 3) that, with a translation, takes points A (N, 3) closest to B (N, 3)."""
    left, _, right = np.linalg.svd((B - B.mean(0)).T @ (A - A.mean(0)))
    return left @ np.diag([1, 1, np.linalg.det(left) * np.linalg.det(right)]) @ right


def _turned_to(rotation, axis):
    """The rotation (3, 3), turned the shortest way so that its third column lies along ``axis``
    (3,) or against it.
    """
    z = rotation[:, 2]
    axis = axis * (1 if axis @ z >= 0 else -1)
    v, c = np.cross(z, axis), z @ axis
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (np.eye(3) + K + K @ K / (1 + c)) @ rotation


def _standing_in(template, V, axes):
    """Unknowns, as ``params.npz`` names them: the least-squares jet of the heights of V (N, 3) over
    the first two columns of ``axes``.
    """
    rotation = template.rotation[0]
    y = (V - template.origin[0]) @ rotation / template.scale
    turn = rotation.T @ axes
    x = (y - y.mean(0)) @ turn
    alpha = jets.fit(torch.as_tensor(x), template.order).alpha.numpy()
    return {
        "delta_alpha": alpha - template.alpha,
        "delta_u": x[:, 0] - template.chart[:, 0, 0],
        "delta_v": x[:, 1] - template.chart[:, 0, 1],
        "delta_w": np.zeros(len(x)),
        "rotation": Rotation.from_matrix(turn).as_quat(),
        "translation": y.mean(0),
    }


def fitted(atlas, state, vertices, iterations=8, bending=1e-6):
    """The state of an atlas of one patch, from ``state`` on, whose vertices come closest to
    ``vertices`` (N, 3) [m, world], in the least-squares sense.

    Each vertex slides freely in its tangent plane, so that only distances along the normals count
    for the other unknowns. The relief stays as it is.
    """
    size = state.alpha.shape[1]
    prior = np.zeros((size + 6, size + 6))
    prior[:size, :size] = bending * len(vertices) * atlas.template.scale**2 * atlas.bending
    for _ in range(iterations):
        surface = atlas.surface(state)
        up = surface.up[0]
        missing = vertices - surface.vertices
        tangents = surface.offset_jacobian[:, :, :2]
        normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        rows = atlas.global_columns(surface, normal)
        # sliding makes rotations in the plane and shifts along it free: a little damping holds
        # them
        square = rows.T @ rows + prior
        right = rows.T @ (normal * missing).sum(1) - prior[:, :size] @ state.alpha[0]
        g = np.linalg.solve(
            square + 1e-6 * np.trace(square) / len(square) * np.eye(len(square)), right
        )
        rest = (
            missing - (surface.basis @ g[:size])[:, None] * up - surface.motion_jacobian @ g[size:]
        )
        square = tangents.transpose(0, 2, 1) @ tangents
        right = np.einsum("nka,nk->na", tangents, rest)[:, :, None]
        state = state.after_step((g, np.linalg.solve(square, right)[:, :, 0]))
    return state


def _refined(atlas, state, V, steps=60):
    """(state, distance [m]): Gauss-Newton from a state towards the vertices V (N, 3), with steps
    shortened where they gain more so.
    """
    distance = lambda s: metrics.rmse(atlas.surface(s).vertices, V)
    least = distance(state)
    for _ in range(steps):
        try:
            whole = fitted(atlas, state, V, iterations=1, bending=1e-9)
            tried = [
                (distance(x), x)
                for x in (state.extrapolated(whole, -back) for back in (0, 0.5, 0.75, 0.9, 0.97))
            ]
        except (np.linalg.LinAlgError, ValueError):
            break
        now, there = min(tried, key=lambda x: x[0] if np.isfinite(x[0]) else np.inf)
        if not now < least:
            break
        gained = 1 - now / max(least, 1e-30)
        state, least = there, now
        if gained < 1e-4:
            break
    return state, least
