"""How sure a vertex is: of noise, of the strain around it, and of whether a pixel sees it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from polysft_mi.objective import FrameContext, FrameMemory, Objective
from polysft_mi.tracker.sigma import _of_noise, _strain, along_rays


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


def test_strain_and_what_is_unseen_make_it_unsure_and_noise_is_the_least(solved):
    objective, model, origin = solved
    noise, sigma = _of_noise(objective, model, origin), along_rays(objective, model, origin)
    assert sigma.dtype == np.float32 and (sigma >= noise.astype(np.float32)).all()
    seen = objective.data.seen_vertices(model.surface.vertices, objective.usual[-1].blur)
    assert 0.2 < seen.mean() < 0.8
    template = objective.problem.template
    expected = objective.rules.sigma_strain * np.sqrt(
        noise * _strain(template, model.surface.vertices) * template.scale
    )
    expected *= np.where(seen, 1, objective.rules.sigma_unseen)
    more = expected > noise
    assert more.any() and np.allclose(sigma[more], expected[more], rtol=1e-5)


def test_singular_curvatures_give_no_number(solved):
    objective, model, origin = solved
    normal = SimpleNamespace(**{k: 0 * v for k, v in vars(model.normal).items()})
    assert np.isnan(along_rays(objective, dataclasses.replace(model, normal=normal), origin)).all()
