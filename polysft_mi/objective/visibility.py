"""What holds the parts of a surface that no pixel sees: its shape at rest, more firmly there.

Where pixels see a surface, little is asked of its displacements. The back of a sleeve has no pixel;
there, neighbouring displacements and the jets' bending against the template weigh more. NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp


@dataclass(frozen=True)
class VisibilityWeights:
    """Factors of the weights of smoothness: ``edges`` (E,) and ``patches`` (K,), 1 where a surface
    is seen; and with them the curvature of the displacements along the edges, ``slide_blocks``:
    number of a vertex' unknowns to (B, 2, 2), and of the relief, ``relief_blocks`` (B,)."""

    edges: np.ndarray
    patches: np.ndarray
    slide_blocks: dict[int, np.ndarray]
    relief_blocks: np.ndarray

    @classmethod
    def of(cls, seen, unseen, operators):
        """From the vertices that are ``seen`` (N,) bool; ``unseen``: the factor where nothing is;
        ``operators``: :class:`Operators`.
        """
        o = operators
        pattern = o.patterns[3]
        edges = unseen ** (~seen[pattern.edges]).mean(1)
        count = len(o.atlas)
        entries = np.bincount(o.atlas.entry_patch, minlength=count)
        hidden = np.bincount(o.atlas.entry_patch, ~seen[o.atlas.entry_vertex], minlength=count)
        slid = o.slides.T @ sp.diags(np.repeat(edges, 2)) @ o.slides
        bends = pattern.bound_of(o.bends.T @ o.bends)
        relief = pattern.blocks_of(pattern.difference.T @ sp.diags(edges) @ pattern.difference)
        return cls(
            edges,
            unseen ** (hidden / entries),
            {d: each.blocks_of(slid, 2) for d, each in o.patterns.items()},
            relief + o.relief_bend * bends,
        )
