"""Which vertices of a mesh are neighbours: the sparsity of every matrix over its vertices, and a
narrow ordering of them. NumPy and SciPy only.
"""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee


class Pattern:
    """Which vertices of the mesh share an edge, or are one of the ``further`` pairs (P, 2): the
    blocks of every matrix here, in the order of (row, column), and a narrow ordering.
    """

    def __init__(self, faces, edges, count, further=None):
        self.count, self.faces, self.edges = count, faces, edges
        a, b = (edges if further is None else np.concatenate([edges, further])).T
        each = np.arange(count)
        self._keys = np.unique(
            np.concatenate([each * count + each, a * count + b, b * count + a])
        )  # at a vertex of four triangles, pairs repeat
        self.row, self.column = np.divmod(self._keys, count)
        self.start = np.searchsorted(self.row, np.arange(count + 1))
        self.diagonal = self.find(each, each)
        # the U blocks on the diagonal of a symmetric matrix and above it, the others, and of which
        # of the first these are the transposed
        above = self.row <= self.column
        self.upper, self.lower = np.flatnonzero(above), np.flatnonzero(~above)
        self._half_keys = self._keys[self.upper]
        self.mirrored = self.find_half(self.column[self.lower], self.row[self.lower])
        #: (B,): 2 p, or 2 p + 1 where a block is the transposed of the p-th of the U
        self.half = np.empty(len(self._keys), dtype=np.int64)
        self.half[self.upper] = 2 * np.arange(len(self.upper))
        self.half[self.lower] = 2 * self.mirrored + 1
        self.half_edges = self.find_half(*edges.T)
        self.difference = sp.csr_matrix(  # of the edges' ends, (E, N)
            (
                np.tile([1.0, -1.0], len(edges)),
                (np.repeat(np.arange(len(edges)), 2), edges.ravel()),
            ),
            shape=(len(edges), count),
        )
        a, b = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
        first, second = faces[:, a], faces[:, b]
        triangle, pair = np.nonzero(first <= second)
        half = self.find_half(first[triangle, pair], second[triangle, pair])
        #: (N, F), (U, F): sums over the triangles at a vertex, and at a pair of corners
        self.corners, self.shares = (
            sp.csr_matrix((np.ones(len(k)), (k, f)), shape=(n, len(faces)))
            for k, f, n in (
                (faces.ravel(), np.repeat(np.arange(len(faces)), 3), count),
                (half, triangle, len(self.upper)),
            )
        )
        self.to_ends = self.difference.T.tocsr()  # sums over the edges at a vertex, with signs
        graph = sp.csr_matrix(
            (np.ones(len(self._keys)), (self.row, self.column)), shape=(count, count)
        )
        order = reverse_cuthill_mckee(graph, symmetric_mode=True)
        self.place = np.empty(count, dtype=np.int64)  # of each vertex in the narrow ordering
        self.place[order] = each
        self.order = order
        self.laplacian = self.blocks_of(
            self.to_ends @ self.difference
        )  # sum over edges of (x_a - x_b)^2

    def blocks_of(self, matrix, size=None):
        """A sparse matrix (N, N) within the pattern as one number a block, (B,); with ``size``, a
        matrix (size N, size N) as its blocks, (B, size, size)."""
        matrix = matrix.tocoo()
        if size is None:
            out = np.zeros(len(self._keys))
            out[self.find(matrix.row, matrix.col)] = matrix.data
            return out
        out = np.zeros((len(self._keys), size, size))
        (i, a), (j, b) = np.divmod(matrix.row, size), np.divmod(matrix.col, size)
        out[self.find(i, j), a, b] = matrix.data
        return out

    def bound_of(self, matrix):
        """Blocks (B,) of a matrix within the pattern that bounds the symmetric ``matrix`` (N, N)
        from above: what lies outside the pattern goes to the diagonal, for 2 |x_i x_j| <= x_i^2 +
        x_j^2.
        """
        matrix = matrix.tocoo()
        place = np.searchsorted(self._keys, key := matrix.row * self.count + matrix.col)
        inside = self._keys[np.minimum(place, len(self._keys) - 1)] == key
        out = np.zeros(len(self._keys))
        out[place[inside]] = matrix.data[inside]
        np.add.at(out, self.diagonal[matrix.row[~inside]], np.abs(matrix.data[~inside]))
        return out

    def find(self, i, j):
        """Indices of the blocks (i, j)."""
        return np.searchsorted(self._keys, i * self.count + j)

    def find_half(self, i, j):
        """Indices in the half, (K,), of the blocks (i, j) or, where these lie below the diagonal,
        (j, i).
        """
        return np.searchsorted(self._half_keys, np.minimum(i, j) * self.count + np.maximum(i, j))

    def all_blocks(self, half):
        """All blocks (B, d, d) of the symmetric matrix whose upper ``half`` (U, d, d) is given."""
        out = np.empty((len(self._keys), *half.shape[1:]))
        out[self.upper] = half
        out[self.lower] = half[self.mirrored].transpose(0, 2, 1)
        return out
