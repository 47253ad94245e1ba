"""Figures of how a drape looks like cloth: folds, swing and strain, held against plain skinning."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch

from polyfit import mesh

SMOOTHING = 10  # steps of half of the neighbours' mean: what is left are folds of some centimetres
_LOWEST = 1 / 3  # of the vertices, by their height under plain skinning in the first frame


@dataclass(frozen=True)
class Folds:
    """``fold``: root mean square of the change of the angle between two neighbouring faces, against
    the mean over time of plain skinning's [degrees]; ``wave``: the same after :data:`SMOOTHING`
    steps of smoothing, folds of some centimetres and no noise; ``swing``: root mean square over
    time of the displacement from plain skinning less its mean [mm]; ``hang``: length of that mean
    [mm]. These of the lowest part. ``strain``: mean % by which the inner edges of the
    whole garment are longer or shorter than at rest.
    """

    fold: float
    wave: float
    swing: float
    hang: float
    strain: float

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


def folds(
    vertices: torch.Tensor,
    skinned: torch.Tensor,
    faces: torch.Tensor,
    rest_lengths: torch.Tensor | None = None,
    *,
    rest: torch.Tensor | None = None,
) -> Folds:
    """:class:`Folds` of vertices (T, N, 3) [m] of a garment with ``faces`` (F, 3) that plain
    skinning has at ``skinned`` (T, N, 3) [m]. Lengths at rest [m]: ``rest_lengths`` of the
    :func:`inner_edges` (E,), or those of ``rest`` (N, 3).
    """
    edges, sides = inner_edges(faces)
    vertices, skinned = vertices.double(), skinned.double()
    height = skinned[0, :, 2]
    low = height < torch.quantile(height, _LOWEST)
    hinge = low[edges].all(1)
    smoothed = _smoother(edges, len(height))
    change = lambda f: _rms(
        torch.rad2deg(
            angles(f(vertices), faces, sides[hinge])
            - angles(f(skinned), faces, sides[hinge]).mean(0)
        )
    )
    away = 1e3 * (vertices - skinned)[:, low]
    length = lambda x: (x[..., edges[:, 0], :] - x[..., edges[:, 1], :]).norm(dim=-1)
    if rest is not None:
        rest_lengths = length(rest.double())
    return Folds(
        fold=change(lambda x: x),
        wave=change(smoothed),
        swing=float((away - away.mean(0)).square().sum(-1).mean().sqrt()),
        hang=float(away.mean(0).norm(dim=-1).mean()),
        strain=100 * float((length(vertices) / rest_lengths - 1).abs().mean()),
    )


def inner_edges(faces: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Edges (E, 2) that two of the faces (F, 3) share, and those faces (E, 2)."""
    edges, side = mesh.edges_of(faces.numpy())
    order = side.ravel().argsort(kind="stable")
    edges, uses = torch.as_tensor(edges), torch.as_tensor(side).flatten().bincount()
    start = (uses.cumsum(0) - uses)[uses == 2]
    face = torch.as_tensor(order) // 3
    return edges[uses == 2], torch.stack([face[start], face[start + 1]], 1)


def angles(vertices: torch.Tensor, faces: torch.Tensor, pairs: torch.Tensor) -> torch.Tensor:
    """Signed angles (T, E) [rad] between the normals of ``pairs`` (E, 2) of neighbouring faces of
    vertices (T, N, 3); above zero in a valley, as seen from outside.
    """
    a, b, c = (vertices[:, faces[:, k]] for k in range(3))
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    centre = (a + b + c) / 3
    one, two = (normal[:, pairs[:, k]] for k in (0, 1))
    across = centre[:, pairs[:, 1]] - centre[:, pairs[:, 0]]
    turn = torch.atan2(torch.linalg.cross(one, two).norm(dim=-1), (one * two).sum(-1))
    return torch.sign((across * one).sum(-1)) * turn


def _smoother(edges, count):
    """A function of positions (T, N, 3) to those after :data:`SMOOTHING` steps half of the way to
    the mean of the neighbours along ``edges`` (E, 2).
    """
    both = torch.cat([edges, edges.flip(1)])
    alone = (both[:, 0].bincount(minlength=count) == 0).nonzero()  # they stay where they are
    both = torch.cat([both, alone.expand(-1, 2)])
    degree = both[:, 0].bincount(minlength=count)

    def smoothed(x):
        for _ in range(SMOOTHING):
            total = torch.zeros_like(x).index_add(1, both[:, 0], x[:, both[:, 1]])
            x = 0.5 * x + 0.5 * total / degree[:, None]
        return x

    return smoothed


def _rms(x):
    return float(x.square().mean().sqrt())
