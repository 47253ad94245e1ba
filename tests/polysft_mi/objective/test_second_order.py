"""The objective of a frame to second order: gradients against autodiff and finite differences."""

import dataclasses
import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import surfaces
import trimesh
from problems import dense, problem_of, some_state

from polysft_mi.errors import InputError
from polysft_mi.images.gather import Images
from polysft_mi.images.light import Light
from polysft_mi.objective import terms as objective
from polysft_mi.objective.assembly import Assembly
from polysft_mi.objective.second_order import Context, SecondOrder, stages_of
from polysft_mi.objective.volume import Volume
from polysft_mi.scene.rules import Rules
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.patch import Unknowns
from polysft_mi.surface.template import Template


@pytest.fixture
def rng():
    """Each test's own, so that its draws do not depend on the tests before it."""
    return np.random.default_rng(4)


def edges_of(problem):
    """(Atlas, Pattern, the edges' lengths, and what makes the normal equations of a state by the
    edges alone).
    """
    whole = SecondOrder(problem)
    chart, pattern = whole.atlas, whole.images.pattern
    nothing = Images(
        dr.zeros(mi.Float64, 3 * pattern.count), dr.zeros(mi.Float64, 4 * len(pattern.upper))
    )
    assembly = Assembly(pattern, whole.images.gather, chart)

    def edges_alone(state, lengths, stiffness, **more):
        surface = chart.surface(state)
        return assembly.normal(surface, nothing, lengths, stiffness, d=3, **more)

    return chart, pattern, np.array(problem.edge_lengths, dtype=np.float64), edges_alone


def context_of(objective, anchor, noise=math.nan):
    """The context of frame 1 where nothing is known of the light."""
    return Context(1, anchor, noise, Light.unknown(objective.rules), {})


@pytest.fixture(scope="module", params=["problem", "tube_problem"])
def either(request):
    """The problem of one patch and that of several."""
    return request.getfixturevalue(request.param)


def test_inextensibility_gradient_is_that_of_autodiff(either, rng):
    problem = either
    chart, _, lengths, edges_alone = edges_of(problem)
    state = some_state(chart, rng, 0.02)
    normal, energy = edges_alone(state, lengths, 0.1 / problem.template.scale**2)
    unknowns = Unknowns.from_numpy(chart.arrays(state))
    dr.enable_grad(unknowns)
    value = 0.1 * objective.inextensibility(
        problem.patch.vertices(unknowns), problem.edges, problem.edge_lengths, problem.patch.scale
    )
    dr.backward(value)
    assert energy == pytest.approx(value[0], rel=1e-4)
    mine = normal.gradient.reshape(len(chart), -1)
    by_alpha = np.array(dr.grad(unknowns.delta_alpha)).reshape(len(chart), -1) @ chart.to_monomials
    assert np.abs(mine[:, :-6] - by_alpha).max() < 1e-3 * np.abs(by_alpha).max()
    offset_jacobian = np.stack(
        [np.array(dr.grad(x)) for x in (unknowns.delta_u, unknowns.delta_v, unknowns.delta_w)], 1
    )
    assert (
        np.abs(normal.local_gradient - offset_jacobian).max() < 1e-3 * np.abs(offset_jacobian).max()
    )
    by_shift = np.array(dr.grad(unknowns.translation)).reshape(-1, 3)
    assert np.abs(mine[:, -3:] - by_shift).max() < 1e-3 * np.abs(offset_jacobian).max()


def test_stretched_edges_give_and_compressed_ones_do_not(problem, rng):
    chart, pattern, lengths, edges_alone = edges_of(problem)
    state, give = some_state(chart, rng, 0.02), 0.03
    normal, energy = edges_alone(state, lengths, 7.0, give=give)
    points, (a, b) = chart.surface(state).vertices, pattern.edges.T
    excess, c = np.linalg.norm(points[a] - points[b], axis=1) - lengths, give * lengths
    assert (excess > 3 * c).any() and (excess < -3 * c).any()
    assert energy == pytest.approx(
        7.0 * np.where(excess > 0, 2 * c**2 * (np.sqrt(1 + (excess / c) ** 2) - 1), excess**2).sum()
    )
    for _ in range(3):
        step = (
            rng.normal(size=len(normal.gradient)) * 1e-6,
            rng.normal(size=normal.local_gradient.shape) * 1e-6,
        )
        slope = (
            edges_alone(state.after_step(step), lengths, 7.0, give=give)[1]
            - edges_alone(state.after_step(step, -1), lengths, 7.0, give=give)[1]
        ) / 2
        assert step[0] @ normal.gradient + (step[1] * normal.local_gradient).sum() == pytest.approx(
            slope, rel=1e-4
        )
    # curvature: of squares whose weight is what is left of an edge's pull
    weight = np.where(excess > 0, 1 / np.sqrt(1 + (excess / c) ** 2), 1.0)
    step = (
        rng.normal(size=len(normal.gradient)) * 1e-6,
        rng.normal(size=normal.local_gradient.shape) * 1e-6,
    )
    ends = [chart.surface(state.after_step(step, f)).vertices for f in (1, -1)]
    change = np.subtract(*(np.linalg.norm(p[a] - p[b], axis=1) for p in ends)) / 2
    h = dense(pattern, normal)[0]
    whole = np.concatenate([step[1].ravel(), step[0]])
    assert whole @ h @ whole == pytest.approx(2 * 7.0 * (weight * change**2).sum(), rel=1e-3)


@pytest.mark.parametrize(
    ("noise", "low", "high"),
    [(math.nan, 1, 1.01), (0.007, 1, 1.01), (0.05, 1.99, 2.01), (0.124, 500, 1100)],
)
def test_strain_is_held_harder_where_it_may_be_noise(problem, monkeypatch, noise, low, high):
    whole, given = SecondOrder(problem), []
    normal = whole._assembly.normal
    monkeypatch.setattr(whole._assembly, "normal", lambda *a: given.append(a[6]) or normal(*a))
    rest = whole.atlas.state(problem.patch.rest().to_numpy())
    context, stage = context_of(whole, rest, noise), stages_of(whole.rules)[1][0]
    whole.model(rest, context, stage, 0.5)
    whole.model(rest, context, stage, 0.5, stiffness=1.0)  # where the texture is fitted: never
    assert low <= given[0] / whole.rules.give <= high and given[1] == math.inf


@pytest.mark.parametrize("stage", [0, 2])  # without and with the relief
def test_whole_gradient_against_finite_differences(either, stage, rng):
    problem = either
    settings = dataclasses.replace(
        problem.settings,
        solver="gauss-newton",
        brightness="local",
        k_tc=50.0,
        k_bend=1e-3,
        k_uv=1e-2,
    )
    before, problem.settings = problem.settings, settings
    try:
        whole = SecondOrder(problem)
        chart, stage = whole.atlas, stages_of(whole.rules)[1][stage]
        anchor = some_state(chart, rng, 0.01)
        state = dataclasses.replace(
            some_state(chart, rng, 0.004),
            translation=np.tile([0.01, -0.008, 0.02], (len(chart), 1)),
        )
        context = context_of(whole, anchor, 0.07)

        def model(x):
            return whole.model(x, context, stage, 0.5)

        normal, size, errors = model(state).normal, np.linalg.norm, []
        gradients = normal.gradient, normal.local_gradient
        for _ in range(8):
            # anywhere, and uphill as far: across many unknowns, chance alone hardly meets a term
            chance = [rng.normal(size=g.shape) for g in gradients]
            step = [3e-4 * (x + size(x) / size(g) * g) for x, g in zip(chance, gradients)]
            slope = (
                model(state.after_step(step)).total - model(state.after_step(step, -1)).total
            ) / 2
            mine = sum((x * g).sum() for x, g in zip(step, gradients))
            scale = sum(size(x) * size(g) for x, g in zip(step, gradients))
            errors.append(abs(mine - slope) / scale)
        # a pixel's sight of the sheet jumps, in some steps more than in most; the tests against
        # autodiff are the sharp ones
        assert np.median(errors) < 0.03, errors
    finally:
        problem.settings = before


def test_gradient_and_curvature_of_what_holds_the_relief(truth, rng):
    """Without the image, which jumps, differences are sharp; these terms are quadratic in the
    displacements, so that their curvature is exact.
    """
    problem = problem_of(
        truth.folder, k_rgb=0.0, k_silhouette=0.0, k_mi=0.0, k_tc=5.0, k_relief=0.7, k_shading=0.0
    )
    whole = SecondOrder(problem)
    rest = whole.atlas.state(problem.patch.rest().to_numpy())
    state = some_state(whole.atlas, rng, 0.01)
    context, stage = context_of(whole, rest, 0.07), stages_of(whole.rules)[1][-1]
    model = whole.model(state, context, stage, 0.5)
    normal, count = model.normal, state.offset.size
    assert normal.local.shape[-1] == 3
    h = dense(whole.patterns[3], normal)[0][:count, :count]
    for _ in range(3):
        step = np.zeros(len(normal.gradient)), rng.normal(size=state.offset.shape) * 1e-2
        change = whole.model(state.after_step(step), context, stage, 0.5).total - model.total
        along = step[1].ravel()
        promised = along @ normal.local_gradient.ravel() + 0.5 * along @ h @ along
        assert change == pytest.approx(promised, rel=1e-6)


@pytest.mark.parametrize("noise, moves", [(math.nan, [0, 0, 0]), (0.2, [0, 1, 1])])
def test_stages_in_which_the_relief_moves(problem, noise, moves):
    whole = SecondOrder(problem)
    rest = whole.atlas.state(problem.patch.rest().to_numpy())
    context = context_of(whole, rest, noise)
    found = [
        whole.model(rest, context, stage, 0.5).normal.local.shape[-1] - 2
        for stage in stages_of(whole.rules)[1]
    ]
    assert found == moves


def test_rules_are_immutable_and_each_is_told():
    rules = Rules()
    with pytest.raises(dataclasses.FrozenInstanceError):
        rules.give = 1.0
    assert all(f.metadata["doc"] for f in dataclasses.fields(rules))
    assert rules.caution(math.nan) == 1.0 and rules.caution(rules.noise_misfit) == 2.0
    assert rules.caution(1e3) == 1 + rules.noise_most


def test_volume_is_that_of_the_mesh_and_its_gradients_are_right(rng):
    """A ball: the volume, the gradient against finite differences, and Adam's against it."""
    points, faces = surfaces.sphere(subdivisions=2)
    template = Template.fit(points, faces, points[:, :2], 3, exact=False)
    atlas, volume = Atlas(template), Volume(template)
    assert abs(volume.rest) == pytest.approx(abs(trimesh.Trimesh(points, faces).volume), rel=1e-9)
    state = some_state(atlas, rng, 0.02)
    size = (len(atlas), state.alpha.shape[1] + 6)
    n, g = len(points), size[0] * size[1]

    def model(state):
        normal = SimpleNamespace(
            local=np.zeros((0, 3, 3)),
            glob=np.zeros((g, g)),
            gradient=np.zeros(g),
            local_gradient=np.zeros((n, 3)),
        )
        return volume.add(normal, atlas, atlas.surface(state), 5.0), normal

    step = rng.normal(size=g), rng.normal(size=(n, 3))
    ahead, behind = (model(state.after_step(step, h))[0] for h in (1e-6, -1e-6))
    energy, normal = model(state)
    slope = normal.gradient @ step[0] + (normal.local_gradient * step[1]).sum()
    assert (ahead - behind) / 2e-6 == pytest.approx(slope, rel=1e-5)
    assert np.linalg.matrix_rank(normal.glob) == 1
    x = atlas.surface(state).vertices
    points = mi.Point3f(x.T.astype(np.float32))
    dr.enable_grad(points)
    cost = 5 * dr.square(objective.volume(points, volume.faces) / volume.rest - 1)
    assert cost[0] == pytest.approx(energy, rel=1e-3)
    dr.backward(cost)
    by_place = np.einsum(
        "nk,nka->na", np.array(dr.grad(points)).T, atlas.surface(state).offset_jacobian
    )
    assert np.allclose(by_place, normal.local_gradient, atol=1e-3 * np.abs(by_place).max())


def test_an_open_template_has_no_volume(truth):
    with pytest.raises(InputError, match="k_volume = 2, but the template is open"):
        problem_of(truth.folder, k_volume=2.0)
