"""Constant sparse matrices in torch, with gradients: what acts on every frame alike."""

import warnings

import numpy as np
import scipy.sparse as sp
import torch


class SparseMatrix:
    """A constant sparse matrix (rows, columns) to multiply dense ones with, on the left;
    differentiable in the dense one.
    """

    def __init__(self, matrix, device=None, dtype=torch.float32):
        matrix = sp.csr_matrix(matrix)
        self.shape = matrix.shape
        self._forward, self._backward = (_csr(m, device, dtype) for m in (matrix, matrix.T.tocsr()))

    def __matmul__(self, dense):
        """(columns, ...) -> (rows, ...)."""
        flat = dense.reshape(len(dense), -1).contiguous()
        return (
            _Product.apply(flat, self._forward, self._backward).unflatten(1, dense.shape[1:])
            if dense.ndim > 1
            else (self @ dense[:, None])[:, 0]
        )

    def to(self, device):
        moved = object.__new__(SparseMatrix)
        moved.shape, moved._forward, moved._backward = (
            self.shape,
            self._forward.to(device),
            self._backward.to(device),
        )
        return moved


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, dense, matrix, transposed):
        ctx.transposed = transposed
        return matrix @ dense

    @staticmethod
    def backward(ctx, gradient):
        return ctx.transposed @ gradient.contiguous(), None, None


def _csr(matrix, device, dtype):
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="Sparse (CSR tensor support|invariant checks)", category=UserWarning
        )
        return torch.sparse_csr_tensor(
            torch.as_tensor(matrix.indptr.astype(np.int64)),
            torch.as_tensor(matrix.indices.astype(np.int64)),
            torch.as_tensor(matrix.data, dtype=dtype),
            matrix.shape,
            device=device,
        )
