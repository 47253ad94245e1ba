"""Any solver minimises any objective: each solver on each problem, by public calls."""

import dataclasses

import numpy as np
import pytest
from per_vertex import OVER_SHEET
from problems import dense, problem_of, some_state
from scipy.linalg import LinAlgError, block_diag

from polysft_mi.errors import InputError
from polysft_mi.objective import FrameContext, FrameMemory, Objective, jet_unknowns
from polysft_mi.scene.settings import PRESETS
from polysft_mi.solvers import create
from polysft_mi.solvers.gauss_newton import GaussNewton, check_step
from polysft_mi.surface import Unknowns

PAPER = {**PRESETS["paper"], "canonical_frame": "pca", "patches": 0}
del PAPER["solver"]
PROBLEMS = {
    "default": {},
    "colours as they are": {"brightness": "none"},
    "paper": PAPER,
    "paper, losses over the sheet": {**PAPER, **OVER_SHEET},
    "these, and our smoothness": {**PAPER, **OVER_SHEET, "k_bend": 1e-6, "k_uv": 1e-4},
}
FAST = {"period": 40, "lr_rigid": 3e-3, "lr_alpha": 1e-3}  # the paper's steps need hundreds


def objective_of(folder, solver, **settings):
    adam = FAST if solver == "adam" else {}
    return Objective(problem_of(folder, **{**settings, **adam}, solver=solver))


def frames(objective, window=1):
    """The first stage's objective of the frames from the second on, which are tied to the first,
    and the template's state. (At the last stage a flat sheet is a saddle.)
    """
    rest = objective.atlas.state(objective.problem.patch.rest().to_numpy())
    contexts = [FrameContext(k, rest, FrameMemory(0.05)) for k in range(1, 1 + window)]
    return objective.frozen(contexts, objective.usual[0], [rest] * window), [rest] * window


def surfaces(objective, states):
    return np.stack([objective.atlas.surface(state).vertices for state in states])


@pytest.mark.parametrize(
    ("problem", "window"),
    [*((name, 1) for name in PROBLEMS), ("default", 2), ("paper, losses over the sheet", 2)],
)
@pytest.mark.parametrize("solver", ["gauss-newton", "adam"])
def test_every_solver_nears_the_truth_on_every_problem(truth, solver, problem, window):
    objective = objective_of(truth.folder, solver, **PROBLEMS[problem])
    if solver == "gauss-newton" and objective.without_block:
        with pytest.raises(InputError, match="quadratic model of each term, and rgb has rgb_norm"):
            create(objective)
        return
    minimiser, said = create(objective), []
    frozen, start = frames(objective, window)
    report = lambda iteration, total, terms: said.append((iteration, total, sum(terms.values())))
    iterations = 20 if solver == "gauss-newton" else None
    result = minimiser.minimise(frozen, start, iterations=iterations, report=report)
    assert [k for k, *_ in said] == list(range(result.evaluations))
    assert all(total == pytest.approx(parts, rel=1e-6) for _, total, parts in said)
    assert result.total == pytest.approx(min(total for _, total, _ in said))
    assert result.total < 0.95 * said[0][1] and set(result.terms) == set(frozen.names)
    true = truth.vertices[1 : 1 + window]
    off, left = (
        np.linalg.norm(surfaces(objective, states) - true, axis=2).mean()
        for states in (start, result.states)
    )
    assert left < 0.9 * off


def test_both_solvers_lower_the_same_objective(truth):
    """What each takes for the value of a state is what the other does."""
    objective = objective_of(truth.folder, "gauss-newton")
    frozen, start = frames(objective)
    result = create(objective).minimise(frozen, start)
    context, stage = frozen.contexts[0], objective.usual[-1]
    for state in (start[0], result.states[0]):
        frozen = objective.frozen([context], stage, [state])
        (model,) = frozen.quadratic([state])
        unknowns = Unknowns.from_numpy(objective.atlas.arrays(state))
        total, terms = frozen.evaluate([unknowns])
        assert total == pytest.approx(model.total, rel=0.1)
        for name, value in terms.items():
            assert value == pytest.approx(model.terms[name], rel=0.12, abs=1e-6)


@pytest.mark.parametrize("iterations", [1, 3])
def test_iterations_are_bounded(truth, iterations):
    for solver in ("gauss-newton", "adam"):
        objective = objective_of(truth.folder, solver)
        frozen, start = frames(objective)
        result = create(objective).minimise(frozen, start, iterations=iterations)
        assert result.evaluations <= iterations + 1


def test_a_windows_step_is_that_of_the_dense_system(truth):
    """Without the image, which jumps: one step of a window of three frames is that of all unknowns
    of all frames together.
    """
    rng = np.random.default_rng(4)
    weights = dict(k_rgb=0.0, k_silhouette=0.0, k_tc=0.5, k_bend=1e-2, k_shading=0.0, k_chroma=0.0)
    objective = Objective(problem_of(truth.folder, **weights))
    before, *states = [some_state(objective.atlas, rng, 0.01) for _ in range(4)]
    contexts = [FrameContext(k, before if k == 0 else None) for k in range(3)]
    frozen = objective.frozen(contexts, objective.usual[-1], states)
    models = frozen.quadratic(states)
    normals = [model.normal for model in models]
    steps = [
        (1e-6 * rng.normal(size=len(n.gradient)), 1e-6 * rng.normal(size=n.local_gradient.shape))
        for n in normals
    ]

    def total(factor):
        moved = [s.after_step(d, factor) for s, d in zip(states, steps, strict=True)]
        return sum(model.total for model in frozen.quadratic(moved))

    mine = sum(g @ n.gradient + (uv * n.local_gradient).sum() for (g, uv), n in zip(steps, normals))
    assert mine == pytest.approx((total(1) - total(-1)) / 2, rel=1e-4)

    damping = objective.rules.damping[0]
    pattern = objective.data.pattern
    parts, right = zip(*[dense(pattern, n) for n in normals], strict=True)
    n, start = 2 * pattern.count, np.cumsum([0] + [len(h) for h in parts])
    # no edge holds a translation
    floor = [np.where(np.arange(len(h)) < n, 0, 1e-9 * np.diag(h)[n:].mean()) for h in parts]
    whole = block_diag(
        *[h + np.diag(np.diag(h) * damping + x) for h, x in zip(parts, floor, strict=True)]
    )
    jets = n + jet_unknowns(states[0])
    for k in range(2):
        i, j = start[k] + jets, start[k + 1] + jets
        whole[np.ix_(i, j)] -= frozen.coupling
        whole[np.ix_(j, i)] -= frozen.coupling
    expected = np.split(-np.linalg.solve(whole, np.concatenate(right)), start[1:-1])
    solver = GaussNewton(dataclasses.replace(objective.rules, gain=1e9))  # taken unseen
    result = solver.minimise(frozen, states, iterations=1)
    for state, found, x in zip(states, result.states, expected, strict=True):
        step = state.after_step((x[n:], x[:n].reshape(-1, 2)))
        size = np.abs(step.offset - state.offset).max()
        assert np.abs(found.offset - step.offset).max() < 1e-2 * size
        assert np.abs(found.difference(step)).max() < 1e-2 * np.abs(step.difference(state)).max()


def test_steps_that_lead_nowhere_are_refused():
    uv, g = np.zeros((5, 2)), np.zeros(10)
    shape = 1, 4  # patches, and coefficients of each
    check_step((g, uv), shape)
    g[0] = 100.0  # of the coefficients: no bound
    check_step((g, uv), shape)
    for bad in ((g + np.eye(10)[9] * 3, uv), (g, uv - 3), (g * np.nan, uv)):
        with pytest.raises(LinAlgError):
            check_step(bad, shape)
