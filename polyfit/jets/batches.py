"""The jets that fit batches of patches best, in torch: weighted least squares, differentiable.

Each patch is fitted as :func:`polyfit.jets.fit_points` fits one. The Gram matrix of its basis
follows from moments: T_a T_c = (T_{a+c} + T_{|a-c|}) / 2. So no matrix of points times coefficients
is ever made, and the systems stay well conditioned up to order 10. Sums and solves are in float64,
whatever dtype the points have.
"""

from functools import lru_cache, reduce
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from polyfit.errors import InputError

from . import jet
from .chebyshev import DETERMINED_RMS, Box, determined_order, values
from .frames import check_points, of_points
from .least_squares import JetFit
from .monomials import check_order, exponents, size_of


def fit(
    points: Tensor, order: int, *, weights: Tensor | None = None, mask: Tensor | None = None
) -> JetFit:
    """Least-squares n-jets through ``points`` (..., P, 3), in charts with u and v of about 1: a
    :class:`JetFit`.

    ``weights`` (..., P) not negative; ``mask`` (..., P) bool: the points that exist, the others are
    padding of any value. Points that are too few for ``order``, or that lie on a line or a small
    grid, may not determine it. Then the patch gets the highest order that they determine.
    Differentiable once in points and weights, at the cost of evaluating two jets. Raises InputError
    where a patch has no points or weight, or where numbers are not finite.
    """
    order = check_order(order)
    check_points(points)
    if not isinstance(points, Tensor):
        raise InputError(f"points are {type(points)}; a tensor of torch is needed")
    shape = points.shape[:-1]
    if shape[-1] == 0:
        raise InputError("patch 0 has no points")
    flat = points.reshape(-1, *points.shape[-2:])
    mask, weights = of_points(points, "mask", mask), of_points(points, "weights", weights)
    if mask is not None:
        mask = mask.reshape(flat.shape[:2])
    if weights is None:
        weights = flat.new_ones(1, 1) if mask is None else mask.to(flat.dtype)
        weights = weights.expand(flat.shape[:2])
    else:
        weights = weights.reshape(flat.shape[:2])
        if mask is not None:
            weights = torch.where(mask, weights, 0)
    if mask is not None:
        # padding moves onto a point of the patch, where it changes neither box nor sums
        first = mask.to(torch.uint8).argmax(1)
        flat = torch.where(
            mask[..., None], flat, flat[torch.arange(len(flat), device=flat.device), first][:, None]
        )
    alpha, fitted = _LeastSquares.apply(flat, weights, order)
    return JetFit(alpha.reshape(*shape[:-1], -1), fitted.reshape(shape[:-1]))


class _LeastSquares(torch.autograd.Function):
    """points (B, P, 3), weights (B, P), order -> alpha (B, A), order (B,)."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, weights: Tensor, order: int) -> tuple[Tensor, Tensor]:
        x = points.movedim(-1, 0).to(
            torch.float64, memory_format=torch.contiguous_format, copy=True
        )  # (3, B, P)
        box = Box.of(x[:2])
        w, total = _normalised(weights, points)
        tx, ty = values(box.normalised(x[:2]), 2 * order).permute(
            1, 2, 0, 3
        )  # (B, 2n+1, P) of u and of v, each row contiguous
        wty = ty if w is None else w[:, None] * ty
        scale = 1 / points.shape[1] if w is None else 1
        gram = _gram(tx @ wty.mT * scale, order)
        right = (tx[:, : order + 1] * x[2, :, None]) @ wty[:, : order + 1].mT * scale
        right = jet.from_matrix(right)
        _check(box, right)
        factor, fitted, kept = _factorise(gram, order)
        solution = torch.cholesky_solve((right * kept)[..., None], factor)[..., 0]
        alpha = box.to_monomials(solution, order)
        ctx.save_for_backward(points, weights, alpha, factor, kept, total)
        ctx.box, ctx.order = box, order
        ctx.mark_non_differentiable(fitted)
        return alpha.to(points.dtype), fitted

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Any) -> tuple[Tensor, Tensor | None, None]:
        points, weights = ctx.saved_tensors[:2]
        with torch.no_grad():
            to_points, to_weights = _LeastSquares._gradients(ctx, grad)
        once = lambda x: _Once.apply(x, points, weights, grad)
        return once(to_points), None if to_weights is None else once(to_weights), None

    @staticmethod
    def _gradients(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor | None]:
        # At the minimum sum w (z - c.b) b = 0 holds for the points' basis values b. Differentiated:
        # dc = G^-1 d(sum w (z - c.b) b) at fixed c, and the gradient contracts it with y = G^-1
        # grad, a jet like c itself.
        points, weights, alpha, factor, kept, total = ctx.saved_tensors
        right = ctx.box.to_monomials_transposed(grad.to(torch.float64), ctx.order) * kept
        y = ctx.box.to_monomials(
            torch.cholesky_solve(right[..., None], factor)[..., 0] * kept, ctx.order
        )
        dtype, uv = points.dtype, points[..., :2]
        which = (0, 0), (1, 0), (0, 1)
        c, cu, cv = jet.derivatives(alpha.to(dtype), uv, *which)
        y, yu, yv = jet.derivatives(y.to(dtype), uv, *which)
        residual = points[..., 2] - c
        w = weights / total.to(dtype)
        to_points = torch.stack(
            [w * (residual * yu - cu * y), w * (residual * yv - cv * y), w * y], -1
        )
        to_weights = residual * y / total.to(dtype) if ctx.needs_input_grad[1] else None
        return to_points, to_weights


class _Once(torch.autograd.Function):
    """A gradient, and what it depends on: it is refused where that is asked for. Torch's
    once_differentiable refuses it only where the gradient that came in has one of its own, which
    that of a loss linear in alpha has not.
    """

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, *of: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> NoReturn:
        raise RuntimeError("polyfit.jets.fit is differentiable once, not twice")


def _normalised(weights: Tensor, points: Tensor) -> tuple[Tensor | None, Tensor]:
    """The weights divided by their sum, float64, or None where all are 1; and the sum, (B, 1)."""
    if weights.stride() == (0, 0) and weights.numel() and weights[0, 0] == 1:
        return None, weights.new_full((len(points), 1), points.shape[1], dtype=torch.float64)
    weights = weights.to(torch.float64)
    total = weights.sum(1, keepdim=True)
    bad = ~((total > 0) & total.isfinite() & (weights >= 0).all(1, keepdim=True))
    if bad.any():
        k = int(bad[:, 0].to(torch.uint8).argmax())
        what = "no points" if (weights[k] == 0).all() else "weights that are negative or not finite"
        raise InputError(f"patch {k} has {what}")
    return weights / total, total


def _check(box: Box, right: Tensor) -> None:
    good = box.centre.isfinite().all(1) & box.half.isfinite().all(1) & right.isfinite().all(1)
    if not good.all():
        raise InputError(
            f"patch {int((~good).to(torch.uint8).argmax())} has points that are not finite"
        )


@lru_cache
def _products(order: int, device: torch.device) -> Tensor:
    """Indices (4, A^2) into the flat moments (2n+1)^2, whose mean are the moments of the products
    of two basis functions.
    """
    e = exponents(order)
    a, b = e[:, None, :], e[None, :, :]
    n = 2 * order + 1
    index = [
        p[..., 0] * n + q[..., 1] for p in (a + b, np.abs(a - b)) for q in (a + b, np.abs(a - b))
    ]
    return torch.as_tensor(np.stack(index).reshape(4, -1), device=device)


def _gram(moments: Tensor, order: int) -> Tensor:
    """Gram matrices (B, A, A) of the products T_a(x) T_b(y), from the moments (B, 2n+1, 2n+1)."""
    flat = moments.flatten(1).T.contiguous()  # whole rows of a moment each are gathered
    parts = (flat.index_select(0, index) for index in _products(order, moments.device))
    total = reduce(torch.add, parts) / 4
    return total.T.unflatten(1, (size_of(order),) * 2)


def _factorise(gram: Tensor, order: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cholesky factors (B, A, A) of the leading blocks that the points determine, the orders (B,),
    and the coefficients kept (B, A).
    """
    degree = torch.as_tensor(exponents(order).sum(1), device=gram.device)
    fitted = torch.full((len(gram),), order, device=gram.device)
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    factor, info = torch.linalg.cholesky_ex(gram)
    while True:
        short = (factor.diagonal(dim1=1, dim2=2) < DETERMINED_RMS) | (
            torch.arange(1, len(degree) + 1, device=gram.device) == info[:, None]
        )
        low = determined_order(short, order)
        again = (low < fitted).nonzero()[:, 0]
        if not len(again):
            return factor, fitted, degree <= fitted[:, None]
        fitted[again] = low[again]
        kept = degree <= fitted[again, None]
        factor[again], info[again] = torch.linalg.cholesky_ex(
            torch.where(kept[:, :, None] & kept[:, None, :], gram[again], eye)
        )
