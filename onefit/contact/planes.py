"""Contacts of a simulation's step: planes that points of a sheet must stay in front of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Contacts:
    """C contacts: ``key`` (C,), which is which from step to step; ``corners`` (C, 4) and
    ``weights`` (C, 4): the point sum_i w_i x_i, or, where the weights sum to zero, the vector from
    one point of the sheet to another; the plane's ``normal`` (C, 3) and ``offset`` (C,)
    [m], so that the gap is normal . point - offset; ``moved`` (C, 3) [m], by what the other side
    moved in the step; ``stiffness`` (C,) [N/m].
    """

    key: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    moved: np.ndarray
    stiffness: np.ndarray

    def of(self, which: np.ndarray) -> Contacts:
        """Those of the contacts ``which`` (C,) says."""
        return Contacts(*(a[which] for a in vars(self).values()))


def weighted(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The sums (C, 3) of ``x`` (C, K, 3) with ``weights`` (C, K)."""
    return np.einsum("cki,ck->ci", x, weights)


class ThreadContact:
    """Threads between two places of a sheet, from the vertex ``start`` (S,) to the point
    ``barycentric`` (S, 3) of a triangle with ``corners`` (S, 3): no longer than ``lengths`` (S,)
    [m], with a ``stiffness`` (S,) [N/m]. The keys start at ``first``, one a thread.
    """

    def __init__(self, start, corners, barycentric, lengths, stiffness, first: int) -> None:
        self.corners = np.column_stack([start, corners])
        self.weights = np.column_stack([np.ones(len(start)), -barycentric])
        self.lengths, self.stiffness = lengths, stiffness
        self.keys = first + np.arange(len(start))

    def find(self, x: np.ndarray) -> Contacts:
        """The contacts of vertices at (N, 3) [m]."""
        thread = weighted(x[self.corners], self.weights)
        long = np.linalg.norm(thread, axis=1, keepdims=True)
        towards = -thread / np.maximum(long, 1e-9)
        still = np.zeros((len(thread), 3))
        return Contacts(
            self.keys, self.corners, self.weights, towards, -self.lengths, still, self.stiffness
        )
