"""Ease: a constant offset of a garment, in the rest space, that holds it out of the body where a network would push it in.

What networks do wrongly with garments that they have not seen is for the most part the same in all poses: a cuff lies two millimetres too
deep, whatever the arm does. A few frames of motions like those of training show it, and one offset for each vertex takes it away; no
frame costs anything for it.
"""

import numpy as np
import torch

from .charts import SparseMatrix
from .nearest import ClosestSurface
from .post import REACH, spread
from .remesh import neighbour_mean

MOTIONS = "idle", "walk", "run", "squat", "reach", "twist", "arms_up", "arms_crossed"  # of the kinds that networks are trained on
SECONDS, EVERY = 1.0, 6  # of each motion; one frame in so many is looked at
SHARE = 0.95  # of those frames in which a vertex is to lie far enough out
CLEARANCE = 0.007  # [m] from the body, where the garment was made with as much and skinning leaves as much


def ease(rest, faces, body, frames):
    """Offsets (N, 3) [m] of a garment's vertices ``rest`` (N, 3), with ``faces`` (F, 3), around the standard ``body``
    (:class:`onefit.body.Body`).

    ``frames``: for each frame, the vertices as the network drapes them and as plain skinning does (N, 3), and the body's (V, 3) [m]. A vertex
    should lie as far out of the body as in the rest pose and under plain skinning, whichever is less, or CLEARANCE where both are more.
    It is moved along the body's normal at rest, so far that this holds in SHARE of the frames, and its neighbours go along.
    """
    surface = ClosestSurface(body.vertices, body.faces)
    at_rest = surface(rest, REACH)
    missing = []
    for draped, skinned, vertices in frames:
        surface.follow(vertices)
        wanted = torch.minimum(at_rest.distance, surface(skinned, REACH).distance).clamp(max=CLEARANCE)
        missing.append((wanted - surface(draped, REACH).distance).clamp(min=0))
    missing = torch.as_tensor(np.quantile(torch.stack(missing).cpu().numpy(), SHARE, axis=0)).to(rest)[:, None]  # torch's has a largest size
    moved = (missing > 0) & (at_rest.face >= 0)[:, None]
    mean = SparseMatrix(neighbour_mean(faces.cpu().numpy(), len(rest)), rest.device)
    return spread(torch.where(moved, missing * at_rest.normal, 0.0), mean)
