"""All frames of a window together, once each of them has been solved."""

import numpy as np
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve

from .descent import Found, check_step

_ITERATIONS, _DAMPING = 3, 1e-4


class Window:
    """Levenberg-Marquardt on the frames of a window at the last stage.

    ``contexts``: one for each frame; the anchor of the first is the frame before the window, or
    itself. What couples two frames counts among the terms of the later one, and pulls both.
    """

    def __init__(self, descent, contexts):
        self._descent, self._contexts = descent, contexts
        self._stage, self._coupling = descent.usual[-1], 2 * descent.objective.temporal

    def solve(self, states):
        """From ``states`` on: a list of :class:`polysft_mi.solvers.gauss_newton.descent.Found`."""
        objective, small = self._descent.objective, self._descent.rules.small_step
        appearances = [
            objective.appearance(state, self._stage, context.light)
            for state, context in zip(states, self._contexts, strict=True)
        ]
        states, damping = list(states), _DAMPING
        models = self._models(states, appearances)
        for _ in range(_ITERATIONS):
            try:
                steps, promised = self._steps(models, damping)
            except LinAlgError:
                damping = max(10 * damping, _DAMPING)
                continue
            trial = [state.after_step(step) for state, step in zip(states, steps, strict=True)]
            found = self._models(trial, appearances)
            total, now = (sum(m.total for m in ms) for ms in (models, found))
            if promised < small * total:
                states, models = trial, found
                break
            if now < total:
                states, models, damping = trial, found, max(damping / 5, 1e-7)
            else:
                damping *= 10
        return [Found(s, m, {}) for s, m in zip(states, models, strict=True)]

    def _models(self, states, appearances):
        """The models of all frames: the whole gradient of the window, of its curvature what lies
        within a frame.
        """
        first = self._contexts[0]
        anchors = [first.anchor if first.anchor is not None else states[0], *states[:-1]]
        models = []
        for state, anchor, context, x in zip(
            states, anchors, self._contexts, appearances, strict=True
        ):
            scale = context.scales.get(self._stage, self._descent.rules.first_scale)
            context = context.with_anchor(anchor)
            models.append(self._descent.model(state, context, self._stage, scale, x))
        for k in range(len(models) - 1):
            self._couple(models[k], models[k + 1], states[k], states[k + 1])
        return models

    def _couple(self, earlier, later, a, b):
        """Add what holds state ``b`` to ``a`` to the equations of the earlier frame."""
        normal, weight = earlier.normal, self._coupling
        jets = self._jets(a)
        normal.gradient[jets] -= weight * (b.alpha - a.alpha).ravel()
        normal.glob[jets, jets] += weight
        d = normal.local.shape[-1]
        normal.local_gradient -= weight * (b.offset - a.offset)[:, :d]
        # the displacements' coupling, weak beside the image, by its bound
        # |a - b|^2 <= 2 |a|^2 + 2 |b|^2: the local blocks stay apart
        diagonal = self._descent.objective.patterns[d].diagonal
        for k in range(d):
            normal.local[diagonal, k, k] += 2 * weight
            later.normal.local[diagonal, k, k] += weight

    @staticmethod
    def _jets(state):
        """Which of the global unknowns are coefficients."""
        patches, size = state.alpha.shape
        return (np.arange(patches)[:, None] * (size + 6) + np.arange(size)).ravel()

    def _steps(self, models, damping):
        """The steps of all frames, and the decrease that they promise. The global unknowns are
        coupled from frame to frame: a block-banded system.
        """
        reduced = [self._descent.reduced(model.normal, damping) for model in models]
        start = np.cumsum([0] + [len(r.right) for r in reduced])
        matrix = block_diag(*(r.schur for r in reduced))
        jet = self._jets(models[0].state)
        for a, b in zip(start[:-2] if len(start) > 2 else [], start[1:-1], strict=True):
            matrix[a + jet, b + jet] -= self._coupling
            matrix[b + jet, a + jet] -= self._coupling
        right = np.concatenate([r.right for r in reduced])
        g = -cho_solve(cho_factor(matrix, check_finite=False), right, check_finite=False)
        parts = np.split(g, start[1:-1])
        steps = [(part, r.following(part)) for part, r in zip(parts, reduced, strict=True)]
        for step in steps:
            check_step(step, len(models[0].state.alpha))
        return steps, sum(r.promised(part) for r, part in zip(reduced, parts, strict=True))
