"""Post-processing of drapes: edges come back towards their lengths, and vertices are pushed out of
the body.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from onefit.body import ClosestSurface
from onefit.garment.charts import SparseMatrix
from onefit.garment.remesh import neighbour_mean

from .lengths import with_lengths

CLEARANCE = 0.003  # [m] from the body
SMOOTHING = 4  # times that pushes are smoothed
DEEPEST = 0.08  # [m]; vertices deeper in the body than this stay there


def post_processed(vertices, faces, edges, lengths, bodies, body_faces):
    """Vertices (T, N, 3) [m] after :func:`onefit.draping.lengths.with_lengths`, of the edges (E, 2)
    and their lengths at rest (E,) [m], and then :func:`pushed_out`.
    """
    return pushed_out(with_lengths(vertices, edges, lengths), faces, bodies, body_faces)


def spread(push, mean):
    """Pushes (N, 3) [m], smoothed over the mesh; none becomes shorter. ``mean``: a matrix (N, N)
    that takes the mean of each vertex's neighbours
    (:func:`onefit.garment.remesh.neighbour_mean`).
    """
    for _ in range(SMOOTHING):
        around = mean @ push
        push = torch.where(
            push.norm(dim=-1, keepdim=True) > around.norm(dim=-1, keepdim=True), push, around
        )
    return push


def pushed_out(vertices, faces, bodies, body_faces, rounds=5):
    """Vertices (T, N, 3) [m] moved out of the bodies (T, V, 3), to CLEARANCE from them; faces (F,
    3), body_faces (B, 3).

    The pushes, not the surface, are smoothed over the mesh, so that no fold is lost and none made;
    what that leaves inside is pushed again, unsmoothed from the third of at most ``rounds`` rounds
    on. That a vertex is not within CLEARANCE of the body's surface is quickly told; only beside
    those found inside, and among those that were pushed, deeper ones are looked for.
    """
    adjacency = neighbour_mean(faces.cpu().numpy(), vertices.shape[1])
    mean = SparseMatrix(adjacency, vertices.device)
    beside = lambda chosen: torch.as_tensor(
        np.unique(adjacency[chosen.cpu().numpy()].indices), device=vertices.device
    ).long()

    def pushes(x, surface, chosen=None):
        """(N, 3) [m]: to CLEARANCE, of those among all vertices that are nearer; or of those chosen
        that are nearer than half of it.
        """
        push, known = torch.zeros_like(x), torch.zeros(len(x), dtype=torch.bool, device=x.device)
        first, reach = chosen is None, CLEARANCE if chosen is None else DEEPEST
        chosen = torch.arange(len(x), device=x.device) if first else chosen
        while len(chosen):
            found = surface(x[chosen], reach)
            near = (found.distance < (CLEARANCE if first else CLEARANCE / 2)).nonzero()[:, 0]
            at = chosen[near]
            push[at] = found.point[near] + CLEARANCE * found.normal[near] - x[at]
            known[at] = True
            inside = at[found.distance[near] < 0]
            if not first or not len(inside):
                break
            chosen, reach = beside(inside), DEEPEST
            chosen = chosen[~known[chosen]]
        return push

    def one(part):
        surface = ClosestSurface(bodies[0], body_faces)
        out = vertices[part].clone()
        for x, body in zip(out, bodies[part]):
            surface.follow(body)
            chosen = None
            for turn in range(rounds):
                push = pushes(x, surface, chosen)
                if not push.any():
                    break
                push = spread(push, mean) if turn < 2 else push
                x += push
                chosen = push.any(-1).nonzero()[
                    :, 0
                ]  # the others are clear, and stay where they are
        return out

    workers = min(torch.get_num_threads(), len(vertices)) if not vertices.is_cuda else 1
    parts = [
        slice(k * len(vertices) // workers, (k + 1) * len(vertices) // workers)
        for k in range(workers)
    ]
    with ThreadPoolExecutor(workers) as pool:
        return torch.cat(list(pool.map(one, parts)))
