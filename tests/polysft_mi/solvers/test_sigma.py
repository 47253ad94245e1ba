"""How sure a vertex is: of noise, of the strain around it, and of whether a pixel sees it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from polysft_mi.images.light import Light
from polysft_mi.objective.second_order import Context, SecondOrder
from polysft_mi.solvers.gauss_newton.descent import Descent
from polysft_mi.solvers.gauss_newton.sigma import _of_noise, _strain, along_rays


@pytest.fixture(scope="module")
def solved(tube_problem):
    """(descent, model, origin): a tube whose right part is stretched."""
    problem = tube_problem
    descent = Descent(SecondOrder(problem))
    atlas = descent.objective.atlas
    state = atlas.state(problem.patch.rest().to_numpy())
    context = Context(0, state, 0.01, Light.unknown(descent.rules), {})
    model = descent.model(state, context, descent.usual[-1], 0.3)
    x = model.surface.vertices.copy()
    middle = np.median(x[:, 0])
    x[:, 0] += 0.1 * np.maximum(x[:, 0] - middle, 0)
    surface = dataclasses.replace(model.surface, vertices=x)
    return descent, dataclasses.replace(model, surface=surface), problem.camera.origin


def test_strain_is_the_mean_over_the_edges_smoothed_over_neighbours(solved):
    descent, model, _ = solved
    objective, x = descent.objective, model.surface.vertices
    edges = objective.atlas.template.edges
    near = [[] for _ in x]
    squared = [[] for _ in x]
    for (a, b), rest in zip(edges, objective.lengths):
        strain = np.linalg.norm(x[a] - x[b]) / rest - 1
        for i, j in ((a, b), (b, a)):
            near[i].append(j)
            squared[i].append(strain**2)
    mean = np.array([np.mean(s) for s in squared])
    for _ in range(4):
        mean = np.array([0.5 * m + 0.5 * mean[n].mean() for m, n in zip(mean, near)])
    found = _strain(objective, x)
    assert np.allclose(found, np.sqrt(mean))
    right = x[:, 0] > np.quantile(x[:, 0], 0.8)
    left = x[:, 0] < np.quantile(x[:, 0], 0.2)
    assert found[right].min() > 3 * found[left].max()


def test_strain_and_what_is_unseen_make_it_unsure_and_noise_is_the_least(solved):
    descent, model, origin = solved
    noise, sigma = _of_noise(descent, model, origin), along_rays(descent, model, origin)
    assert sigma.dtype == np.float32 and (sigma >= noise.astype(np.float32)).all()
    seen = descent.objective.images.seen_vertices(model.surface.vertices, descent.rules.blurs[-1])
    assert 0.2 < seen.mean() < 0.8
    scale = descent.objective.atlas.template.scale
    expected = descent.rules.sigma_strain * np.sqrt(
        noise * _strain(descent.objective, model.surface.vertices) * scale
    )
    expected *= np.where(seen, 1, descent.rules.sigma_unseen)
    more = expected > noise
    assert more.any() and np.allclose(sigma[more], expected[more], rtol=1e-5)


def test_singular_curvatures_give_no_number(solved):
    descent, model, origin = solved
    normal = SimpleNamespace(**{k: 0 * v for k, v in vars(model.normal).items()})
    assert np.isnan(along_rays(descent, dataclasses.replace(model, normal=normal), origin)).all()
