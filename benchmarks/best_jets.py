"""The best that jets can do without relief: those of a template's patches, fitted to the true
vertices of each frame.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from polysft_mi.results import metrics
from polysft_mi.surface.atlas import Atlas

_STEPS, _LEAST_GAIN = 200, 1e-4  # of a search; the share that a step must gain for another one
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e3
_BENDING = 1e-9  # weight of the jets' bending, that holds what the vertices leave free


def best_jets(template, truth):
    """The jets of the template's order and patches, without relief, that come closest to the true
    vertices (T, N, 3) [m], at the vertices: (T, N, 3) [m].

    Each patch may turn and move and have any jet, and each vertex may slide along its own patch.
    What comes closest is kept of two starts: the patches laid over the truth, each by itself, and
    the frame before. The search is local, by Levenberg and Marquardt.
    """
    atlas = Atlas(dataclasses.replace(template, rest=np.zeros_like(template.rest)))
    previous, surfaces = None, []
    for V in np.asarray(truth, dtype=np.float64):
        starts = [_laid_over(atlas, V), *([] if previous is None else [previous])]
        previous = min((_refined(atlas, start, V) for start in starts), key=lambda x: x[1])[0]
        surfaces.append(atlas.surface(previous).vertices)
    return np.stack(surfaces)


def _laid_over(atlas, V):
    """The state whose patches, each moved as a whole, lie closest to the vertices V (N, 3)."""
    t = atlas.template
    turns, shifts = [], []
    for k, part in enumerate(atlas.entries):
        at = atlas.entry_vertex[part]
        start, end = t.vertices[at].mean(0), V[at].mean(0)
        turn = Rotation.align_vectors(V[at] - end, t.vertices[at] - start)[0]
        moved = atlas.moved(atlas.start, turn, end - turn.apply(start))
        turns.append(moved.rotation[k])
        shifts.append(moved.translation[k])
    return dataclasses.replace(
        atlas.start, rotation=Rotation.concatenate(turns), translation=np.array(shifts)
    )


def _refined(atlas, state, V):
    """(state, distance [m]): from a state of an :class:`Atlas` towards the vertices V (N, 3) [m],
    by Levenberg and Marquardt; each vertex may slide along its own patch.
    """
    distance = lambda s: metrics.rmse(atlas.surface(s).vertices, V)
    least, damping = distance(state), _FIRST_DAMPING
    for _ in range(_STEPS):
        try:
            there = _stepped(atlas, state, V, damping)
            now = distance(there)
        except (np.linalg.LinAlgError, ValueError):
            now = np.inf
        if now < least:
            gained = 1 - now / max(least, 1e-30)
            state, least, damping = there, now, damping / 5
            if gained < _LEAST_GAIN:
                break
        elif damping < _MOST_DAMPING:
            damping *= 10
        else:
            break
    return state, least


def _stepped(atlas, state, V, damping):
    """The state after one step towards the vertices V (N, 3): of the jets and motions, with the
    vertices' sliding eliminated, and of the sliding.
    """
    surface, scale = atlas.surface(state), atlas.template.scale
    missing, slide = V - surface.vertices, surface.offset_jacobian[:, :, :2]
    held = slide.transpose(0, 2, 1) @ slide + damping * scale**2 * np.eye(2)
    left = np.eye(3) - slide @ np.linalg.solve(held, slide.transpose(0, 2, 1))  # by sliding
    axes = [np.broadcast_to(axis, V.shape) for axis in np.eye(3)]
    columns = np.stack([atlas.global_columns(surface, axis) for axis in axes], 1)  # (N, 3, G)
    reduced = left @ columns
    bending = np.pad(_BENDING * len(V) * scale**2 * atlas.bending, (0, 6))
    prior = np.kron(np.eye(len(atlas)), bending)
    square = np.tensordot(columns, reduced, ((0, 1), (0, 1))) + prior
    right = np.einsum("nig,ni->g", reduced, missing)
    right -= prior @ np.pad(state.alpha, ((0, 0), (0, 6))).ravel()
    diagonal = np.diag(square) + 1e-4 * np.trace(square) / len(square)
    g = np.linalg.solve(square + damping * np.diag(diagonal), right)
    rest = (missing - columns @ g)[:, :, None]
    return state.after_step((g, np.linalg.solve(held, slide.transpose(0, 2, 1) @ rest)[..., 0]))
