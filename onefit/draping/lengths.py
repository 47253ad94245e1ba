"""Post-processing of drapes: edges come back towards their lengths at rest.

A network says what cloth does on average, and a mean of folds has shorter edges than cloth. What
brings the lengths back makes its folds deeper.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
import torch

from onefit.body.quietwarp import warp

ROUNDS = 20
STEP = 0.6  # of Jacobi's; with 1 the corrections of neighbouring edges add up to too much
RADIUS = 0.97  # spectral radius of a round, as the acceleration takes it to be


@lru_cache(maxsize=1)
def _kernel():
    wp = warp()

    @wp.kernel
    def towards_rest(
        x: wp.array2d(dtype=wp.vec3),  # (T, N): now
        before: wp.array2d(dtype=wp.vec3),  # (T, N): a round ago; receives what is next
        first: wp.array(dtype=int),  # (N + 1,): the edges at vertex v are first[v]:first[v + 1]
        other: wp.array(dtype=int),
        length: wp.array(dtype=float),
        step: float,
        ahead: float,
    ):
        t, v = wp.tid()
        here = x[t, v]
        pull = wp.vec3(0.0, 0.0, 0.0)
        for k in range(first[v], first[v + 1]):
            edge = x[t, other[k]] - here
            pull += (1.0 - length[k] / wp.max(wp.length(edge), 1.0e-9)) * edge
        count = wp.max(float(first[v + 1] - first[v]), 1.0)
        old = before[t, v]
        before[t, v] = old + ahead * (here + step / count * pull - old)

    return wp, towards_rest


def with_lengths(vertices, edges, lengths, rounds=ROUNDS):
    """Vertices (T, N, 3) [m], moved so that the edges (E, 2) come nearer to ``lengths`` (E,) [m].

    Each round is one of Jacobi's for the sum of (\\|e\\| - length)^2, accelerated by Chebyshev's
    polynomials (Wang 2015, "A Chebyshev semi-iterative approach for accelerating projective and
    position-based dynamics"). A few rounds mend what is wrong over some centimetres, and leave
    where the cloth hangs.
    """
    wp, towards_rest = _kernel()
    edges = edges.cpu().numpy()
    start, end = np.concatenate([edges, edges[:, ::-1]]).T
    order = np.argsort(start, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(start, minlength=vertices.shape[1]))])
    device = wp.device_from_torch(vertices.device)
    on_device = lambda x, dtype: wp.array(x, dtype=dtype, device=device)
    links = (
        on_device(first.astype(np.int32), int),
        on_device(end[order].astype(np.int32), int),
        on_device(np.tile(lengths.cpu().numpy(), 2)[order].astype(np.float32), float),
    )

    def one(part):
        now = part.detach().float().clone().contiguous()
        now, before = (wp.from_torch(x, dtype=wp.vec3) for x in (now, now.clone()))
        ahead = 1.0
        for turn in range(rounds):
            if turn:
                ahead = 2 / (2 - RADIUS**2) if turn == 1 else 4 / (4 - RADIUS**2 * ahead)
            wp.launch(towards_rest, now.shape, [now, before, *links, STEP, ahead], device=device)
            now, before = before, now
        return wp.to_torch(now)

    workers = 1 if vertices.is_cuda else max(1, min(torch.get_num_threads(), len(vertices)))
    with ThreadPoolExecutor(workers) as pool:
        return torch.cat(list(pool.map(one, vertices.tensor_split(workers)))).to(vertices)
