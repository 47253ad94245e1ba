"""How sure a vertex is: by the noise, and by a score of strain and of whether a pixel sees it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from polysft_mi.objective import FrameContext, FrameMemory, Objective
from polysft_mi.tracker.sigma import SCORE, SCORE_UNSEEN, _strain, along_rays, score


@pytest.fixture(scope="module")
def solved(tube_problem):
    """(objective, model, origin): a tube whose right part is stretched."""
    problem = tube_problem
    objective = Objective(problem)
    state = problem.atlas.state(problem.patch.rest().to_numpy())
    context = FrameContext(0, state, FrameMemory(0.01))
    (model,) = objective.frozen([context], objective.usual[-1], [state]).quadratic([state])
    x = model.surface.vertices.copy()
    middle = np.median(x[:, 0])
    x[:, 0] += 0.1 * np.maximum(x[:, 0] - middle, 0)
    surface = dataclasses.replace(model.surface, vertices=x)
    return objective, dataclasses.replace(model, surface=surface), problem.camera.origin


def test_strain_is_the_mean_over_the_edges_smoothed_over_neighbours(solved):
    objective, model, _ = solved
    template, x = objective.problem.template, model.surface.vertices
    edges = template.edges
    lengths = np.linalg.norm(
        template.vertices[edges[:, 0]] - template.vertices[edges[:, 1]], axis=1
    )
    near = [[] for _ in x]
    squared = [[] for _ in x]
    for (a, b), rest in zip(edges, lengths):
        strain = np.linalg.norm(x[a] - x[b]) / rest - 1
        for i, j in ((a, b), (b, a)):
            near[i].append(j)
            squared[i].append(strain**2)
    mean = np.array([np.mean(s) for s in squared])
    for _ in range(4):
        mean = np.array([0.5 * m + 0.5 * mean[n].mean() for m, n in zip(mean, near)])
    found = _strain(template, x)
    assert np.allclose(found, np.sqrt(mean))
    right = x[:, 0] > np.quantile(x[:, 0], 0.8)
    left = x[:, 0] < np.quantile(x[:, 0], 0.2)
    assert found[right].min() > 3 * found[left].max()


def test_score_grows_with_strain_and_where_nothing_is_seen_and_is_sigma_at_least(solved):
    objective, model, origin = solved
    nat = np.prod(objective.nat_and_colours(FrameContext(0), model))
    x, template = model.surface.vertices, objective.problem.template
    sigma = along_rays(objective, model, nat, origin)
    found = score(objective, x, sigma)
    assert found.dtype == np.float32 and (found >= sigma).all()
    seen = objective.data.seen_vertices(x, objective.usual[-1].blur)
    assert 0.2 < seen.mean() < 0.8
    expected = SCORE * np.sqrt(sigma * _strain(template, x) * template.scale)
    expected *= np.where(seen, 1, SCORE_UNSEEN)
    more = expected > sigma
    assert more.any() and np.allclose(found[more], expected[more], rtol=1e-5)


def test_sigma_is_that_of_the_whole_inverse(solved):
    objective, model, origin = solved
    atlas, normal, x = objective.atlas, model.normal, model.surface.vertices
    count, d = normal.local_gradient.shape
    pattern = objective.inputs.operators.patterns[d]
    local = np.zeros((count, d, count, d))
    for row, column, block in zip(pattern.row, pattern.column, normal.local):
        local[row, :, column] = block
    local = local.reshape(count * d, -1)
    whole = np.block([[local, normal.cross], [normal.cross.T, normal.glob]])
    whole += 1e-9 * np.diag(np.diag(whole))
    ray = (x - origin) / np.linalg.norm(x - origin, axis=1, keepdims=True)
    own = np.einsum("nk,nka->na", ray, model.surface.offset_jacobian)[:, :d]
    moves = np.zeros((count, count, d))
    moves[np.arange(count), np.arange(count)] = own
    moves = np.hstack([moves.reshape(count, -1), atlas.global_columns(model.surface, ray)])
    variance = np.einsum("ij,ji->i", moves, np.linalg.solve(whole, moves.T))
    found = along_rays(objective, model, 2.5e-6, origin)
    assert np.allclose(found, np.sqrt(2.5e-6 * variance), rtol=0.02)


def test_singular_curvatures_give_no_number(solved):
    objective, model, origin = solved
    normal = SimpleNamespace(**{k: 0 * v for k, v in vars(model.normal).items()})
    none = dataclasses.replace(model, normal=normal)
    assert np.isnan(along_rays(objective, none, 1e-6, origin)).all()
