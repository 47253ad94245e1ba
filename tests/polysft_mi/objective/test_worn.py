"""The objective of a surface that a body carries: gradients by the jets, the vertices and the
body's pose; what the drape and the known poses say; what the body hides.
"""

import dataclasses

import numpy as np
import pytest
from problems import on_an_arm, problem_of, some_state
from test_terms import by_autodiff, context_of, objective_of
from worn import some_pose

from polysft_mi.errors import InputError
from polysft_mi.objective import FrameContext, Objective
from polysft_mi.tracker import FrameTracker

TERMS = "drape pose inextensibility temporal bending coupling sliding relief".split()
WEIGHTS = dict(
    k_rgb=0.0, k_silhouette=0.0, k_shading=0.0, k_chroma=0.0, k_tc=0.3, k_bend=1e-2, k_uv=0.2
)
WEIGHTS |= dict(k_relief=0.4, k_drape=5.0, k_pose=3.0)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


@pytest.fixture
def problem(tube, rng):
    return on_an_arm(problem_of(tube.folder, order=4), rng)


def some_worn_state(objective, rng, size=0.02):
    atlas = objective.atlas
    return dataclasses.replace(
        some_state(atlas, rng, size), pose=some_pose(atlas.carrier, rng, 1, size)
    )


def worn_context(objective, rng):
    """A frame after one whose pose was corrected."""
    context = context_of(objective, rng)
    before = dataclasses.replace(context.anchor, pose=some_pose(objective.atlas.carrier, rng, 0))
    return dataclasses.replace(context, anchor=before)


def test_the_surface_starts_draped_where_the_body_stands(problem):
    atlas, carrier = problem.atlas, problem.atlas.carrier
    draped = carrier.maps(carrier.at(0))(problem.template.vertices)
    assert np.abs(atlas.surface(atlas.start).vertices - draped).max() < 1e-6
    arrays = atlas.arrays(atlas.start)
    again = atlas.surface(atlas.state(arrays)).vertices
    assert np.abs(again - draped).max() < 1e-6
    from polysft_mi.surface import Unknowns

    assert np.abs(problem.surface(Unknowns.from_numpy(arrays)) - draped).max() < 1e-6


def test_a_later_frame_keeps_the_correction(problem, rng):
    atlas, carrier = problem.atlas, problem.atlas.carrier
    state = dataclasses.replace(some_state(atlas, rng), pose=some_pose(carrier, rng, 1))
    later = atlas.posed(state, 3, state)
    assert later.pose.frame == 3
    kept = carrier.correction(later.pose) - carrier.correction(state.pose)
    assert np.abs(kept).max() < 1e-12
    assert np.abs(carrier.correction(atlas.posed(state, 3).pose)).max() == 0


@pytest.mark.parametrize("name", TERMS)
def test_gradients_by_all_unknowns(problem, name, rng):
    """By the body's pose against finite differences; by all else also against automatic
    differentiation.
    """
    objective = objective_of(problem, name, **WEIGHTS)
    context, state = worn_context(objective, rng), some_worn_state(objective, rng)
    frozen = objective.frozen([context], objective.usual[-1], [state])
    (model,) = frozen.quadratic([state])
    normal, count = model.normal, len(objective.atlas.carrier)
    total, by_globals, by_offset = by_autodiff(frozen, state)
    assert model.total == pytest.approx(total, rel=2e-4) and total > 0
    mine = normal.gradient[:-count].reshape(by_globals.shape)
    scale = max(np.abs(by_globals).max(), np.abs(by_offset).max()) + 1e-12
    assert np.abs(mine - by_globals).max() < 3e-3 * scale
    assert np.abs(normal.local_gradient - by_offset).max() < 3e-3 * scale
    for part in ("jets", "pose", "vertices"):
        g, local = np.zeros(len(normal.gradient)), np.zeros(state.offset.shape)
        if part == "vertices":
            local = rng.normal(size=local.shape)
        else:
            at = slice(-count, None) if part == "pose" else slice(0, -count)
            g[at] = rng.normal(size=len(g[at]))
        ends = [frozen.quadratic([state.after_step((g, local), h)])[0] for h in (1e-6, -1e-6)]
        slope = (ends[0].total - ends[1].total) / 2e-6
        along = normal.gradient @ g + float((normal.local_gradient * local).sum())
        assert along == pytest.approx(slope, rel=2e-3, abs=1e-6 * abs(model.total) + 1e-10)


def test_curvatures_by_the_pose_are_symmetric_and_promise_the_change(problem, rng):
    objective = objective_of(problem, "inextensibility", **WEIGHTS, mi_norm="l2")
    context = worn_context(objective, rng)
    state = objective.atlas.posed(objective.atlas.start, 1)
    a, b = objective.atlas.surface(state).vertices[problem.template.edges.T]
    lengths = np.linalg.norm(a - b, axis=1)
    objective.atlas.carrier.lengths = np.tile(lengths, (len(problem.sequence), 1))
    frozen = objective.frozen([context], objective.usual[-1], [state])
    (model,) = frozen.quadratic([state])  # no strain: Gauss-Newton's curvature is all there is
    normal = model.normal
    assert np.abs(normal.glob - normal.glob.T).max() < 1e-9 * np.abs(normal.glob).max()
    d = normal.local.shape[-1]
    g, local = rng.normal(size=len(normal.gradient)), rng.normal(size=(len(state.offset), d))
    pattern = objective.inputs.operators.patterns[d]
    bent = np.zeros_like(local)
    np.add.at(bent, pattern.row, np.einsum("bij,bj->bi", normal.local, local[pattern.column]))
    promised = g @ normal.glob @ g + (local * bent).sum() + 2 * local.ravel() @ normal.cross @ g
    ends = [frozen.quadratic([state.after_step((g, local), h)])[0].total for h in (1e-5, -1e-5)]
    change = (sum(ends) - 2 * model.total) / 1e-10
    assert change == pytest.approx(promised, rel=1e-3)


def test_the_images_move_the_body(problem, rng):
    """Of the image's terms, along the body's pose, against finite differences."""
    weights = WEIGHTS | {"k_rgb": 1.0, "k_silhouette": 1.0}
    objective = objective_of(problem, "silhouette", **weights)
    state = objective.atlas.posed(objective.atlas.start, 1)
    state = dataclasses.replace(
        state, pose=state.pose.after_step(np.r_[np.zeros(len(state.pose.free) * 3), 0.01, 0, 0])
    )
    context = FrameContext(1, None, visibility=None)
    frozen = objective.frozen([context], objective.usual[-1], [state])
    (model,) = frozen.quadratic([state])
    g = np.zeros(len(model.normal.gradient))
    g[-3] = 1.0
    zero = np.zeros(state.offset.shape)
    ends = [frozen.quadratic([state.after_step((g, zero), h)])[0].total for h in (2e-4, -2e-4)]
    slope = (ends[0] - ends[1]) / 4e-4
    assert model.normal.gradient @ g == pytest.approx(slope, rel=0.1)


def test_the_body_hides_cloth_but_not_where_a_mask_shows_it(problem):
    """A sheet that is held before the sleeve hides what lies behind; a mask knows better."""
    objective = Objective(problem)
    atlas, data = objective.atlas, objective.data
    vertices = atlas.surface(atlas.start).vertices
    blur = objective.usual[-1].blur
    free = data.seen_vertices(vertices, blur)
    height, width = problem.height, problem.width
    near = np.full((height, width), np.inf, np.float32)
    near[:, : width // 2] = vertices[:, 2].min() - 0.1
    x = problem.camera.project(vertices)[0][:, 0]
    data.hide(near, 0, 0.0)
    assert (data.seen_vertices(vertices, blur) == free).all()  # all of it is in the mask
    masks, data._frames.mask = data._frames.mask, lambda frame: np.zeros((height, width))
    data.hide(near, 0, 0.0)
    data._frames.mask = masks
    seen = data.seen_vertices(vertices, blur)
    assert free[x < width / 2 - 20].any() and not seen[x < width / 2 - 20].any()
    assert (seen == free)[x > width / 2 + 20].all()


def test_what_a_body_does_not_go_with_is_refused(problem):
    for change, message in (
        ({"window": 2}, "window = 1 are needed"),
        ({"solver": "adam"}, "solver = gauss-newton"),
        ({"rgb_norm": "l1", "k_shading": 0.0}, "needs a quadratic model of each term"),
    ):
        given = problem.settings
        problem.settings = dataclasses.replace(given, **change)
        with pytest.raises(InputError, match=message):
            FrameTracker(problem)
        problem.settings = given
