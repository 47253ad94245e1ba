"""Post-processing of drapes: vertices are pushed out of the body."""

from concurrent.futures import ThreadPoolExecutor

import torch

from polyfit import mesh

from .collision import Collider

CLEARANCE = 0.003  # [m] from the body
REACH = 0.08  # [m]; vertices deeper in the body than this stay there


def pushed_out(vertices, faces, bodies, body_faces, clearance=CLEARANCE, rounds=5, smoothing=4):
    """Vertices (T, N, 3) [m] moved out of the bodies (T, V, 3), to ``clearance`` [m] from them; faces (F, 3), body_faces (B, 3).

    The pushes, not the surface, are smoothed over the mesh, ``smoothing`` times, so that no fold is lost and none made; what that leaves
    inside is pushed again, unsmoothed from the third of at most ``rounds`` rounds on.
    """
    edges = torch.as_tensor(mesh.edges_of(faces.cpu().numpy())[0], device=vertices.device)
    both = torch.cat([edges, edges.flip(1)])
    count = torch.bincount(both[:, 0], minlength=vertices.shape[1])[:, None].clamp(min=1)

    def spread(push):
        for _ in range(smoothing):
            mean = torch.zeros_like(push).index_add(0, both[:, 0], push[both[:, 1]]) / count
            push = torch.where(push.norm(dim=-1, keepdim=True) > mean.norm(dim=-1, keepdim=True), push, mean)
        return push

    def one(part):
        collider = Collider(body_faces, bodies[0])
        out = vertices[part].clone()
        for x, body in zip(out, bodies[part]):
            chosen = torch.arange(len(x), device=x.device)
            for turn in range(rounds):
                nearest, normal = collider.nearest(x[chosen][None], body[None], REACH)
                d = ((x[chosen] - nearest[0]) * normal[0]).sum(-1)
                near = (d < clearance) & (normal[0] != 0).any(-1)
                if not near.any():
                    break
                push = torch.zeros_like(x)
                push[chosen[near]] = (clearance - d[near])[:, None] * normal[0][near]
                push = spread(push) if turn < 2 else push
                x += push
                chosen = (push != 0).any(-1).nonzero()[:, 0]  # the others are clear, and stay where they are
        return out

    workers = min(torch.get_num_threads(), len(vertices)) if not vertices.is_cuda else 1
    parts = [slice(k * len(vertices) // workers, (k + 1) * len(vertices) // workers) for k in range(workers)]
    with ThreadPoolExecutor(workers) as pool:
        return torch.cat(list(pool.map(one, parts)))
