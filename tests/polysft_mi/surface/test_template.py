"""Templates: jets, what they leave, and patches; the undeformed template is the mesh."""

import itertools

import numpy as np
import pytest
import surfaces
import torch
from problems import at_rest, tube_template
from scipy.spatial.transform import Rotation

from polyfit import jets
from polyfit.jets import CanonicalFrame
from polysft_mi.errors import InputError
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.template import Template


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
    chart = torch.as_tensor(t.chart[:, 0])
    held = np.concatenate([chart, jets.height(torch.as_tensor(t.alpha[0]), chart)[:, None]], 1)
    points = t.scale * held @ t.rotation[0].T + t.origin
    assert np.linalg.norm(points - vertices, axis=1) == pytest.approx(np.abs(t.residual), abs=1e-12)
    assert 1e-3 < t.residual_rms < 4e-3 < 1.5 * t.residual_max


@pytest.mark.parametrize("narrow", [1.0, 0.03])
def test_frame_and_jet_are_those_of_polyfit(narrow):
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    for order in range(1, 11):
        vertices, faces, uv = grid(
            14, 12, height=lambda x, y: 0.02 * np.sin(15 * x + 1) * np.cos(20 * y / narrow)
        )
        vertices = (
            vertices * [1, narrow, narrow] + 1e-3 * narrow * rng.normal(size=vertices.shape)
        ) @ turn.T
        t = Template.fit(vertices, faces, uv, order, exact=False)
        points = torch.as_tensor(vertices)
        frame = CanonicalFrame.from_points(points)
        x = frame.to_chart(points)
        jet = jets.fit(x, order)
        assert t.order == jet.order and t.scale == pytest.approx(float(frame.s), rel=1e-12)
        np.testing.assert_allclose(t.chart[:, 0], x[:, :2], atol=1e-9)
        np.testing.assert_allclose(
            t.residual, (x[:, 2] - jets.height(jet.alpha, x[:, :2])) * frame.s, atol=1e-9
        )
        np.testing.assert_allclose(
            t.alpha[0], jet.alpha, rtol=1e-5, atol=1e-9 + 1e-6 * np.abs(jet.alpha.numpy()).max()
        )
    given = CanonicalFrame(
        frame.s * 1.1,
        frame.rotated(torch.tensor([0.0, 0, 0.3, 1], dtype=torch.float64)).R,
        frame.T + 0.01,
    )
    t = Template.fit(vertices, faces, uv, 3, frame=given)
    np.testing.assert_allclose(t.chart[:, 0], given.to_chart(points)[:, :2], atol=1e-12)


@pytest.mark.parametrize("jitter", [1e-8, 1e-4])
def test_what_the_vertices_hardly_determine_is_as_in_polyfit(jitter):
    vertices, faces, uv = grid(5, 4)
    vertices = vertices + jitter * np.random.default_rng(0).normal(size=vertices.shape)
    t = Template.fit(vertices, faces, uv, 5, exact=False)
    points = torch.as_tensor(vertices)
    assert (
        t.order
        == jets.fit(CanonicalFrame.from_points(points).to_chart(points), 5).order
        == {1e-8: 3, 1e-4: 4}[jitter]
    )


def test_signs_of_the_frame_turn_with_a_symmetric_sheet():
    vertices, faces, uv = grid()
    for turn in Rotation.random(8, random_state=1).as_matrix():
        t = Template.fit(vertices @ turn.T, faces, uv, 2)
        np.testing.assert_allclose(t.chart, Template.fit(vertices, faces, uv, 2).chart, atol=1e-9)


def test_vertices_that_coincide_are_refused():
    for vertices in (np.ones((12, 3)), np.full((12, 3), np.nan)):
        with pytest.raises(InputError, match="12 vertices are not finite, or coincide"):
            Template.fit(vertices, grid(4, 3)[1], np.zeros((12, 2)), 1)


def test_vertices_that_determine_less_get_less():
    t = Template.fit(*grid(5, 4), 8, exact=False)
    assert t.order == 3 and t.residual_max < 1e-12
    assert Template.fit(*grid(), 8).order == 8


def test_polynomial_surface_leaves_nothing():
    t = Template.fit(*grid(height=lambda x, y: x**2 - 3 * x * y + 20 * y**4), 4)
    # the chart is tilted against x, y, so a polynomial in one is not quite one in the other
    assert t.residual_max < 2e-4
    assert Template.fit(*grid(), 3).residual_max < 1e-12


def test_higher_orders_leave_less():
    args = grid(height=lambda x, y: 0.01 * np.sin(40 * x))
    residuals = [Template.fit(*args, n).residual_rms for n in range(1, 11)]
    assert all(b <= a * (1 + 1e-9) for a, b in itertools.pairwise(residuals))
    assert residuals[-1] < 0.1 * residuals[3]


def rest_of(template):
    atlas = Atlas(template)
    return atlas.surface(at_rest(atlas)).vertices


SHAPES = {
    "sheet": (surfaces.sheet, 1),
    "rough sheet": (lambda: surfaces.sheet(lambda x, y: 0.03 * np.sin(40 * x)), 1),
    "tube": (surfaces.tube, 3),
    "ball": (lambda: surfaces.sphere(subdivisions=2), 4),
    "sheet and tube": (lambda: surfaces.joined(surfaces.sheet(), surfaces.tube()), 4),
    "fin": (surfaces.with_fin, 2),
    "moebius": (surfaces.moebius, 2),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_undeformed_template_is_the_mesh(shape):
    make, patches = SHAPES[shape]
    vertices, faces = make()
    t = Template.fit(vertices, faces, vertices[:, :2], 3)
    assert len(t) == patches if patches < 2 else len(t) >= patches
    np.testing.assert_allclose(rest_of(t), vertices, atol=1e-13 * len(vertices))
    assert t.weight.sum(1) == pytest.approx(1) and t.residual_rms <= t.residual_max
    lengths = np.linalg.norm(t.axes, axis=1)
    assert lengths == pytest.approx(1) and np.linalg.det(t.axes) == pytest.approx(1)


def test_template_of_any_winding_is_the_mesh():
    vertices, faces = surfaces.tube()
    wound = faces.copy()
    wound[::3] = wound[::3, ::-1]
    t = Template.fit(vertices, wound, vertices[:, :2], 3)
    np.testing.assert_allclose(rest_of(t), vertices, atol=1e-12)
    np.testing.assert_array_equal(t.faces, wound)


def test_relief_moves_a_vertex_along_its_third_axis():
    """To first order, whatever the slope of its chart there."""
    template = tube_template(order=5)
    atlas = Atlas(template)
    rest, h = at_rest(atlas), 1e-5
    rest.offset[:, 2] = h
    moved = (atlas.surface(rest).vertices - template.vertices) / (h * template.scale)
    np.testing.assert_allclose(moved, template.axes[..., 2], atol=1e-3)


def test_closed_or_not():
    ball, tube = surfaces.sphere(subdivisions=2), surfaces.tube()
    assert Template.fit(*ball, ball[0][:, :2], 3).is_closed
    assert not Template.fit(*tube, tube[0][:, :2], 3).is_closed


def test_doubled_faces_close_nothing():
    """A tetrahedron without one side and with another twice has two faces an edge in the mean."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [1, 2, 3]])
    template = Template.fit(vertices, faces, vertices[:, :2], 1, exact=False)
    assert 2 * len(template.edges) == faces.size and not template.is_closed


def test_a_ball_in_one_frame_is_refused():
    vertices, faces = surfaces.sphere(subdivisions=2)
    frame = CanonicalFrame.from_points(torch.as_tensor(vertices))
    with pytest.raises(InputError, match="ball.obj: one jet cannot hold it in the frame"):
        Template.fit(vertices, faces, vertices[:, :2], 4, frame=frame, where="ball.obj")


def test_order_too_high_for_the_vertices():
    with pytest.raises(
        InputError,
        match=(
            "order = 10 is too high: .*66 coefficients, and the 20 vertices determine no more than"
            " order 3"
        ),
    ):
        Template.fit(*grid(5, 4), 10)


def test_edges_are_each_once():
    t = Template.fit(*grid(4, 3), 1)
    edges = {tuple(e) for e in t.edges}
    assert len(edges) == len(t.edges) == 4 * 2 + 3 * 3 + 6  # rows, columns, diagonals


def test_a_steep_cone_is_no_sheet_and_small_patches_lower_no_other_order():
    """A skirt is a graph over the plane of its hem, but steep; a vane is held by few vertices."""
    angle, height = np.meshgrid(2 * np.pi * np.arange(24) / 24, np.linspace(0, 1, 10))
    radius = 0.4 + 0.3 * height
    skirt = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], -1).reshape(-1, 3)
    at = np.arange(240).reshape(10, 24)
    right = np.roll(at, -1, 1)
    faces = np.concatenate([
        np.stack([at[:-1], at[1:], right[:-1]], -1).reshape(-1, 3),
        np.stack([right[:-1], at[1:], right[1:]], -1).reshape(-1, 3),
    ])  # fmt: skip
    found = Template.fit(skirt, faces, skirt[:, :2], lambda count: 8 if count == 1 else 5)
    assert len(found) == 3 and found.order == 5
    vane = np.array([[3.0, 0, 0], [3.2, 0, 0], [3.0, 0.2, 0]])
    points, every = np.concatenate([skirt, vane]), np.concatenate([faces, [[240, 241, 242]]])
    both = Template.fit(points, every, points[:, :2], 5, exact=False)
    assert len(both) == 4 and both.order == 5
    assert (np.abs(both.alpha).max(1) > 0).sum() >= 3 and np.isfinite(both.alpha).all()
