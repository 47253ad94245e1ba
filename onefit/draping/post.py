"""Post-processing of drapes: edges come back towards their lengths, and vertices are pushed out of
the body. On the CPU, a frame in one compiled loop.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from onefit.body import ClosestSurface
from onefit.physics.sheet import samples
from polyfit import mesh

ROUNDS = 12  # of the lengths
STEP = 0.9  # share of a Jacobi step: with 1, corrections of neighbouring edges may overshoot
RADIUS = 0.98  # spectral radius of a round, as the acceleration takes it to be
CLEARANCE = 0.003  # [m] from the body
PUSHES = 5  # rounds
SMOOTHED = 2  # of these, whose pushes are smoothed
SMOOTHING = 4  # times
DEEPEST = 0.08  # [m]; vertices deeper in the body than this stay there
SPACING = 0.025  # [m] of the points of faces that are looked at beside the vertices
FACE_DEEPEST = 0.03  # [m], for these


def post_processed(vertices, faces, lengths, bodies, body_faces):
    """Vertices (T, N, 3) [m] after :func:`with_lengths` and :func:`pushed_out`; ``lengths``: at
    rest, of the edges as :func:`polyfit.mesh.edges_of` has them.
    """
    edges = mesh.edges_of(faces.cpu().numpy())[0]
    return pushed_out(with_lengths(vertices, edges, lengths), faces, bodies, body_faces)


def with_lengths(vertices, edges, lengths, rounds=ROUNDS):
    """Vertices (T, N, 3) [m], moved so that the ``edges`` (E, 2) come nearer to ``lengths`` (E,)
    [m].

    A network says what cloth does on average, and a mean of folds has shorter edges than cloth: its
    folds become deeper. A few rounds mend errors that span about ten edges, and hardly move the
    cloth as a whole.
    """
    from . import kernels  # compiled at the first use

    wp, count = kernels.wp, vertices.shape[1]
    edges, degree = np.asarray(edges), np.bincount(np.ravel(edges), minlength=count)
    arguments = [
        wp.array(edges, dtype=int, ndim=2, device="cpu"),
        wp.array(np.asarray(lengths), dtype=float, device="cpu"),
        wp.array(degree, dtype=float, device="cpu"),
        rounds,
        STEP,
        RADIUS,
    ]

    def frames(part):
        work = [wp.empty(count, dtype=wp.vec3, device="cpu") for _ in range(2)]
        for x in part:
            x = wp.from_torch(x, dtype=wp.vec3)
            wp.launch(kernels.lengths_restored, 1, [*arguments, x, *work], device="cpu")

    return _in_threads(frames, vertices)


def pushed_out(vertices, faces, bodies, body_faces, rounds=PUSHES, reach=CLEARANCE):
    """Vertices (T, N, 3) [m] moved out of the bodies (T, V, 3), to CLEARANCE from them; faces (F,
    3), body_faces (B, 3).

    The pushes, not the surface, are smoothed over the mesh, so that no fold is lost and none made;
    what that leaves inside is pushed again, unsmoothed from the third of at most ``rounds`` rounds
    on. That a vertex is not within ``reach`` [m] of the body's surface is quickly told; only beside
    those found inside, and among those that were pushed, deeper ones are looked for. Points of the
    faces, SPACING from each other, push the face's corners.
    """
    from . import kernels  # compiled at the first use

    wp, count = kernels.wp, vertices.shape[1]
    edges = mesh.edges_of(faces.cpu().numpy())[0]
    start, end = np.concatenate([edges, edges[:, ::-1]]).T
    first = np.concatenate([[0], np.cumsum(np.bincount(start, minlength=count))])
    other = end[np.argsort(start, kind="stable")]
    corners, weights = samples(vertices[0].cpu().numpy(), faces.cpu().numpy(), SPACING)
    settings = [rounds, SMOOTHED, SMOOTHING, CLEARANCE, reach, DEEPEST, FACE_DEEPEST]
    arguments = [*(wp.array(a, dtype=int, device="cpu") for a in (first, other))]
    arguments += [wp.array(corners, dtype=int, ndim=2, device="cpu")]
    arguments += [wp.array(weights, dtype=float, ndim=2, device="cpu"), *settings]

    def frames(part, bodies):
        surface = ClosestSurface(bodies[0], body_faces.cpu())
        work = [
            wp.empty(count, dtype=t, device="cpu") for t in (wp.vec3, wp.vec3, wp.int32, wp.int32)
        ]
        for x, body in zip(part, bodies):
            surface.follow(body)
            x = wp.from_torch(x, dtype=wp.vec3)
            arrays = [surface.of_kernels, *arguments, x, *work]
            wp.launch(kernels.pushed_out, 1, arrays, device="cpu")

    return _in_threads(frames, vertices, bodies.cpu())


def _in_threads(frames, vertices, *more):
    """A copy of the vertices (T, N, 3), changed by ``frames``: each thread has some of them, with
    their share of the tensors ``more``.
    """
    out = vertices.detach().float().cpu().clone()
    workers = max(1, min(torch.get_num_threads(), len(out)))
    parts = zip(*(x.tensor_split(workers) for x in (out, *more)))
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda part: frames(*part), parts))
    return out.to(vertices)
