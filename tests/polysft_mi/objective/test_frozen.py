"""What the objective makes of a frame's noise and stage, and its whole gradient against finite
differences.
"""

import dataclasses
import math

import numpy as np
import pytest
from problems import problem_of, some_state

from polysft_mi.errors import InputError
from polysft_mi.objective import FrameContext, FrameMemory, Objective
from polysft_mi.scene.rules import Rules
from polysft_mi.scene.settings import Settings
from polysft_mi.surface import Unknowns


@pytest.fixture
def rng():
    """Each test's own, so that its draws do not depend on the tests before it."""
    return np.random.default_rng(4)


@pytest.fixture(params=["truth", "tube"])
def problem(request):
    """A sheet of one patch, and a sleeve of several."""
    return problem_of(
        request.getfixturevalue(request.param).folder, order=4, k_tc=50.0, k_bend=1e-3
    )


def quadratic(objective, state, stage, noise=math.nan, anchor=None):
    """The quadratic model of frame 1 at a stage, under noise."""
    context = FrameContext(1, anchor or state, FrameMemory(noise))
    return objective.frozen([context], stage, [state]).quadratic([state])[0]


@pytest.mark.parametrize("stage", [0, 2])  # without and with the relief
def test_whole_gradient_against_finite_differences(problem, stage, rng):
    objective = Objective(problem)
    atlas, stage = objective.atlas, objective.usual[stage]
    shift = np.tile([0.01, -0.008, 0.02], (len(atlas), 1))
    state = dataclasses.replace(some_state(atlas, rng, 0.004), translation=shift)
    context = FrameContext(1, some_state(atlas, rng, 0.01), FrameMemory(0.07))
    frozen = objective.frozen([context], stage, [state])
    (model,) = frozen.quadratic([state])
    gradients, size = (model.normal.gradient, model.normal.local_gradient), np.linalg.norm
    errors = []
    for _ in range(8):
        # anywhere, and uphill as far: across many unknowns, chance alone hardly meets a term
        chance = [rng.normal(size=g.shape) for g in gradients]
        step = [3e-4 * (x + size(x) / size(g) * g) for x, g in zip(chance, gradients)]
        ends = [frozen.quadratic([state.after_step(step, h)])[0].total for h in (1, -1)]
        slope, mine = (ends[0] - ends[1]) / 2, sum((x * g).sum() for x, g in zip(step, gradients))
        errors.append(abs(mine - slope) / sum(size(x) * size(g) for x, g in zip(step, gradients)))
    # a pixel's sight of the sheet jumps, in some steps more than in most; the tests against
    # automatic differentiation are the sharp ones
    assert np.median(errors) < 0.03, errors


def test_stretched_edges_give(truth):
    """Of a sheet that is stretched; not where the stage says so. Noise changes nothing in it."""
    objective = Objective(problem_of(truth.folder, order=4))
    rest, stage = (
        objective.atlas.state(objective.problem.patch.rest().to_numpy()),
        objective.usual[0],
    )
    stretched = dataclasses.replace(rest, offset=rest.offset + 0.1 * _in_plane(objective))
    term = lambda stage, noise: quadratic(objective, stretched, stage, noise).terms[
        "inextensibility"
    ]
    gives, firm = term(stage, math.nan), term(dataclasses.replace(stage, gives=False), math.nan)
    assert firm > 20 * gives
    assert term(stage, 0.124) == pytest.approx(gives)


@pytest.mark.parametrize("outside", [True, False])
def test_a_window_is_the_same_to_both_forms(truth, outside, rng):
    """Ties between frames weigh the same in the mean that is differentiated and in the sum of
    quadratic models, with and without a frame before the window.
    """
    objective = Objective(problem_of(truth.folder, order=4, k_tc=0.5, k_rgb=0.0, k_silhouette=0.0))
    before, *states = [some_state(objective.atlas, rng, 0.02) for _ in range(4)]
    contexts = [FrameContext(k, memory=FrameMemory(0.05)) for k in range(3)]
    if outside:
        contexts[0] = dataclasses.replace(contexts[0], anchor=before)
    frozen = objective.frozen(contexts, objective.usual[-1], states)
    window = [Unknowns.from_numpy(objective.atlas.arrays(state)) for state in states]
    total, terms = frozen.evaluate(window)
    models = frozen.quadratic(states)
    assert total == pytest.approx(np.mean([model.total for model in models]), rel=1e-3)
    ties = np.mean([model.terms["temporal"] for model in models])
    assert terms["temporal"] == pytest.approx(ties, rel=1e-4) and ties > 0


def _in_plane(objective):
    """Displacements (N, 3) that stretch a sheet in its chart."""
    chart = objective.problem.template.chart[:, 0]
    return np.column_stack([chart, np.zeros(len(chart))])


@pytest.mark.parametrize("noise, moves", [(math.nan, [2, 2, 2]), (0.05, [2, 3, 3])])
def test_stages_in_which_the_relief_moves(problem, noise, moves):
    objective = Objective(problem)
    rest = objective.atlas.state(problem.patch.rest().to_numpy())
    models = [quadratic(objective, rest, stage, noise) for stage in objective.usual]
    assert [model.normal.local.shape[-1] for model in models] == moves


def test_one_blur_is_one_stage(truth):
    objective = Objective(problem_of(truth.folder, blur=1.5))
    assert [stage.blur.sigma for stage in objective.stages] == [1.5]
    assert objective.usual[0].last and objective.usual[0].stiffness == 1


def test_rules_are_immutable_and_each_is_told():
    rules = Rules()
    with pytest.raises(dataclasses.FrozenInstanceError):
        rules.give = 1.0
    assert all(f.metadata["doc"] for f in dataclasses.fields(rules))
    assert rules.caution(math.nan) == 1.0 and rules.caution(rules.noise_misfit) == 2.0
    assert rules.caution(3 * rules.noise_misfit) == pytest.approx(1 + 3**rules.noise_power)


def test_weights_that_are_left_to_the_template():
    one, several = (Settings().for_patches(count) for count in (1, 3))
    assert (one.k_mi, several.k_mi, one.k_silhouette, several.k_silhouette) == (100, 30, 0.1, 1)
    given = Settings(k_mi=7.0, k_silhouette=0.0)
    assert given.for_patches(3).k_mi == 7 and given.for_patches(1).k_silhouette == 0
    assert [Settings().jet_order(k) for k in (1, 3)] == [8, 5]
    assert Settings(order=6).jet_order(3) == 6
    with pytest.raises(InputError, match=r"k_mi = -2.0; a finite number, at least 0, or -1"):
        Settings(k_mi=-2.0)
