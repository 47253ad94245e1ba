"""Post-processing of drapes: vertices are pushed out of the body."""

from concurrent.futures import ThreadPoolExecutor

import torch

from .charts import SparseMatrix
from .collision import Collider
from .remesh import neighbour_mean

CLEARANCE = 0.003  # [m] from the body
SKIN = 0.006  # [m]; farther from the body's surface no vertex is looked for but around those that were pushed
REACH = 0.08  # [m]; vertices deeper in the body than this stay there


def pushed_out(vertices, faces, bodies, body_faces, clearance=CLEARANCE, rounds=5, smoothing=4):
    """Vertices (T, N, 3) [m] moved out of the bodies (T, V, 3), to ``clearance`` [m] from them; faces (F, 3), body_faces (B, 3).

    The pushes, not the surface, are smoothed over the mesh, ``smoothing`` times, so that no fold is lost and none made; what that leaves
    inside is pushed again, unsmoothed from the third of at most ``rounds`` rounds on. Most vertices are far from the body, and to learn no
    more than that is quick: the first round looks for those near its surface, the others, among those that were pushed, for deep ones.
    """
    mean = SparseMatrix(neighbour_mean(faces.cpu().numpy(), vertices.shape[1]), vertices.device)

    def spread(push):
        for _ in range(smoothing):
            around = mean @ push
            push = torch.where(push.norm(dim=-1, keepdim=True) > around.norm(dim=-1, keepdim=True), push, around)
        return push

    def one(part):
        collider = Collider(body_faces, bodies[0])
        out = vertices[part].clone()
        for x, body in zip(out, bodies[part]):
            collider.follow(body)
            chosen = torch.arange(len(x), device=x.device)
            for turn in range(rounds):
                nearest, normal = collider.nearest(x[chosen], REACH if turn else SKIN)
                d = ((x[chosen] - nearest) * normal).sum(-1)
                near = (d < (clearance / 2 if turn else clearance)) & (normal != 0).any(-1)
                if not near.any():
                    break
                push = torch.zeros_like(x)
                push[chosen[near]] = (clearance - d[near])[:, None] * normal[near]
                push = spread(push) if turn < 2 else push
                x += push
                chosen = (push != 0).any(-1).nonzero()[:, 0]  # the others are clear, and stay where they are
        return out

    workers = min(torch.get_num_threads(), len(vertices)) if not vertices.is_cuda else 1
    parts = [slice(k * len(vertices) // workers, (k + 1) * len(vertices) // workers) for k in range(workers)]
    with ThreadPoolExecutor(workers) as pool:
        return torch.cat(list(pool.map(one, parts)))
