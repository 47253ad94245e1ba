"""What holds the parts of a surface that no pixel sees: its shape at rest, more firmly there.

Where pixels see a surface, little is asked of its displacements. The back of a sleeve has no pixel;
there, neighbouring displacements and the jets' bending against the template weigh more. NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp


@dataclass(frozen=True)
class Hidden:
    """Factors of the weights of smoothness: ``edges`` (E,) and ``patches`` (K,), 1 where a surface
    is seen; and with them the curvature of the displacements along the edges, ``slide_blocks``:
    number of a vertex' unknowns to (B, 2, 2), and of the relief, ``relief_blocks`` (B,)."""

    edges: np.ndarray
    patches: np.ndarray
    slide_blocks: dict[int, np.ndarray]
    relief_blocks: np.ndarray

    @classmethod
    def of(cls, seen, hold, objective):
        """From the vertices that are ``seen`` (N,) bool; ``hold``: the factor where nothing is.

        ``objective``: a :class:`polysft_mi.objective.second_order.SecondOrder`.
        """
        pattern, atlas = objective.patterns[3], objective.atlas
        edges = hold ** (~seen[pattern.edges]).mean(1)
        entries = np.bincount(atlas.entry_patch, minlength=len(atlas))
        unseen = np.bincount(atlas.entry_patch, ~seen[atlas.entry_vertex], minlength=len(atlas))
        slides, difference = objective.slides, pattern.difference
        slid = slides.T @ sp.diags(np.repeat(edges, 2)) @ slides
        bends = pattern.bound_of(objective.bends.T @ objective.bends)
        relief = pattern.blocks_of(difference.T @ sp.diags(edges) @ difference)
        return cls(
            edges,
            hold ** (unseen / entries),
            {d: each.blocks_of(slid, 2) for d, each in objective.patterns.items()},
            relief + objective.rules.relief_bend * bends,
        )
