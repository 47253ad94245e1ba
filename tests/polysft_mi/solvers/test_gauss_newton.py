"""The second-order solver: its derivatives against autodiff through the renderer, its algebra
against dense matrices, its frames against the truth.
"""

import dataclasses
import itertools
import math
import shutil

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from problems import dense, grid_template, problem_of
from scipy.linalg import LinAlgError, block_diag
from scipy.spatial.transform import Rotation

from polyfit import jets
from polysft_mi import prepare, solvers
from polysft_mi.errors import InputError
from polysft_mi.images import pyramid, registration
from polysft_mi.images.pyramid import FARTHEST, Level, level_image
from polysft_mi.images.registration import Registration
from polysft_mi.objective import terms as objective
from polysft_mi.objective.assembly import Images
from polysft_mi.objective.problem import Problem
from polysft_mi.scene import experiment as scene
from polysft_mi.scene.settings import Settings
from polysft_mi.solvers import gauss_newton, normal_equations
from polysft_mi.solvers.normal_equations import (
    Blocks,
    Chart,
    Normal,
    Pattern,
    Reduced,
    State,
    hinges,
)
from polysft_mi.solvers.relocate import Relocator
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import track

RNG = np.random.default_rng(4)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return synthetic.cloth(
        tmp_path_factory.mktemp("gauss_newton") / "cloth",
        frames=4,
        size=(160, 120),
        rows=9,
        columns=12,
    )


@pytest.fixture(scope="module")
def problem(truth):
    return problem_of(truth.folder, brightness="none")


def some_state(chart, size=0.05):
    n, a = len(chart.template.chart), len(chart.degree)
    turn = Rotation.from_rotvec(RNG.normal(size=3) * size)
    return State(
        RNG.normal(size=a) * size, RNG.normal(size=(n, 3)) * size, turn, RNG.normal(size=3) * size
    )


# -- the chart ---------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 4, 7, 14])
def test_chart_is_the_jet_of_polyfit(order):
    template = grid_template(13, 14, order=min(order, 6), capacity=order)
    chart = Chart(template)
    state = some_state(chart)
    arrays = chart.arrays(state)
    uv = template.chart + state.offset[:, :2]
    import torch

    z = jets.height(
        torch.as_tensor(template.alpha + arrays["delta_alpha"]), torch.as_tensor(uv)
    ).numpy()
    local = (
        np.column_stack([uv, z + state.offset[:, 2]]) @ state.rotation.as_matrix().T
        + state.translation
    )
    expected = template.scale * local @ template.rotation.T + template.origin
    assert np.abs(chart.surface(state).vertices - expected).max() < 1e-9
    back = chart.state(arrays)
    assert np.abs(back.alpha - state.alpha).max() < 1e-9 and np.array_equal(
        back.offset, state.offset
    )
    assert (back.rotation * state.rotation.inv()).magnitude() < 1e-7


def test_chart_agrees_with_the_device(problem):
    chart = Chart(problem.template)
    state = some_state(chart)
    device = problem.surface(Unknowns.from_numpy(chart.arrays(state)))
    assert (
        np.abs(device - chart.surface(state).vertices).max() < 1e-5
    )  # m; what single precision leaves of monomials of order 14


@pytest.mark.parametrize("order", [4, 14])
def test_derivatives_of_the_surface(order):
    chart = Chart(grid_template(13, 14, order=4, capacity=order))
    state = some_state(chart)
    step = RNG.normal(size=len(chart.degree) + 6) * 1e-5, RNG.normal(size=state.offset.shape) * 1e-5
    s = chart.surface(state)
    a = len(chart.degree)
    linear = (
        (s.basis @ step[0][:a])[:, None] * s.up
        + s.by_motion @ step[0][a:]
        + np.einsum("nka,na->nk", s.by_offset, step[1])
    )
    numeric = (
        chart.surface(state.moved(step)).vertices - chart.surface(state.moved(step, -1)).vertices
    ) / 2
    assert np.abs(linear - numeric).max() < 1e-6 * np.abs(numeric).max()


def test_bending_is_the_mean_square_of_second_derivatives():
    chart = Chart(grid_template())
    state = dataclasses.replace(
        some_state(chart),
        alpha=np.linalg.solve(chart.to_monomials, np.array([0, 0, 0, 1.5, 0.5, -1, *np.zeros(9)])),
    )
    assert state.alpha @ chart.bending @ state.alpha == pytest.approx(
        3**2 + 2 * 0.5**2 + 2**2
    )  # of 1.5 u^2 + 0.5 uv - v^2


def test_lower_order_is_the_first_columns():
    chart = Chart(grid_template(9, 9, order=4, capacity=8))
    state = some_state(chart)
    assert np.array_equal(chart.surface(state, 5).basis, chart.surface(state).basis[:, :21])
    moved = state.moved((np.ones(21 + 6) * 0.1, np.full((81, 2), 0.2)))
    assert np.allclose(moved.offset - state.offset, [0.2, 0.2, 0])
    assert np.allclose(moved.alpha[:21] - state.alpha[:21], 0.1) and np.array_equal(
        moved.alpha[21:], state.alpha[21:]
    )


def test_towards_goes_on_with_the_motion():
    chart = Chart(grid_template())
    a, b = some_state(chart), some_state(chart)
    assert np.allclose(a.towards(b, 0).alpha, b.alpha) and np.allclose(
        a.towards(b, -1).offset, a.offset
    )
    c = a.towards(b, 1)
    assert (
        c.rotation * b.rotation.inv() * (b.rotation * a.rotation.inv()).inv()
    ).magnitude() < 1e-12


def test_rigid_motion_moves_the_template():
    chart = Chart(grid_template())
    rest = State(np.zeros(15), np.zeros((42, 3)), Rotation.identity(), np.zeros(3))
    turn, shift = Rotation.from_rotvec([0.2, -0.1, 0.3]), np.array([0.02, -0.01, 0.05])
    state = State(rest.alpha, rest.offset, *chart.rigid(turn, shift))
    assert np.allclose(
        chart.surface(state).vertices, turn.apply(chart.surface(rest).vertices) + shift
    )


def test_fitted_finds_the_state_of_given_vertices():
    chart = Chart(grid_template(11, 11))
    rest = State(np.zeros(15), np.zeros((121, 3)), Rotation.identity(), np.zeros(3))
    smooth = some_state(chart, 0.03)
    smooth.offset[:, 2] = 0
    goal = chart.surface(smooth).vertices
    found = chart.fitted(rest, goal, 20)
    assert np.abs(chart.surface(found).vertices - goal).max() < 2e-4


def test_absorbed_leaves_the_surface_and_as_little_relief_as_the_order_can():
    chart = Chart(grid_template(13, 14, order=4, capacity=6))
    state = some_state(chart)
    fine = (
        state.offset[:, 2] + chart.surface(state).basis @ RNG.normal(size=len(chart.degree)) * 0.1
    )
    state = dataclasses.replace(state, offset=np.column_stack([state.offset[:, :2], fine]))
    found = chart.absorbed(state, 4, ridge=1e-12)
    assert np.allclose(chart.surface(found).vertices, chart.surface(state).vertices, atol=1e-12)
    basis = chart.surface(state, 4).basis
    assert np.abs(basis.T @ fine).max() > 0.1 and np.abs(basis.T @ found.offset[:, 2]).max() < 1e-6
    assert np.array_equal(found.alpha[15:], state.alpha[15:])


def test_through_makes_a_state_of_any_vertices():
    chart = Chart(grid_template(9, 10))
    state = some_state(chart)
    goal = chart.surface(state).vertices + RNG.normal(size=(90, 3)) * 0.003
    found = chart.through(state, goal, 4)
    assert np.allclose(chart.surface(found).vertices, goal, atol=1e-12)
    assert (
        np.abs(chart.surface(found).basis.T @ found.offset[:, 2]).max() < 1e-2
    )  # the jet has what it can hold
    assert found.rotation is state.rotation and found.translation is state.translation


def test_hinges_measure_bending_and_no_plane_bends():
    """The sum of squares is the integral of a roll's squared curvature, on an irregular mesh
    too.
    """
    n = 41
    v, u = np.meshgrid(*2 * [np.linspace(-1, 1, n)], indexing="ij")
    chart = np.stack([u, v], -1).reshape(-1, 2)
    inner = np.abs(chart).max(1) < 0.99
    chart[inner] += RNG.uniform(-0.1, 0.1, (inner.sum(), 2)) * 2 / n
    faces = synthetic.grid_faces(n, n)
    across, bends = hinges(chart, faces)
    assert len(across) == bends.shape[0] == 3 * (n - 1) ** 2 - 2 * (n - 1)  # inner edges
    assert np.abs(bends @ (0.3 + chart @ [1.5, -0.7])).max() < 1e-9
    for k in (0, 1):
        assert ((bends @ (0.5 * chart[:, k] ** 2)) ** 2).sum() == pytest.approx(
            4.0, rel=0.1
        )  # 1 on an area of 4
    # the pairs are the corners that an inner edge separates
    a, b = (
        set(map(frozenset, x))
        for x in (across, [(f[k], f[k - 1]) for f in faces for k in range(3)])
    )
    assert not a & b


# -- the normal equations ----------------------------------------------------


def random_normal(pattern, size=9, d=2):
    """Positive normal equations of the pattern: J^T J of residuals that each see one triangle and
    the global unknowns.
    """
    n, blocks = d * pattern.count, np.zeros((len(pattern.row), d, d))
    cross, glob = np.zeros((n, size)), np.eye(size) * 0.1
    for a, b in np.stack([pattern.row, pattern.column], 1)[pattern.row < pattern.column]:
        for _ in range(d + 1):
            ja, jb, g = RNG.normal(size=d), RNG.normal(size=d), RNG.normal(size=size)
            for i, j, x in (
                (a, a, np.outer(ja, ja)),
                (b, b, np.outer(jb, jb)),
                (a, b, np.outer(ja, jb)),
                (b, a, np.outer(jb, ja)),
            ):
                blocks[pattern.find(i, j)] += x
            cross[d * a : d * a + d] += np.outer(ja, g)
            cross[d * b : d * b + d] += np.outer(jb, g)
            glob += np.outer(g, g)
    return Normal(blocks, cross, glob, RNG.normal(size=(pattern.count, d)), RNG.normal(size=size))


@pytest.mark.parametrize("alone", [0, 1000])  # rows a block below which one thread does it all
@pytest.mark.parametrize(
    "rows, columns, d", [(2, 2, 2), (3, 9, 2), (8, 7, 2), (2, 2, 3), (8, 7, 3)]
)
def test_step_and_variance_are_those_of_the_dense_system(monkeypatch, rows, columns, d, alone):
    monkeypatch.setattr(normal_equations, "_ALONE", alone)
    template = grid_template(rows, columns, order=1)
    further = hinges(template.chart, template.faces)[0] if d == 3 else None
    pattern = Pattern(template.faces, template.edges, rows * columns, further)
    normal = random_normal(pattern, d=d)
    h, g = dense(pattern, normal)
    n, damping = d * pattern.count, 1e-3
    h += np.diag(np.diag(h)) * damping
    reduced = Reduced(Blocks(pattern, d), normal, damping)
    (glob, uv), decrease = reduced.step()
    expected = -np.linalg.solve(h, g)
    assert np.allclose(np.concatenate([uv.ravel(), glob]), expected, rtol=1e-5, atol=1e-7)
    assert decrease == pytest.approx(-0.5 * expected @ g, rel=1e-5)
    (glob, uv), decrease = Reduced(Blocks(pattern, d), normal, damping, np.float32).step()
    assert uv.dtype == np.float32 and np.allclose(
        np.concatenate([uv.ravel(), glob]), expected, atol=2e-4 * np.abs(expected).max()
    )
    assert decrease == pytest.approx(-0.5 * expected @ g, rel=1e-4)
    by_local, by_global = RNG.normal(size=(pattern.count, d)), RNG.normal(size=(pattern.count, 9))
    j = np.zeros((pattern.count, len(h)))
    j[:, n:] = by_global
    for k in range(pattern.count):
        j[k, d * k : d * k + d] = by_local[k]
    assert np.allclose(
        reduced.variance(by_local, by_global),
        np.einsum("ij,ji->i", j, np.linalg.solve(h, j.T)),
        rtol=1e-5,
    )
    keep = np.r_[np.arange(n), n, n + 1, np.arange(n + 3, n + 9)]
    lower = reduced.lower(2)
    assert reduced.decrease() == pytest.approx(-0.5 * expected @ g, rel=1e-5)
    assert lower.decrease() == pytest.approx(
        0.5 * g[keep] @ np.linalg.solve(h[np.ix_(keep, keep)], g[keep]), rel=1e-5
    )
    small, fewer = h[np.ix_(keep, keep)], j[:, keep]
    assert np.allclose(
        lower.variance(by_local, by_global[:, keep[n:] - n]),
        np.einsum("ij,ji->i", fewer, np.linalg.solve(small, fewer.T)),
        rtol=1e-5,
    )
    assert np.allclose(
        reduced.slide().ravel(), -np.linalg.solve(h[:n, :n], g[:n]), rtol=1e-5, atol=1e-7
    )
    # coefficients 2 (of 3) to zero: the rest minimises the quadratic around a point where the
    # gradient is zero
    alpha = RNG.normal(size=3)
    step, increase = reduced.without(2, alpha)
    rest = -np.linalg.solve(h[np.ix_(keep, keep)], -alpha[2] * h[keep, n + 2])
    whole = np.zeros(len(h))
    whole[keep], whole[n + 2] = rest, -alpha[2]
    assert np.allclose(step, whole[n:], rtol=1e-5, atol=1e-7)
    assert np.allclose(
        (reduced.following(step) - reduced.slide()).ravel(), whole[:n], rtol=1e-5, atol=1e-6
    )
    assert increase == pytest.approx(0.5 * whole @ h @ whole, rel=1e-5)


@pytest.mark.parametrize("vertex", [0, 30, 55])  # in either half, and in the middle
def test_a_block_that_is_not_positive_is_refused_in_either_thread(monkeypatch, vertex):
    monkeypatch.setattr(normal_equations, "_ALONE", 0)
    template = grid_template(8, 7, order=1)
    pattern = Pattern(template.faces, template.edges, 56)
    normal = random_normal(pattern)
    normal.local[pattern.diagonal[pattern.order[vertex]]] -= 1e3 * np.eye(2)
    blocks = Blocks(pattern)
    assert len({blocks.middle, *(k for chain in blocks.chains for k in chain[:1])}) == 3
    with pytest.raises(LinAlgError, match="not positive definite"):
        Reduced(blocks, normal, 0)


def test_pairs_that_lie_across_two_edges_are_one_block():
    """Around a vertex of four triangles, two hinges join the same pair: its block must neither be
    lost nor counted twice.
    """
    x = np.array([[0.0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [1, 4]])
    across, bends = hinges(x, faces)
    assert len(across) == 4 and len(np.unique(np.sort(across, 1), axis=0)) == 2
    pattern = Pattern(faces, edges, 5, across)
    blocks = Blocks(pattern, 3)
    values = pattern.laplacian + pattern.blocks_of(bends.T @ bends)
    local = values[:, None, None] * np.eye(3)
    local[pattern.diagonal] += np.eye(3)
    difference = np.zeros((8, 5))
    difference[np.arange(8)[:, None], edges] = [1.0, -1.0]
    dense = np.kron(difference.T @ difference + (bends.T @ bends).toarray() + np.eye(5), np.eye(3))
    right = RNG.normal(size=(15, 2))
    found = blocks.eliminate(local, right, np.float64)
    np.testing.assert_allclose(found.back(found.columns), np.linalg.solve(dense, right), atol=1e-10)


def test_a_disconnected_and_irregular_mesh_is_factorised():
    faces = np.array(
        [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 6, 7], [8, 9, 10], [9, 10, 0]]
    )
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )
    pattern = Pattern(faces, edges, 11)
    normal = random_normal(pattern, 6 + 3)
    h, g = dense(pattern, normal)
    (glob, uv), _ = Reduced(Blocks(pattern), normal, 0).step()
    assert np.allclose(
        np.concatenate([uv.ravel(), glob]), -np.linalg.solve(h, g), rtol=1e-4, atol=1e-6
    )


# -- the images --------------------------------------------------------------


def displaced(problem, amount=1.0):
    """A surface near the template, away from the image."""
    x = problem.template.vertices
    return x + amount * (0.002 * np.sin(20 * x[:, [1, 2, 0]]) + np.array([0.002, -0.0015, 0.004]))


@pytest.fixture(scope="module")
def twin(truth, problem, tmp_path_factory):
    """A problem whose texture is the one that the level compares with, so that the renderer's
    autodiff sees the same objective.
    """
    level = Level(0.0)
    first = Registration(problem)
    texture = first._texture_level(level)
    width, height = int(texture.width[0]), int(texture.height[0])
    folder = tmp_path_factory.mktemp("twin")
    image = np.array(texture.texels).reshape(height, width, 4)[..., :3]
    mi.Bitmap(np.ascontiguousarray(image)).write(str(folder / "texture.pfm"))
    synthetic.write_image(folder / "texture.png", synthetic.texture_image())
    at = (
        np.array(first._texcoord).reshape(-1, 2) * np.array(first._texel[0]).ravel()
        + np.array(first._texel[1]).ravel()
    )
    uv = np.empty((len(truth.uv), 2))
    uv[problem.experiment.corner] = (at + 0.5) / (width, height)
    uv[:, 1] = 1 - uv[:, 1]
    for name in ("frames", "masks", "camera.json"):
        (folder / name).symlink_to(truth.folder / name)
    synthetic.write_obj(folder / "template.obj", truth.vertices[0], uv, truth.faces)
    prepare.main([str(folder)])
    text = (folder / "scene.xml").read_text()
    (folder / "scene.xml").write_text(text.replace("texture.png", "texture.pfm"))
    experiment = scene.load(str(folder / "scene.xml"), {"brightness": "none"})
    return Problem(experiment, problem.sequence), first, level


def attached(problem, vertices):
    """(flat positions with gradients, image tensor (H, W, 3), alpha) of a surface through
    ``raster``.
    """
    flat = mi.Float(vertices.astype(np.float32).ravel())
    dr.enable_grad(flat)
    rgb, alpha = problem.image(dr.unravel(mi.Point3f, flat))
    return flat, rgb, alpha


@pytest.mark.parametrize("scale", [0.2, 1.0])
def test_photometric_gradient_is_that_of_autodiff_through_raster(problem, twin, scale):
    reference, first, level = twin
    vertices = displaced(problem)
    flat, rgb, alpha = attached(reference, vertices)
    interior = np.array(objective.interior(alpha)).reshape(problem.height, problem.width)
    image = level_image(problem.sequence.frame(2), problem.sequence.mask(2), level, False)
    part = tuple(slice(k, k + n) for k, n in zip(image.corner[::-1], image.inside.shape))
    image.inside = (
        image.inside * interior[part]
    )  # where raster blends no silhouette into the colour
    first._frames[2, level] = _Ready(image)
    mine = first.evaluate(vertices, 2, level, scale)
    whole = np.zeros((problem.height, problem.width, 4), np.float32)
    whole[part] = np.concatenate([image.colour, image.inside[..., None]], -1)
    weight, area = mi.Float(whole[..., 3].ravel()), float(image.mask.sum())
    squared = 0
    for c in range(3):
        k = dr.arange(mi.UInt32, problem.pixels) * 3 + c
        squared += (
            dr.square(dr.gather(mi.Float, rgb.array, k) - mi.Float(whole[..., c].ravel())) / 3
        )
    energy = dr.sum(weight * scale**2 * dr.log(1 + squared / scale**2)) / area
    dr.backward(energy)
    expected = np.array(dr.grad(flat)).reshape(-1, 3)
    assert mine.photometric == pytest.approx(energy[0], rel=1e-4)
    gradient = slope(mine) - _silhouette_gradient(first, vertices, level)
    assert np.abs(gradient - expected).max() < 1e-3 * np.abs(expected).max()
    first._frames.clear()


class _Ready:
    """A level image that needs no reading."""

    def __init__(self, image):
        self.image = image

    def result(self):
        return self.image


def _silhouette_gradient(first, vertices, level):
    return slope(first.evaluate(vertices, 2, level, 1e-6))  # at this scale no residual pulls


def slope(evaluation):
    """The images' gradient (N, 3)."""
    return np.array(evaluation.images.gradient).reshape(-1, 3)


@pytest.mark.parametrize("level", [Level(0.0), Level(2.5, 2), Level(3.8, 3, 10.0)])
def test_a_masked_image_is_that_of_the_whole_where_the_mask_has_a_say(monkeypatch, level):
    image = cv2.GaussianBlur(RNG.random((360, 480, 3)).astype(np.float32), (0, 0), 2)
    mask = np.zeros((360, 480), np.float32)
    cv2.ellipse(mask, (320, 200), (30, 20), 20, 0, 360, 1, -1)
    part = level_image(image, mask, level)
    monkeypatch.setattr(
        pyramid, "_around", lambda mask, level: ((0, 0), (slice(None), slice(None)))
    )
    whole = level_image(image, mask, level)
    (rows, columns), (x, y) = part.inside.shape, part.corner
    assert part.inside.size < 0.8 * whole.inside.size and (x > 0 or y > 0)
    here = np.s_[y : y + rows, x : x + columns]
    for name in ("inside", "mask"):
        assert np.array_equal(getattr(part, name), getattr(whole, name)[here])
        outside = getattr(whole, name).copy()
        outside[here] = 0
        assert not outside.any()
    assert np.abs(part.colour - whole.colour[here])[part.inside > 0].max() < 1e-5
    near = whole.distance < FARTHEST
    assert np.abs(part.distance - whole.distance[here])[near[here]].max() < 1e-5
    near[here] = False
    assert not near.any()


@pytest.mark.parametrize("amount", [0.5, 1.0])
def test_silhouette_gradient_is_that_of_autodiff_through_raster(problem, amount):
    first, level = Registration(problem), Level(0.0)
    vertices = displaced(problem, amount)
    flat, _, alpha = attached(problem, vertices)
    mask = problem.sequence.mask(2)
    energy = registration._SILHOUETTE * objective.silhouette(
        alpha, mi.Float(mask.ravel()), mi.Float(float(mask.sum()))
    )
    dr.backward(energy)
    expected = np.array(dr.grad(flat)).reshape(-1, 3)
    mine = first.evaluate(vertices, 2, level, 1e-6)
    assert mine.silhouette == pytest.approx(energy[0], rel=1e-4)
    assert np.abs(slope(mine) - expected).max() < 1e-3 * np.abs(expected).max()


def edges_of(problem):
    """(Chart, Pattern, the edges' lengths, and what makes the normal equations of a state by the
    edges alone).
    """
    chart, first = Chart(problem.template), Registration(problem)
    pattern = first.pattern
    nothing = Images(
        dr.zeros(mi.Float64, 3 * pattern.count), dr.zeros(mi.Float64, 4 * len(pattern.upper))
    )

    def edges_alone(state, lengths, stiffness, **more):
        surface = chart.surface(state)
        return first.assembly.normal(surface, nothing, lengths, stiffness, wide=pattern, **more)

    return chart, pattern, np.array(problem.edge_lengths, dtype=np.float64), edges_alone


def test_inextensibility_gradient_is_that_of_autodiff(problem):
    chart, _, lengths, edges_alone = edges_of(problem)
    state = some_state(chart, 0.02)
    normal, energy = edges_alone(state, lengths, 0.1 / problem.template.scale**2)
    unknowns = Unknowns.from_numpy(chart.arrays(state))
    dr.enable_grad(unknowns)
    value = 0.1 * objective.inextensibility(
        problem.patch.vertices(unknowns), problem.edges, problem.edge_lengths, problem.patch.scale
    )
    dr.backward(value)
    assert energy == pytest.approx(value[0], rel=1e-4)
    by_alpha = chart.to_monomials.T @ np.array(dr.grad(unknowns.delta_alpha))
    assert np.abs(normal.gradient[: len(by_alpha)] - by_alpha).max() < 1e-3 * np.abs(by_alpha).max()
    by_offset = np.stack(
        [np.array(dr.grad(x)) for x in (unknowns.delta_u, unknowns.delta_v, unknowns.delta_w)], 1
    )
    assert np.abs(normal.local_gradient - by_offset).max() < 1e-3 * np.abs(by_offset).max()
    by_shift = np.array(dr.grad(unknowns.translation))
    assert np.abs(normal.gradient[-3:] - by_shift).max() < 1e-3 * np.abs(by_offset).max()


def test_stretched_edges_give_and_compressed_ones_do_not(problem):
    chart, pattern, lengths, edges_alone = edges_of(problem)
    state, give = some_state(chart, 0.02), 0.03
    normal, energy = edges_alone(state, lengths, 7.0, give=give)
    points, (a, b) = chart.surface(state).vertices, pattern.edges.T
    excess, c = np.linalg.norm(points[a] - points[b], axis=1) - lengths, give * lengths
    assert (excess > 3 * c).any() and (excess < -3 * c).any()
    assert energy == pytest.approx(
        7.0 * np.where(excess > 0, 2 * c**2 * (np.sqrt(1 + (excess / c) ** 2) - 1), excess**2).sum()
    )
    for _ in range(3):
        step = (
            RNG.normal(size=len(normal.gradient)) * 1e-6,
            RNG.normal(size=normal.local_gradient.shape) * 1e-6,
        )
        slope = (
            edges_alone(state.moved(step), lengths, 7.0, give=give)[1]
            - edges_alone(state.moved(step, -1), lengths, 7.0, give=give)[1]
        ) / 2
        assert step[0] @ normal.gradient + (step[1] * normal.local_gradient).sum() == pytest.approx(
            slope, rel=1e-4
        )
    # curvature: of squares whose weight is what is left of an edge's pull
    weight = np.where(excess > 0, 1 / np.sqrt(1 + (excess / c) ** 2), 1.0)
    step = (
        RNG.normal(size=len(normal.gradient)) * 1e-6,
        RNG.normal(size=normal.local_gradient.shape) * 1e-6,
    )
    ends = [chart.surface(state.moved(step, f)).vertices for f in (1, -1)]
    change = np.subtract(*(np.linalg.norm(p[a] - p[b], axis=1) for p in ends)) / 2
    h = dense(pattern, normal)[0]
    whole = np.concatenate([step[1].ravel(), step[0]])
    assert whole @ h @ whole == pytest.approx(2 * 7.0 * (weight * change**2).sum(), rel=1e-3)


@pytest.mark.parametrize(
    ("noise", "low", "high"),
    [(math.nan, 1, 1.01), (0.007, 1, 1.01), (0.05, 1.99, 2.01), (0.124, 500, 1100)],
)
def test_strain_is_held_harder_where_it_may_be_noise(problem, monkeypatch, noise, low, high):
    solver, given = gauss_newton.GaussNewton(problem.settings), []
    solver._prepare(problem)
    assembly = solver.registration.assembly
    normal = assembly.normal
    monkeypatch.setattr(
        assembly, "normal", lambda *arguments: given.append(arguments[5]) or normal(*arguments)
    )
    solver._noise = noise
    rest = solver.chart.state(problem.patch.rest().to_numpy())
    solver._linearise(rest, rest, 1, 4, gauss_newton.STAGES[0], 0.5)
    solver._linearise(
        rest, rest, 1, 4, gauss_newton.STAGES[0], 0.5, stiffness=1.0
    )  # where the texture is fitted: always
    assert low <= given[0] / gauss_newton._GIVE <= high and given[1] == math.inf
    solver._moved = True
    for stage in (gauss_newton.FAR, *gauss_newton.STAGES):
        solver._linearise(rest, rest, 1, 4, stage, 0.5)
    assert given[2] == given[3] == math.inf and given[4] == given[5] == given[0]


@pytest.mark.parametrize("stage", gauss_newton.STAGES[::2])  # without and with the relief
def test_whole_gradient_against_finite_differences(problem, stage):
    settings = dataclasses.replace(
        problem.settings,
        solver="gauss-newton",
        brightness="local",
        k_tc=50.0,
        k_bend=1e-3,
        k_uv=1e-2,
    )
    solver = gauss_newton.GaussNewton(settings)
    solver._prepare(problem)
    solver._noise = 0.07
    chart = solver.chart
    rest = chart.state(problem.patch.rest().to_numpy())
    anchor, state = (
        some_state(chart, 0.01),
        dataclasses.replace(some_state(chart, 0.004), translation=np.array([0.01, -0.008, 0.02])),
    )
    assert len(rest.alpha) == len(state.alpha)

    def linearise(x):
        return solver._linearise(x, anchor, 1, 4, stage, 0.5)

    normal, _ = linearise(state)
    for _ in range(3):
        step = np.zeros(len(normal.gradient)), RNG.normal(size=normal.local_gradient.shape) * 3e-4
        step[0][:15] = RNG.normal(size=15) * 3e-4
        step[0][15:] = RNG.normal(size=6) * 3e-4
        slope = (
            linearise(state.moved(step))[1]["total"] - linearise(state.moved(step, -1))[1]["total"]
        ) / 2
        mine = step[0] @ normal.gradient + (step[1] * normal.local_gradient).sum()
        scale = np.linalg.norm(step[0]) * np.linalg.norm(normal.gradient) + np.linalg.norm(
            step[1]
        ) * np.linalg.norm(normal.local_gradient)
        assert (
            abs(mine - slope) < 0.02 * scale
        )  # a pixel's sight of the sheet jumps; the autodiff tests are the sharp ones


def test_texture_is_fitted_to_the_first_frame(truth, tmp_path):
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("frames", "masks", "camera.json", "texture.png"):
        (moved / name).symlink_to(truth.folder / name)
    synthetic.write_obj(
        moved / "template.obj", truth.vertices[0], 0.02 + 0.96 * truth.uv, truth.faces
    )
    problem = problem_of(moved, last=0)
    settings = dataclasses.replace(problem.settings, texture_fit="none")
    level = None
    misfit = []
    for s in (settings, problem.settings):
        solver = gauss_newton.GaussNewton(s)
        gauss_newton_limit, gauss_newton._TEXTURE_MISFIT = gauss_newton._TEXTURE_MISFIT, 0.0
        try:
            solver._prepare(problem)
        finally:
            gauss_newton._TEXTURE_MISFIT = gauss_newton_limit
        level = solver.levels[gauss_newton.STAGES[-1]]
        squared = solver.registration.residuals(problem.template.vertices, 0, level)
        misfit.append((squared / (squared + 0.25)).mean())
    assert misfit[1] < 0.6 * misfit[0], misfit


# -- frames ------------------------------------------------------------------


def test_tracks_a_bending_sheet_and_says_how_sure_it_is(truth, tmp_path):
    problem = problem_of(truth.folder)
    assert problem.settings.solver == "gauss-newton"
    done = track(problem, solvers.create(problem.settings), 4, str(tmp_path))
    error = [
        np.linalg.norm(problem.surface(Unknowns.from_numpy(s)) - t, axis=1)
        for s, t in zip(done.states, truth.vertices)
    ]
    flat = np.linalg.norm(truth.vertices[-1] - truth.vertices[0], axis=1)
    assert max(x.mean() for x in error) < 0.003 and error[-1].mean() < 0.15 * flat.mean()
    assert set(done.sigma) == {0, 1, 2, 3} and all(
        s.shape == (108,) and (s > 0).all() for s in done.sigma.values()
    )
    again = track(problem, solvers.create(problem.settings), 4, str(tmp_path / ".."), resume=False)
    for a, b in zip(done.states, again.states):
        assert all(np.array_equal(a[name], b[name]) for name in a)


def turned_over(problem, vertices):
    """Vertices on the rays of ``vertices``, in the camera frame, that bulge the other way: a flat
    template's mirror twin.
    """
    flat = problem.camera.to_camera(problem.template.vertices)
    turn, _ = Rotation.align_vectors(vertices - vertices.mean(0), flat - flat.mean(0))
    depth = (turn.apply(flat - flat.mean(0)) + vertices.mean(0))[:, 2]
    return vertices * (2 * depth / vertices[:, 2] - 1)[:, None], np.sqrt(
        ((vertices[:, 2] - depth) ** 2).mean()
    )


def test_the_mirror_twin_lies_on_the_same_rays(problem, truth):
    solver = gauss_newton.GaussNewton(problem.settings)
    solver._prepare(problem)
    chart, camera = solver.chart, problem.camera
    state = chart.fitted(
        chart.state(problem.patch.rest().to_numpy()),
        camera.origin + truth.vertices[-1] @ camera.axes,
    )
    vertices = camera.to_camera(chart.surface(state).vertices)
    expected, size = turned_over(problem, vertices)
    bulge, twin = solver._twin(state, chart.order)
    assert (
        np.allclose(camera.to_camera(chart.surface(twin).vertices), expected, atol=1e-9)
        and np.abs(expected - vertices).max() > 0.02
    )
    assert bulge == pytest.approx(size / problem.template.scale, rel=1e-6)
    solver._has_relief = False
    assert not solver._twin(state, chart.order)[1].offset[:, 2].any()


@pytest.mark.parametrize("wrong", [True, False])
def test_a_sheet_that_bulges_the_wrong_way_is_turned_over(tmp_path, monkeypatch, wrong):
    """A track that has taken the mirror twin comes back where the twin is tried, and only there;
    one that is right stays.
    """
    monkeypatch.setattr(gauss_newton, "_SCALES", (1e-3, 1.0))  # else the least one in all stages
    truth = synthetic.cloth(tmp_path / "cloth", frames=4, size=(320, 240), bend=4.0, depth=1.0)
    problem = problem_of(truth.folder)
    surfaces = [
        turned_over(problem, v)[0] if wrong and k else v for k, v in enumerate(truth.vertices)
    ]
    chart = Chart(problem.template)
    rest = chart.state(problem.patch.rest().to_numpy())
    past = [
        (
            chart.arrays(chart.through(rest, problem.camera.origin + v @ problem.camera.axes, 8)),
            {"misfit": 0.1, "order": 8},
        )
        for v in surfaces[:3]
    ]

    def solved(terms=None):
        if terms is None:
            terms = {}
        solution = solvers.create(problem.settings).solve(
            problem,
            [Unknowns.from_numpy(past[-1][0])],
            [3],
            None,
            [*past[:-1], (past[-1][0], {**past[-1][1], **terms})],
        )
        vertices = problem.camera.to_camera(problem.surface(solution.window[0]))
        return (
            np.linalg.norm(vertices - truth.vertices[3], axis=1).mean(),
            solution.iterations,
            solution.facts,
        )

    error, iterations, facts = solved()
    assert error < 0.003 and facts["bulge"] > gauss_newton._BULGE
    same, fewer, kept = solved({"bulge": facts["bulge"]})  # tried before at this bulge
    assert kept["bulge"] == facts["bulge"] and fewer < iterations
    assert (
        same > 0.01 if wrong else same == error and kept == facts
    )  # what the other one left goes with it


def test_a_sheet_that_jumps_is_found_again(tmp_path, monkeypatch):
    blobs = np.random.default_rng(0).integers(0, 256, (48, 48, 3)).astype(np.uint8)
    monkeypatch.setattr(
        synthetic,
        "texture_image",
        lambda: cv2.resize(blobs, (384, 384), interpolation=cv2.INTER_CUBIC),
    )
    truth = synthetic.cloth(
        tmp_path / "cloth", frames=2, size=(320, 240), bend=0.3, turn=0.4, shift=0.04
    )
    problem = problem_of(truth.folder)
    found = Relocator(Registration(problem))
    turn, shift = found.pose(problem.sequence.frame(1))
    there = turn.apply(truth.vertices[0]) + shift
    assert (
        np.linalg.norm(there - truth.vertices[1], axis=1).mean()
        < 0.006
        < 0.1 * np.linalg.norm(truth.vertices[1] - truth.vertices[0], axis=1).max()
    )
    assert found.pose(np.zeros((240, 320, 3), np.float32)) is None


def test_a_stage_goes_on_while_it_gains(truth, problem, monkeypatch):
    solver = gauss_newton.GaussNewton(problem.settings)
    solver._prepare(problem)
    rest = solver.chart.state(problem.patch.rest().to_numpy())
    off = dataclasses.replace(rest, translation=rest.translation + [0.03, 0.02, 0.0])
    ends, counts = [], []
    for farther, iterations in ((1, 1), (3, 1), (3, 6)):
        monkeypatch.setattr(gauss_newton, "_FARTHER", farther)
        before = solver._count
        ends.append(solver._stage(off, off, 0, 4, gauss_newton.STAGES[0], iterations)[1]["total"])
        counts.append(solver._count - before)
    assert ends[1] < 0.9 * ends[0] and counts[:2] == [2, 4]
    assert counts[2] <= 7  # once it gains little it ends

    def after_one(*arguments):
        normal, terms = linearise(*arguments)
        if solver._count > before + 2:
            terms["total"] += 1e3
        return normal, terms

    linearise, before = solver._linearise, solver._count
    monkeypatch.setattr(solver, "_linearise", after_one)
    solver._stage(off, off, 0, 4, gauss_newton.STAGES[0], 1)
    assert solver._count - before == 3  # a step that gains nothing is the last, too


@pytest.mark.parametrize(
    "noise, misfits, stages, kept",
    [
        (0.03, [0.1, 0.08, 0.0795, 0.01], 3, 2),  # until it gains little
        (0.03, [0.2 * 0.9**k for k in range(12)], 9, 8),  # or eight times
        (0.03, [0.1, 0.035, 0.01], 2, 1),  # or what is left is noise
        (0.03, [0.1, 0.11, 0.01], 2, 0),  # what is worse is not kept
        (0.03, [0.035, 0.01], 1, 0),
        (0.005, [0.015, 0.01], 1, 0),
        (0.12, [0.3, 0.01], 1, 0),  # noisy images
        (math.nan, [0.3, 0.01], 1, 0),  # the first frame
    ],
)
def test_what_is_not_explained_goes_through_the_fine_stages_again(
    problem, monkeypatch, noise, misfits, stages, kept
):
    solver = gauss_newton.GaussNewton(problem.settings)
    solver._noise, seen = noise, []

    class At(int):
        def towards(self, other, factor):
            return self, other, factor

    def stage_by_stage(state, anchor, frame, order, stages, iterations):
        seen.append((state, stages))
        solver._fitting = {"scale": len(seen) - 1}
        return At(len(seen) - 1), {
            "misfit": misfits[len(seen) - 1],
            "inextensibility": 0.0,
            "smoothness": 0.0,
        }

    monkeypatch.setattr(solver, "_stages", stage_by_stage)
    state, terms = solver._descend("start", None, 5, 8, (gauss_newton.FAR, *gauss_newton.STAGES))
    assert seen[0] == ("start", (gauss_newton.FAR, *gauss_newton.STAGES))
    starts = [0] + [
        (k, k + 1, 1.0) for k in range(stages - 2)
    ]  # from where the last led, and as far again
    assert seen[1:] == [(start, gauss_newton.STAGES[1:]) for start in starts[: stages - 1]]
    assert (state, terms["misfit"], solver._fitting) == (kept, misfits[kept], {"scale": kept})


def test_what_is_suspect_is_measured_from_the_noise(problem):
    solver = gauss_newton.GaussNewton(problem.settings)
    frames = [{"misfit": x} for x in (0.9, 0.21, 0.22, 0.24, 0.23, 0.22)]
    solver._noise = 0.2
    assert solver._suspect_above(frames) == pytest.approx(0.2 + 1.25 * 0.02 + 0.03)
    solver._noise = 0.0
    assert solver._suspect_above(frames) == pytest.approx(1.25 * 0.22 + 0.03)
    assert (
        solver._suspect_above([{"misfit": 0.2}, {"misfit": None}, {}, {"misfit": 0.2}]) == math.inf
    )


def test_a_sheet_that_matches_nothing_stays_in_view(truth, tmp_path):
    """Images of something else: what no pixel sees costs nothing, and the sheet must not flee
    there, nor the solver fail.
    """
    folder = tmp_path / "other"
    shutil.copytree(truth.folder, folder)
    for k, path in enumerate(sorted((folder / "frames").iterdir())[1:]):
        noise = np.random.default_rng(k).integers(0, 256, (30, 40, 3)).astype(np.uint8)
        cv2.imwrite(str(path), cv2.resize(noise, (160, 120), interpolation=cv2.INTER_CUBIC))
    problem = problem_of(folder)
    done = track(problem, solvers.create(problem.settings), 4, str(tmp_path))
    for state in done.states:
        vertices = problem.surface(Unknowns.from_numpy(state))
        assert (
            np.isfinite(vertices).all()
            and np.linalg.norm(vertices - truth.vertices[0], axis=1).max() < 1.0
        )
        assert problem.visible_share(Unknowns.from_numpy(state)) > 0.5
    assert not done.lost


@pytest.mark.parametrize("shift", [(0.0, 0.0, -3.0), (5.0, 0.0, 0.0)])
def test_a_sheet_out_of_view_explains_nothing(problem, shift):
    """Behind the camera, or beside the image: no pixel is compared, which must not look like a
    perfect match.
    """
    vertices = problem.template.vertices + shift
    found = Registration(problem).evaluate(vertices, 1, Level(1.0, 1, 8.0), 0.3)
    assert (found.misfit, found.outlying, found.pixels, found.photometric) == (1, 1, 0, 0)


def test_steps_that_lead_nowhere_are_refused():
    uv, g = np.zeros((5, 2)), np.zeros(10)
    gauss_newton._check_step((g, uv))
    g[0] = 100.0  # of the coefficients: no bound
    gauss_newton._check_step((g, uv))
    for bad in ((g + np.eye(10)[9] * 3, uv), (g, uv - 3), (g * np.nan, uv)):
        with pytest.raises(LinAlgError):
            gauss_newton._check_step(bad)


def test_gradient_and_curvature_of_what_holds_the_relief(truth):
    """Without the image, which jumps, differences are sharp; these terms are quadratic in the
    displacements, so that their curvature is exact.
    """
    problem = problem_of(
        truth.folder,
        k_rgb=0.0,
        k_silhouette=0.0,
        k_mi=0.0,
        k_tc=5.0,
        k_relief=0.7,
        texture_fit="none",
    )
    solver = gauss_newton.GaussNewton(problem.settings)
    solver._prepare(problem)
    solver._noise = 0.07
    rest = solver.chart.state(problem.patch.rest().to_numpy())
    state = some_state(solver.chart, 0.01)

    def linearise(x):
        return solver._linearise(x, rest, 1, 4, gauss_newton.STAGES[-1], 0.5)

    normal, terms = linearise(state)
    assert normal.local.shape[-1] == 3
    h = dense(solver.systems[3].pattern, normal)[0][
        : 3 * len(state.offset), : 3 * len(state.offset)
    ]
    for _ in range(3):
        step = np.zeros(len(normal.gradient)), RNG.normal(size=state.offset.shape) * 1e-2
        change = linearise(state.moved(step))[1]["total"] - terms["total"]
        promised = (step[1] * normal.local_gradient).sum() + 0.5 * step[1].ravel() @ h @ step[
            1
        ].ravel()
        assert change == pytest.approx(promised, rel=1e-6)


def test_large_templates_have_no_relief(truth, tmp_path, monkeypatch):
    problem = problem_of(truth.folder)
    monkeypatch.setattr(gauss_newton, "_RELIEF_VERTICES", len(problem.template.vertices) - 1)
    done = track(problem, solvers.create(problem.settings), 3, str(tmp_path))
    assert not done.states[-1]["delta_w"].any()


def test_relief_moves_only_where_it_may(truth, tmp_path):
    """Not in the first frame, nor where its weight is zero; else the more it weighs, the less there
    is of it.
    """
    found = {}
    for weight in (0.0, 1e-3, 10.0):
        problem = problem_of(truth.folder, k_relief=weight)
        out = tmp_path / str(weight)
        out.mkdir()
        done = track(problem, solvers.create(problem.settings), 4, str(out))
        assert not done.states[0]["delta_w"].any()
        found[weight] = np.abs(done.states[-1]["delta_w"]).mean()
    assert found[0.0] == 0 < found[10.0] < 0.1 * found[1e-3]


def test_noise_is_the_least_misfit_but_for_the_first_frame(problem):
    """The first frame fits itself: the texture was taken from it. What lies far above the least
    later on is no noise.
    """
    solver = gauss_newton.GaussNewton(problem.settings)
    assert np.isnan(solver._remember([])) and np.isnan(solver._noise) and not solver._unexplained
    first = {"misfit": 0.01, "least_misfit": None}  # as a checkpoint has it
    assert np.isnan(solver._remember([first])) and solver._noise == 0.01
    known = [first, {"misfit": 0.03, "least_misfit": 0.03}, {"misfit": 0.05, "least_misfit": 0.03}]
    assert solver._remember(known) == 0.03 and solver._noise == 0.03 and not solver._unexplained
    solver._remember([*known, {"misfit": 0.13, "least_misfit": 0.03}])
    assert solver._noise == 0.03 and solver._unexplained
    solver._remember(
        [{"misfit": 0.015, "least_misfit": 0.002}]
    )  # clean images are explained well enough
    assert not solver._unexplained


@pytest.mark.parametrize(
    "noise, unexplained, moves",
    [
        (math.nan, False, [0, 0, 0]),
        (0.01, False, [0, 1, 1]),
        (0.01, True, [1, 1, 1]),
        (0.2, False, [0, 0, 1]),
        (0.2, True, [0, 0, 1]),
    ],
)
def test_stages_in_which_the_relief_moves(problem, noise, unexplained, moves):
    solver = gauss_newton.GaussNewton(problem.settings)
    solver._prepare(problem)
    rest = solver.chart.state(problem.patch.rest().to_numpy())
    solver._noise, solver._unexplained = noise, unexplained
    found = [
        solver._linearise(rest, rest, 1, 4, stage, 0.5)[0].local.shape[-1] - 2
        for stage in gauss_newton.STAGES
    ]
    assert found == moves


def test_the_least_misfit_goes_from_frame_to_frame(truth, tmp_path):
    problem = problem_of(truth.folder)
    done = track(problem, solvers.create(problem.settings), 4, str(tmp_path))
    misfit, least = ([t[name] for t in done.totals] for name in ("misfit", "least_misfit"))
    assert least[0] is None and all(b <= a for a, b in itertools.pairwise(least)) and least[-1] > 0
    solver = gauss_newton.GaussNewton(problem.settings)
    solver._prepare(problem)
    level = solver.levels[gauss_newton.STAGES[-1]]
    bare = [
        solver.registration.misfit(problem.surface(Unknowns.from_numpy(s)), k, level)
        for k, s in enumerate(done.states)
    ]
    assert least[1] == pytest.approx(bare[1], rel=0.02) and least[-1] == pytest.approx(
        min(bare[1:]), rel=0.1
    )  # of the texture as the template has it
    assert misfit[1] < 0.9 * least[1]  # the sheet's own image explains the frame better


def test_order_rises_with_the_data_and_stays_within_bounds(tmp_path):
    waves = synthetic.cloth(
        tmp_path / "waves",
        frames=3,
        size=(160, 120),
        rows=13,
        columns=17,
        bend=0.5,
        shift=0.0,
        turn=0.0,
    )
    problem = problem_of(waves.folder, order=2, order_max=3)
    solver = solvers.create(problem.settings)
    assert problem.template.order == 3
    done = track(problem, solver, 3, str(tmp_path))
    assert {t["order"] for t in done.totals} <= {2, 3}


@pytest.mark.parametrize(
    "rows, columns, asked, first",
    [(9, 12, {}, 8), (9, 12, dict(order_max=6), 6), (9, 12, dict(order=3), 3), (5, 6, {}, 4)],
)
def test_order_of_the_first_frame(tmp_path, rows, columns, asked, first):
    """Eight, as far as the settings allow and the vertices determine it; the template has it
    too.
    """
    still = synthetic.cloth(
        tmp_path / "still", frames=1, size=(160, 120), rows=rows, columns=columns, bend=0.0
    )
    problem = problem_of(still.folder, **asked)
    solution = solvers.create(problem.settings).solve(problem, [problem.patch.rest()], [0])
    assert solution.facts["order"] == problem.template.fitted == first


def test_order_falls_where_the_data_ask_for_less(tmp_path):
    flat = synthetic.cloth(
        tmp_path / "flat",
        frames=2,
        size=(160, 120),
        rows=9,
        columns=12,
        bend=0.0,
        shift=0.01,
        turn=0.1,
    )
    problem = problem_of(flat.folder, order=2, order_max=4)
    rest = problem.patch.rest()
    before = [(rest.to_numpy(), {"order": 4, "misfit": 0.0})]
    solution = solvers.create(problem.settings).solve(problem, [rest], [1], None, before)
    assert solution.facts["order"] == 2
    error = np.linalg.norm(problem.surface(solution.window[0]) - flat.vertices[1], axis=1)
    assert error.mean() < 0.002


# -- windows -----------------------------------------------------------------


def test_a_windows_step_against_finite_differences_and_the_dense_system(truth):
    """Without the image, which jumps, differences are sharp: of the whole window's objective; the
    step is that of all unknowns of all frames together.
    """
    problem = problem_of(
        truth.folder,
        k_rgb=0.0,
        k_silhouette=0.0,
        k_tc=500.0,
        k_bend=1e-2,
        window=3,
        texture_fit="none",
    )
    settings = problem.settings
    solver = gauss_newton.GaussNewton(settings)
    solver._prepare(problem)
    chart, frames, orders = solver.chart, [0, 1, 2], [3, 4, 4]
    before, *states = [some_state(chart, 0.01) for _ in range(4)]

    def total(at):
        return sum(
            terms["total"] for _, terms in solver._window(at, before, frames, orders, [None] * 3)
        )

    models = solver._window(states, before, frames, orders, [None] * 3)
    steps = [
        (RNG.normal(size=len(n.gradient)) * 1e-6, RNG.normal(size=n.local_gradient.shape) * 1e-6)
        for (n, _), s in zip(models, states)
    ]
    slope = (
        total([s.moved(d) for s, d in zip(states, steps)])
        - total([s.moved(d, -1) for s, d in zip(states, steps)])
    ) / 2
    mine = sum(
        g @ n.gradient + (uv * n.local_gradient).sum() for (g, uv), (n, _) in zip(steps, models)
    )
    assert mine == pytest.approx(slope, rel=1e-4)

    damping, found = 1e-4, solver._window_step(models, 1e-4)
    parts, right, _sizes = zip(
        *[(*dense(solver.registration.pattern, n), len(n.gradient)) for n, _ in models]
    )
    n, start = 2 * solver.registration.pattern.count, np.cumsum([0] + [len(h) for h in parts])
    floor = [
        np.where(np.arange(len(h)) < n, 0, 1e-9 * np.diag(h)[n:].mean()) for h in parts
    ]  # no edge holds a translation
    whole = block_diag(*[h + np.diag(np.diag(h) * damping + x) for h, x in zip(parts, floor)])
    for k in range(2):
        both = np.arange(chart.size(orders[k]))
        i, j = start[k] + n + both, start[k + 1] + n + both
        whole[i, j] = whole[j, i] = -2 * settings.k_tc * gauss_newton._TEMPORAL
    expected = np.split(-np.linalg.solve(whole, np.concatenate(right)), start[1:-1])
    for (g, uv), x in zip(found[0], expected):
        assert np.allclose(
            np.concatenate([uv.ravel(), g]), x, rtol=1e-3, atol=1e-4 * np.abs(x).max()
        )


@pytest.mark.parametrize("k_tc", [0.05, 1000.0])
def test_a_window_follows_the_sheet_and_couples_its_frames(truth, tmp_path, k_tc):
    """More coupling means less motion between frames; the default follows the truth as single
    frames do.
    """
    problem = problem_of(truth.folder, window=3, k_tc=k_tc)
    done = track(problem, solvers.create(problem.settings), 4, str(tmp_path))
    assert len(done.states) == 4 and len(done.totals) == 2 and set(done.sigma) == {0, 1, 2, 3}
    error = [
        np.linalg.norm(problem.surface(Unknowns.from_numpy(s)) - t, axis=1).mean()
        for s, t in zip(done.states, truth.vertices)
    ]
    if k_tc < 1:
        assert max(error) < 0.003
        return
    single = problem_of(truth.folder, window=1, k_tc=0.05)
    loose = track(single, solvers.create(single.settings), 4, str(tmp_path / ".."))
    moved = [
        sum(((b["delta_u"] - a["delta_u"]) ** 2).sum() for a, b in zip(x.states, x.states[1:]))
        for x in (done, loose)
    ]
    assert moved[0] < 0.5 * moved[1]


def test_looking_back_smooths_and_keeps_what_frames_know(truth, tmp_path):
    """``smooth`` holds every inner frame to the middle of its neighbours, and loses none of the
    facts that later frames go by.
    """
    rough = lambda surfaces: np.abs(np.diff(surfaces, n=2, axis=0)).mean()
    found, least = {}, rough(truth.vertices)
    for smooth in (0.0, 10.0):
        problem = problem_of(truth.folder, smooth=smooth)
        (tmp_path / str(smooth)).mkdir()
        done = track(problem, solvers.create(problem.settings), 4, str(tmp_path / str(smooth)))
        assert done.finished and len(done.totals) == len(done.sigma) == 4
        assert all(
            t["least_misfit"] > 0 and t["order"] == 8 and t["light"] for t in done.totals[1:]
        )
        surfaces = np.stack([problem.surface(Unknowns.from_numpy(s)) for s in done.states])
        found[smooth] = rough(surfaces)
    assert least < found[10.0] and found[10.0] - least < 0.9 * (found[0.0] - least)


def test_settings_that_do_not_go_together():
    with pytest.raises(InputError, match="one of them looks both ways"):
        solvers.create(Settings(window=3, smooth=0.1))
    with pytest.raises(InputError, match="gain"):
        solvers.create(Settings(brightness="gain"))
    assert Settings().width == 1 and Settings(solver="adam").width == 3
    assert Settings().lighting == "local" and Settings(solver="adam").lighting == "none"
    assert Settings(order=4).capacity == 14 and Settings(solver="adam").capacity == 4
    assert [
        s.least
        for s in (Settings(), Settings(solver="adam"), Settings(order=5), Settings(order_max=6))
    ] == [8, 4, 5, 6]
