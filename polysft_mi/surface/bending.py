"""How much displacements of vertices bend and shear a mesh at its edges. NumPy and SciPy only."""

import numpy as np
import scipy.sparse as sp


def hinges(points, faces):
    """What a height over a surface with vertices ``points`` (N, 3), in the same unit, bends at the
    H inner edges of the mesh with ``faces`` (F, 3): the pairs (H, 2) of vertices that lie across
    each, and the sparse J (H, N) that makes the bends. The sum of their squares is the integral of
    the squared curvature of a roll along the mesh's rows, up to three times that of others; no
    plane over a plane has any.

    After Bergou et al., "A Quadratic Bending Model for Inextensible Surfaces" (SGP 2006).
    """
    start, end, apex = (np.concatenate([faces[:, (k + j) % 3] for k in range(3)]) for j in range(3))
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high, apex = low[order], high[order], apex[order]
    first = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    quads = np.stack([low[first], high[first], apex[first], apex[first + 1]], 1)
    x = points[quads]

    def across(i, j, k):  # sine and cosine, times the lengths, of the angle at i
        a, b = x[:, j] - x[:, i], x[:, k] - x[:, i]
        return np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1)

    corners = (0, 1, 2), (0, 1, 3), (1, 0, 2), (1, 0, 3)
    (s2, c2), (s3, c3), (t2, d2), (t3, d3) = (across(*at) for at in corners)
    area = np.maximum(0.5 * (s2 + s3), 1e-12)
    (a, b), (c, d) = (
        [c / np.maximum(s, 1e-12) for s, c in pair]
        for pair in (((s2, c2), (s3, c3)), ((t2, d2), (t3, d3)))
    )
    rows = np.stack([c + d, a + b, -a - c, -b - d], 1)
    rows /= np.sqrt(area)[:, None]
    matrix = sp.csr_matrix(
        (rows.ravel(), (np.repeat(np.arange(len(quads)), 4), quads.ravel())),
        shape=(len(quads), len(points)),
    )
    return quads[:, 2:], matrix


def slides(edges, axes):
    """The sparse D (2E, 2N) that makes differences of displacements (Δu, Δv) along the ``edges``
    (E, 2), each in the axes of its first end: those of the other are turned onto them about the
    third. ``axes`` (N, 3, 3): columns of length 1.
    """
    a, b = edges.T
    turn = np.einsum("eij,eik->ejk", axes[a][..., :2], axes[b][..., :2])
    cosine, sine = turn[:, 0, 0] + turn[:, 1, 1], turn[:, 1, 0] - turn[:, 0, 1]
    length = np.maximum(np.hypot(cosine, sine), 1e-12)
    cosine, sine = cosine / length, sine / length
    each, one = np.arange(len(edges)), np.ones(len(edges))
    rows = np.concatenate([2 * each + k for k in (0, 1, 0, 0, 1, 1)])
    columns = [2 * a, 2 * a + 1, 2 * b, 2 * b + 1, 2 * b, 2 * b + 1]
    values = [one, one, -cosine, sine, -sine, -cosine]
    found = sp.csr_matrix(
        (np.concatenate(values), (rows, np.concatenate(columns))), (2 * len(edges), 2 * len(axes))
    )
    found.eliminate_zeros()
    return found
