"""How the charts of the patches are joined: a partition of unity for jets, and planes through the
drifts of the patches around.
"""

import numpy as np
import scipy.sparse as sp
import torch

from polyfit.patches import shares

from .samples import basis

# A chart's weight falls to zero at this distance from its middle, in units of the patch's radius.
_CHART_RADIUS = 1.3
# A patch that fills less of its chart's disc than this share is a strip (a hem turned in), of which
# networks know little: its neighbours have more say.
_STRIP_SHARE = 0.2
# Width of the Gaussian by which patches share their drift, in distances of neighbours.
DRIFT_WIDTH = 1.0
SLOPE_RIDGE = 1e-2  # weight that holds the slopes of the drifts' plane to zero
# [m]; least and greatest displacement that a drift of 1 stands for
_DRIFT_RANGE = 0.005, 0.1
_SKIN_DISTANCE = 0.005  # [m]; a patch much nearer to the body than this lies on it


def blend_matrix(p, vertices, frame, order):
    """The sparse matrix (N, K A) from changes of the C_k to displacements of the ``vertices``
    (N, 3) [m]: a partition of unity of the charts ``frame`` (K,) of the patches ``p``.
    """
    K, count = len(frame.T), len(vertices)
    own = p.vertex_patch[:count]
    near = sp.coo_matrix((np.ones(len(p.neighbours)), p.neighbours.T), (K, K)).tocsr()
    near = ((near + near.T + sp.identity(K)) > 0).tocsr()
    candidates = near[own].tocoo()  # (N, K): own patch and those that it meets
    row, patch = candidates.row, candidates.col
    x = (
        np.einsum(
            "ei,eij->ej",
            vertices[row] - frame.T.numpy()[patch],
            frame.R.numpy()[patch],
        )
        / frame.s.numpy()[patch, None]
    )
    r = np.linalg.norm(x[:, :2], axis=1) / _CHART_RADIUS
    near = np.where(
        patch == own[row],
        np.maximum(1 - r**2, 0.02),
        np.maximum(1 - r**2 - np.maximum(np.abs(x[:, 2]) - 0.5, 0), 0),
    )
    area = np.bincount(p.entry_patch, p.entry_weight) / (
        np.pi * frame.s.numpy() ** 2
    )  # as a share of the chart's disc
    weight = (near * np.minimum(area / _STRIP_SHARE, 1)[patch]) ** 3
    kept, share = shares(row, weight, count)
    row, patch, x = row[kept], patch[kept], x[kept]
    b = share[:, None] * basis(x[:, :2], order)
    A = b.shape[1]
    columns = patch[:, None] * A + np.arange(A)
    return sp.csr_matrix((b.ravel(), (np.repeat(row, A), columns.ravel())), (count, K * A))


def drift_planes(pairs, frame):
    """The matrix (3 K, K) from values of the patches to the planes a + b u + c v of the charts:
    least squares over the patches around, two rings of the ``pairs`` (B, 2) that meet, weighted by
    a Gaussian of their distance; slopes are held by a trace of a ridge.
    """
    R, s, T = (x.numpy() for x in (frame.R, frame.s, frame.T))
    ring = sp.coo_matrix((np.ones(len(pairs)), pairs.T), (len(T), len(T))).tocsr()
    ring = ring + ring.T + sp.identity(len(T))
    near = (ring @ ring).tocsr()
    length = (
        np.median(np.linalg.norm(T[pairs[:, 0]] - T[pairs[:, 1]], axis=1)) if len(pairs) else 1.0
    )
    rows, columns, values = [], [], []
    for k in range(len(T)):
        around = near[k].indices
        x = (T[around] - T[k]) @ R[k] / s[k]
        b = np.column_stack([np.ones(len(around)), x[:, :2]])
        w = np.exp(-((np.linalg.norm(T[around] - T[k], axis=1) / (DRIFT_WIDTH * length)) ** 2))[
            :, None
        ]
        gram = (b * w).T @ b + np.diag([0, SLOPE_RIDGE, SLOPE_RIDGE]) * w.sum()
        values.append(np.linalg.solve(gram, (b * w).T).ravel())
        rows.append(np.repeat(3 * k + np.arange(3), len(around)))
        columns.append(np.tile(around, 3))
    return sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (3 * len(T), len(T)),
    )


def looseness_of(p, surface):
    """Least, mean and greatest distance of each patch's vertices from the body's ``surface``, as
    asinh(d / _SKIN_DISTANCE): (K, 3).
    """
    distance = surface(p.vertices).distance
    order = np.argsort(p.vertex_patch, kind="stable")
    count = np.bincount(p.vertex_patch)
    first = np.cumsum(count) - count
    least, total, greatest = (
        ufunc.reduceat(distance[order], first) for ufunc in (np.minimum, np.add, np.maximum)
    )
    return torch.as_tensor(
        np.arcsinh(np.stack([least, total / count, greatest], 1) / _SKIN_DISTANCE),
        dtype=torch.float32,
    )


def drift_scale(looseness):
    """How far a patch of ``looseness`` (K, 3) goes with a drift of 1, (K,) [m]: its mean distance
    from the standard body, within :data:`_DRIFT_RANGE`.
    """
    return np.clip(_SKIN_DISTANCE * np.sinh(looseness[:, 1].double().numpy()), *_DRIFT_RANGE)
