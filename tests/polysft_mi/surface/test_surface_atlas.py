"""The atlas on the host: against the one formula of the surface in NumPy, torch and Dr.Jit, its
derivatives against Dr.Jit's.
"""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
import torch
from problems import at_rest, grid_template, some_state, tube_template
from scipy.spatial.transform import Rotation

from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.bending import hinges, slides
from polysft_mi.surface.deformation import Deformation
from polysft_mi.surface.patch import JetAtlas, Unknowns

RNG = np.random.default_rng(4)
TEMPLATES = {"sheet": lambda order: grid_template(13, 14, order=order), "tube": tube_template}


def in_double(array):
    """An array of NumPy as one of Dr.Jit, in double precision."""
    indices = array.dtype.kind == "i"
    return mi.UInt32(array.astype(np.uint32)) if indices else mi.Float64(np.array(array))


BACKENDS = {"numpy": np.array, "torch": torch.tensor, "drjit": in_double}


def unknowns_of(chart, state, array):
    return Unknowns(**{name: array(x.ravel()) for name, x in chart.arrays(state).items()})


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "shape, order", [*(("sheet", n) for n in (1, 4, 7, 10)), *(("tube", n) for n in (1, 4, 7))]
)
def test_atlas_is_the_one_formula(shape, order, backend):
    template, array = TEMPLATES[shape](order=order), BACKENDS[backend]
    chart, deformation = Atlas(template), Deformation(template, array)
    state = some_state(chart, RNG)
    unknowns = unknowns_of(chart, state, array)
    found = np.stack([np.asarray(x) for x in deformation.vertices(unknowns)], 1)
    assert found.dtype == np.float64
    assert np.abs(found - chart.surface(state).vertices).max() < 1e-12
    back = chart.state(chart.arrays(state))
    assert np.abs(back.alpha - state.alpha).max() < 1e-9
    assert np.array_equal(back.offset, state.offset)
    assert (back.rotation * state.rotation.inv()).magnitude().max() < 1e-7


@pytest.mark.parametrize("shape", TEMPLATES)
def test_atlas_agrees_with_the_device(shape):
    template = TEMPLATES[shape](order=4)
    chart, device = Atlas(template), JetAtlas(template)
    for state in (at_rest(chart), some_state(chart, RNG), some_state(chart, RNG, 0.2)):
        unknowns = Unknowns.from_numpy(chart.arrays(state))
        found = np.array(device.vertices(unknowns)).T
        # m; what single precision leaves of monomials
        assert np.abs(found - chart.surface(state).vertices).max() < 1e-5
        back = chart.state(unknowns.to_numpy())
        assert np.abs(back.alpha - state.alpha).max() < 1e-4
        assert (back.rotation * state.rotation.inv()).magnitude().max() < 1e-5
        assert np.abs(back.translation - state.translation).max() < 1e-6


def by_drjit(chart, state, step):
    """The derivatives (N, 3) of the vertices along a step, by Dr.Jit's forward mode."""
    g, q = step[0].reshape(len(chart), -1), state.rotation.as_quat()
    turn = np.cross(g[:, -6:-3], q[:, :3]) + q[:, 3:] * g[:, -6:-3]
    real = -(g[:, -6:-3] * q[:, :3]).sum(1, keepdims=True)
    along = {
        "delta_alpha": g[:, :-6] @ chart.to_monomials.T,
        **{f"delta_{name}": step[1][:, k] for k, name in enumerate("uvw")},
        "rotation": np.concatenate([turn, real], 1) / 2,  # of rotvec * q
        "translation": g[:, -3:],
    }
    unknowns = unknowns_of(chart, state, in_double)
    for name, tangent in along.items():
        value = getattr(unknowns, name)
        dr.enable_grad(value)
        dr.set_grad(value, in_double(tangent.ravel()))
    found = Deformation(chart.template, in_double).vertices(unknowns)
    dr.forward_to(found)
    return np.stack([np.array(dr.grad(x)) for x in found], 1)


@pytest.mark.parametrize("shape", TEMPLATES)
@pytest.mark.parametrize("order", [4, 7])
def test_derivatives_of_the_surface(order, shape):
    chart = Atlas(TEMPLATES[shape](order=order))
    state = some_state(chart, RNG)
    size = state.alpha.shape[1] + 6
    step = (
        RNG.normal(size=size * len(chart)) * 1e-5,
        RNG.normal(size=state.offset.shape) * 1e-5,
    )
    s = chart.surface(state)
    linear = np.einsum("nka,na->nk", s.offset_jacobian, step[1])
    for k, part in enumerate(chart.entries):
        g = step[0][k * size : (k + 1) * size]
        linear[chart.entry_vertex[part]] += (s.basis[part] @ g[:-6])[:, None] * s.up[k]
        linear[chart.entry_vertex[part]] += s.motion_jacobian[part] @ g[-6:]
    found = by_drjit(chart, state, step)
    assert np.abs(linear - found).max() < 1e-12 * np.abs(found).max()
    ends = [chart.surface(state.after_step(step, sign)).vertices for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / 2
    assert np.abs(linear - numeric).max() < 1e-6 * np.abs(numeric).max()
    # the columns along rows are the same derivatives
    rows = RNG.normal(size=numeric.shape)
    along = chart.global_columns(s, rows) @ step[0]
    by_offset = np.einsum("nk,nka,na->n", rows, s.offset_jacobian, step[1])
    assert np.abs(along + by_offset - (rows * numeric).sum(1)).max() < 1e-6 * np.abs(along).max()


def test_bending_is_the_mean_square_of_second_derivatives():
    chart = Atlas(grid_template())
    state = dataclasses.replace(
        some_state(chart, RNG),
        alpha=np.linalg.solve(chart.to_monomials, np.array([0, 0, 0, 1.5, 0.5, -1, *np.zeros(9)]))[
            None
        ],
    )
    assert state.alpha[0] @ chart.bending @ state.alpha[0] == pytest.approx(
        3**2 + 2 * 0.5**2 + 2**2
    )  # of 1.5 u^2 + 0.5 uv - v^2


@pytest.mark.parametrize("template", [grid_template, tube_template])
def test_towards_goes_on_with_the_motion(template):
    chart = Atlas(template())
    a, b = some_state(chart, RNG), some_state(chart, RNG)
    assert np.allclose(a.extrapolated(b, 0).alpha, b.alpha) and np.allclose(
        a.extrapolated(b, -1).offset, a.offset
    )
    c = a.extrapolated(b, 1)
    turns = c.rotation * b.rotation.inv() * (b.rotation * a.rotation.inv()).inv()
    assert turns.magnitude().max() < 1e-12
    assert np.allclose(b.difference(a), -a.difference(b)) and not a.difference(a).any()


@pytest.mark.parametrize("template", [grid_template, tube_template])
def test_rigid_motion_moves_a_surface(template):
    chart = Atlas(template())
    turn, shift = Rotation.from_rotvec([0.2, -0.1, 0.3]), np.array([0.02, -0.01, 0.05])
    for state in (at_rest(chart), some_state(chart, RNG)):
        moved = chart.surface(chart.moved(state, turn, shift)).vertices
        assert np.allclose(moved, turn.apply(chart.surface(state).vertices) + shift)


def test_absorbed_leaves_the_surface_and_as_little_relief_as_the_jet_can():
    chart = Atlas(grid_template(13, 14, order=4))
    state = some_state(chart, RNG)
    fine = (
        state.offset[:, 2] + chart.surface(state).basis @ RNG.normal(size=len(chart.bending)) * 0.1
    )
    state = dataclasses.replace(state, offset=np.column_stack([state.offset[:, :2], fine]))
    found = chart.with_relief_in_jets(state, ridge=1e-12)
    assert np.allclose(chart.surface(found).vertices, chart.surface(state).vertices, atol=1e-12)
    basis = chart.surface(state).basis
    assert np.abs(basis.T @ fine).max() > 0.1 and np.abs(basis.T @ found.offset[:, 2]).max() < 1e-6


def test_absorbed_leaves_the_surface_of_several_patches():
    chart = Atlas(tube_template(15, 24))
    state = some_state(chart, RNG, 0.02)
    x = chart.template.vertices
    smooth = 0.05 * np.sin(20 * x[:, 0]) * np.cos(15 * x[:, 1])
    state = dataclasses.replace(state, offset=np.column_stack([state.offset[:, :2] * 0.2, smooth]))
    found = chart.with_relief_in_jets(state)
    apart = chart.surface(found).vertices - chart.surface(state).vertices
    assert np.abs(apart).max() < 1e-5 * chart.template.scale
    assert np.linalg.norm(found.offset[:, 2]) < 0.5 * np.linalg.norm(state.offset[:, 2])


def test_slides_are_differences_in_turned_axes():
    """Displacements that are one vector of a plane slide nothing, whatever the axes; others are
    what each edge's first end sees of them.
    """
    template = grid_template()
    plane = synthetic.sheet(0.0, 6, 7)
    angle = RNG.uniform(-np.pi, np.pi, len(plane))
    axes = Rotation.from_rotvec(angle[:, None] * [0, 0, 1.0]).as_matrix()
    shift = RNG.normal(size=(len(plane), 3)) * [1, 1, 0]
    in_axes = lambda moved: np.einsum("nij,ni->nj", axes, moved)[:, :2].ravel()
    difference = slides(template.edges, axes)
    assert np.abs(difference @ in_axes(np.tile([0.3, -0.2, 0], (len(plane), 1)))).max() < 1e-12
    a, b = template.edges.T
    seen = np.einsum("nij,ni->nj", axes[a], shift[a] - shift[b])[:, :2]
    assert np.abs(difference @ in_axes(shift) - seen.ravel()).max() < 1e-12


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
    across, bends = hinges(np.column_stack([chart, np.zeros(len(chart))]), faces)
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


@pytest.mark.parametrize("shape", TEMPLATES)
def test_a_state_that_reaches_given_vertices(shape):
    chart = Atlas(TEMPLATES[shape](order=4))
    start, wanted = (some_state(chart, RNG, size) for size in (0.01, 0.02))
    vertices = chart.surface(wanted).vertices
    found = chart.reaching(vertices, start)
    assert np.abs(chart.surface(found).vertices - vertices).max() < 1e-9
    assert np.array_equal(found.alpha, start.alpha)  # by the displacements alone
