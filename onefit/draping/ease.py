"""Ease: a constant offset of a garment, in the rest space, that holds it out of the body where a
network would push it in.

What networks do wrongly with garments that they have not seen is for the most part the same in all
poses: a cuff lies two millimetres too deep, whatever the arm does. A few frames of motions like
those of training show it, and one offset for each vertex takes it away; no frame costs anything for
it.
"""

from dataclasses import replace

import numpy as np
import torch

from onefit.body import ClosestSurface
from onefit.contact import DEEPEST, EASED, spread
from polyfit.mesh import neighbour_mean

MOTIONS = (
    "idle",
    "walk",
    "run",
    "squat",
    "reach",
    "twist",
    "arms_up",
    "arms_crossed",
)  # of the kinds that networks are trained on
SECONDS = 1.0  # [s] of each motion
FRAME_STEP = 6  # one frame in so many is looked at
_CLEAR_SHARE = 0.95  # of those frames in which a vertex is to lie far enough out
SMOOTHING = 4  # times
# [m]; of triangles with a longer side the centre is looked at, too: a limb comes through between
# their vertices
_LONG_SIDE = 0.035


def ease(rest, faces, body, frames):
    """Offsets (N, 3) [m] of a garment's vertices ``rest`` (N, 3), with ``faces`` (F, 3), around the
    standard ``body`` (:class:`onefit.Body`).

    ``frames``: for each frame, the vertices as the network drapes them and as plain skinning does
    (N, 3), and the body's (V, 3) [m]. A vertex should lie as far out of the body as in the rest
    pose and under plain skinning, whichever is less, or EASED where both are
    more. It is moved along the body's normal at rest, so far that this holds in _CLEAR_SHARE of the
    frames, and its neighbours go along. What the centre of a triangle with a side above _LONG_SIDE
    misses, all its vertices are moved by.
    """
    surface = ClosestSurface(body.vertices, body.faces)
    faces, count = faces.to(rest.device), len(rest)
    corners = rest[faces]
    coarse = faces[(corners - corners.roll(1, 1)).norm(dim=-1).amax(1) > _LONG_SIDE]
    places = lambda x: torch.cat([x, x[coarse].mean(1)])
    at_rest = surface(places(rest), DEEPEST)
    missing = []
    for draped, skinned, vertices in frames:
        surface.follow(vertices)
        of_skinning = surface(places(skinned), DEEPEST).distance
        wanted = torch.minimum(at_rest.distance, of_skinning).clamp(max=EASED)
        missing.append((wanted - surface(places(draped), DEEPEST).distance).clamp(min=0))
    missing = torch.as_tensor(
        np.quantile(torch.stack(missing).cpu().numpy(), _CLEAR_SHARE, axis=0)
    ).to(rest)  # torch's has a largest size
    missing = missing[:count].scatter_reduce(
        0, coarse.flatten(), missing[count:].repeat_interleave(3), "amax"
    )[:, None]
    at_rest = replace(at_rest, face=at_rest.face[:count], normal=at_rest.normal[:count])
    moved = (missing > 0) & (at_rest.face >= 0)[:, None]
    push = torch.where(moved, missing * at_rest.normal, 0.0).cpu().numpy()
    mean = neighbour_mean(faces.cpu().numpy(), len(rest))
    return torch.as_tensor(spread(push, mean, SMOOTHING)).to(rest)
