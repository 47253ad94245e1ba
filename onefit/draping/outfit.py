"""Several garments on one body, each worn over those before it, which are bodies to it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from onefit.body import ClosestSurface
from onefit.contact import DEEPEST, MADE, SkinContact
from onefit.garment import Stitches, untangled
from onefit.objective import crossing_faces
from polyfit import mesh
from polyfit.errors import InputError

from .post import CONTACT, pushes

if TYPE_CHECKING:
    from onefit.garment import Garment

_MOST = 4  # garments
_AT_REST = replace(CONTACT, spacing=0.006)  # [m] between points of faces: it is done once
_FAR = dict(reach=DEEPEST)  # what lies in a garment as a whole is found, too
_MADE = _FAR | dict.fromkeys(("least", "point_near", "point_least"), MADE)
_LOOKS = 3  # at rest
_MOST_INSIDE = 1.0  # [%] of a garment's vertices in one under it, or it does not go over that
# Pairs of faces of the two that pass through each other then, of 1,000 faces, at most: sensible
# orders of the templates have 0 to 5, a tight garment over a wide one has 8 to 140
_MOST_THROUGH = 6.0
_APART = 10.0  # [m] between the garments where they are cut: what lies in two is never neighbours


class Under:
    """A garment with ``faces`` (F, 3) as those over it meet it: a closed surface, as a body is.
    Each opening is closed by a cone that goes on from the rim, as far inwards as onwards, so that
    what hangs over a rim neither catches on it nor is told to be inside beyond it.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        start, end = mesh.boundary_edges(faces).T
        count, links = len(vertices), np.stack([start, end], 1)
        _, of = np.unique(mesh.components(count, links)[start], return_inverse=True)
        key = lambda a, b: a.astype(np.int64) * count + b
        ways = key(faces, np.roll(faces, -1, axis=1)).ravel()
        order = np.argsort(ways)
        at = order[np.searchsorted(ways[order], key(start, end))]
        self._rim = start, end, np.roll(faces, -2, axis=1).ravel()[at], of
        cones = np.stack([end, start, count + of], 1)
        closed = self._closed(np.asarray(vertices, dtype=float))
        self.surface = ClosestSurface(closed, np.concatenate([faces, cones]))

    def follow(self, vertices: np.ndarray) -> ClosestSurface:
        """The surface with the garment's vertices at (N, 3) [m]."""
        self.surface.follow(self._closed(np.asarray(vertices, dtype=float)))
        return self.surface

    def _closed(self, x):
        """Vertices (N, 3) [m] and the tips of the cones."""
        start, end, across, of = self._rim
        side, middle = x[end] - x[start], (x[end] + x[start]) / 2
        long = np.linalg.norm(side, axis=1, keepdims=True)
        side /= np.maximum(long, 1e-12)
        away = middle - x[across]
        away -= (away * side).sum(1, keepdims=True) * side
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        around = np.bincount(of, long[:, 0])[:, None]
        mean = lambda y: np.stack([np.bincount(of, (long * y)[:, k]) for k in range(3)], 1) / around
        centre = mean(middle)
        radius = mean(np.repeat(np.linalg.norm(middle - centre[of], axis=1)[:, None], 3, 1))
        return np.concatenate([x, centre + radius * mean(away)])


def several(garments: Any) -> list[Any]:
    """The garments of a list, or of one alone. Raises InputError for none, and for too many."""
    garments = list(garments) if isinstance(garments, list | tuple) else [garments]
    if not 1 <= len(garments) <= _MOST:
        raise InputError(f"{len(garments)} garments; 1 to {_MOST} at once")
    return garments


def let_out(garments: Sequence[Garment], rests: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """The vertices of the garments at ``rests`` (N, 3) [m] each, graded once more, by what is worn
    under them: each is pushed out of those before it as the garment of a file is pushed out of the
    body, and smoothed where its folds come through each other then. Raises InputError where one
    does not go over another: it stays inside, or both pass through each other.
    """
    made: list[torch.Tensor] = []
    under: list[Under] = []
    for garment, rest in zip(garments, rests):
        x, faces = rest.detach().float().cpu().clone(), garment.faces.cpu().numpy()
        if under:
            skin = SkinContact(x.numpy(), faces, _AT_REST, **pushes(**_MADE))
            for layer in under:
                for _ in range(_LOOKS):
                    skin.look(x, layer.surface)
                    skin.push_out(x, layer.surface)
            for other, layer in zip(garments, under):  # what smoothing does not mend
                inside = 100 * float(np.mean(layer.surface(x.numpy()).distance < 0))
                if inside > _MOST_INSIDE:
                    raise _not_over(garment, other, f"{inside:.0f} % of it stays inside")
            x = torch.as_tensor(untangled(x.double().numpy(), faces)).float()
        for other, at in zip(garments, made):
            below = at.cpu().numpy(), other.faces.cpu().numpy()
            if (through := _through(below, (x.numpy(), faces))) > _MOST_THROUGH:
                why = f"{through:.0f} of 1,000 faces still pass through each other"
                raise _not_over(garment, other, why)
        made.append(x.to(rest))
        if len(made) < len(rests):
            under.append(Under(x.numpy(), faces))
    return made


def _not_over(garment, other, why):
    return InputError(
        f"{garment.name} does not go over {other.name}: {why}; garments are given in the order in"
        " which they are put on"
    )


def _through(one, two):
    """Pairs of faces of two surfaces, ``(vertices (N, 3) [m], faces (F, 3))`` each, that pass
    through each other, for 1,000 faces of both.
    """
    (x, F), (y, G) = one, two
    pairs = crossing_faces(np.concatenate([x, y]), np.concatenate([F, G + len(x)]))
    return 1000 * ((pairs < len(F)).sum(1) == 1).sum() / (len(F) + len(G))


def numbered(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Numbers, each part's own from 0 on, in all: the next part's follow on the last's."""
    first = np.cumsum([0, *(part.max() + 1 for part in parts[:-1])])
    return np.concatenate([part + n for part, n in zip(parts, first)])


def joined(garments: Sequence[Garment], rests: Sequence[torch.Tensor]) -> dict[str, Any]:
    """All the garments, at ``rests`` (N, 3) [m], as one sheet: what
    :func:`onefit.draping.simulation.simulated` calls ``faces``, ``sides``, ``cut`` and
    ``stitches``. Where they are cut, no garment is near to another.
    """
    faces, sides, cuts, threads, count = [], [], [], [], 0
    for k, (garment, rest) in enumerate(zip(garments, rests)):
        own = garment.cut is None
        faces.append(garment.faces.cpu() + count)
        sides.append(torch.full(garment.faces.shape, torch.nan) if own else garment.sides(rest))
        cuts.append((rest if own else garment.cut.cpu()).double().numpy() + [k * _APART, 0, 0])
        if garment.stitches:
            at = {name: getattr(garment.stitches, name) + count for name in ("start", "corners")}
            threads.append(replace(garment.stitches, **at))
        count += len(rest)
    together = lambda name: np.concatenate([getattr(s, name) for s in threads])
    return dict(
        faces=torch.cat(faces),
        sides=torch.cat(sides).double().numpy(),
        cut=np.concatenate(cuts),
        stitches=Stitches(*map(together, vars(threads[0]))) if threads else None,
    )


def beneath(worn: Iterable[tuple[torch.Tensor, torch.Tensor]]) -> Iterator[list[ClosestSurface]]:
    """The surfaces of garments, vertices (T, N, 3) [m] and faces (F, 3) each, in one frame after
    the other.
    """
    worn = list(worn)
    layers = [Under(x[0].numpy(), faces.numpy()) for x, faces in worn]
    for frame in zip(*(x.numpy() for x, _ in worn)):
        yield [layer.follow(x) for layer, x in zip(layers, frame)]


def in_order(guides: Sequence[torch.Tensor], faces: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """The drapes ``guides`` (T, N, 3) [m] each, every one pushed out of those before it."""
    made: list[torch.Tensor] = []
    for guide, own in zip(guides, faces):
        x = guide.clone()
        if made:
            skin = SkinContact(x[0].numpy(), own.numpy(), CONTACT, **pushes(**_FAR))
        for frame, layers in zip(x, beneath(zip(made, faces))):
            for layer in layers:
                skin.look(frame, layer)
                skin.push_out(frame, layer)
        made.append(x)
    return made
