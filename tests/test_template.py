"""What one jet can hold, and what is refused with the measured residual."""

import numpy as np
import pytest
import trimesh

from polysft_mi.errors import InputError
from polysft_mi.template import Template


def grid(n=15, m=13, height=lambda x, y: 0 * x):
    y, x = np.meshgrid(np.linspace(-0.1, 0.1, m), np.linspace(-0.15, 0.15, n), indexing="ij")
    i = np.arange(n * m).reshape(m, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    vertices = np.stack([x, y, 0.6 + height(x, y)], -1).reshape(-1, 3)
    return vertices, faces, vertices[:, :2]


def test_residual_is_what_the_jet_leaves():
    vertices, faces, uv = grid(height=lambda x, y: 0.004 * np.sin(60 * x))
    t = Template.fit(vertices, faces, uv, 4)
    from polyfit import jets
    import torch

    held = np.concatenate([t.chart, jets.height(torch.as_tensor(t.alpha), torch.as_tensor(t.chart)).numpy()[:, None]], 1)
    points = t.scale * held @ t.rotation.T + t.origin
    assert np.linalg.norm(points - vertices, axis=1) == pytest.approx(np.abs(t.residual), abs=1e-12)
    assert 1e-3 < t.residual_rms < 4e-3 < 1.5 * t.residual_max


def test_vertices_that_determine_less_get_less():
    t = Template.fit(*grid(5, 4), 8, capacity=10, exact=False)
    assert t.fitted == 3 and t.order == 10 and t.residual_max < 1e-12
    assert Template.fit(*grid(), 8).fitted == 8


def test_polynomial_surface_leaves_nothing():
    t = Template.fit(*grid(height=lambda x, y: x**2 - 3 * x * y + 20 * y**4), 4)
    # the chart is tilted against x, y, so a polynomial in one is not quite one in the other
    assert t.residual_max < 2e-4
    assert Template.fit(*grid(), 3).residual_max < 1e-12


def test_higher_orders_leave_less():
    args = grid(height=lambda x, y: 0.01 * np.sin(40 * x))
    residuals = [Template.fit(*args, n, tolerance=1).residual_rms for n in range(1, 11)]
    assert all(b <= a * (1 + 1e-9) for a, b in zip(residuals, residuals[1:]))
    assert residuals[-1] < 0.1 * residuals[3]


def test_closed_surface_is_refused_with_the_residual():
    ball = trimesh.creation.icosphere(subdivisions=2)
    with pytest.raises(InputError, match=r"fold over in its chart.*residual of the 4-jet is [\d.]+ mm RMS"):
        Template.fit(ball.vertices, ball.faces, ball.vertices[:, :2], 4)


def test_rough_surface_is_refused_with_the_residual():
    vertices, faces, uv = grid(height=lambda x, y: 0.03 * np.sin(120 * x))
    with pytest.raises(InputError, match=r"residual of the 4-jet is [\d.]+ mm RMS.*fit_tolerance = 0.05"):
        Template.fit(vertices, faces, uv, 4)


def test_order_too_high_for_the_vertices():
    with pytest.raises(InputError, match="order = 10 is too high: .*66 coefficients, and the 20 vertices determine no more than order 3"):
        Template.fit(*grid(5, 4), 10)


def test_edges_are_each_once():
    t = Template.fit(*grid(4, 3), 1)
    edges = {tuple(e) for e in t.edges}
    assert len(edges) == len(t.edges) == 4 * 2 + 3 * 3 + 6  # rows, columns, diagonals
