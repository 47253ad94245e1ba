"""The jet patch on the host: against the device and polyfit, derivatives by finite differences."""

import dataclasses

import numpy as np
import pytest
import synthetic
import torch
from problems import grid_template, some_state
from scipy.spatial.transform import Rotation

from polyfit import jets
from polysft_mi.surface.bending import hinges
from polysft_mi.surface.atlas import Atlas, State
from polysft_mi.surface.patch import Unknowns

RNG = np.random.default_rng(4)


@pytest.mark.parametrize("order", [1, 4, 7, 10])
def test_chart_is_the_jet_of_polyfit(order):
    template = grid_template(13, 14, order=order)
    chart = Atlas(template)
    state = some_state(chart, RNG)
    arrays = chart.arrays(state)
    uv = template.chart + state.offset[:, :2]
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
    chart = Atlas(problem.template)
    state = some_state(chart, RNG)
    device = problem.surface(Unknowns.from_numpy(chart.arrays(state)))
    assert (
        np.abs(device - chart.surface(state).vertices).max() < 1e-5
    )  # m; what single precision leaves of monomials


@pytest.mark.parametrize("order", [4, 10])
def test_derivatives_of_the_surface(order):
    chart = Atlas(grid_template(13, 14, order=order))
    state = some_state(chart, RNG)
    step = (
        RNG.normal(size=len(chart.bending) + 6) * 1e-5,
        RNG.normal(size=state.offset.shape) * 1e-5,
    )
    s = chart.surface(state)
    a = len(chart.bending)
    linear = (
        (s.basis @ step[0][:a])[:, None] * s.up
        + s.motion_jacobian @ step[0][a:]
        + np.einsum("nka,na->nk", s.offset_jacobian, step[1])
    )
    numeric = (
        chart.surface(state.after_step(step)).vertices
        - chart.surface(state.after_step(step, -1)).vertices
    ) / 2
    assert np.abs(linear - numeric).max() < 1e-6 * np.abs(numeric).max()


def test_bending_is_the_mean_square_of_second_derivatives():
    chart = Atlas(grid_template())
    state = dataclasses.replace(
        some_state(chart, RNG),
        alpha=np.linalg.solve(chart.to_monomials, np.array([0, 0, 0, 1.5, 0.5, -1, *np.zeros(9)])),
    )
    assert state.alpha @ chart.bending @ state.alpha == pytest.approx(
        3**2 + 2 * 0.5**2 + 2**2
    )  # of 1.5 u^2 + 0.5 uv - v^2


def test_towards_goes_on_with_the_motion():
    chart = Atlas(grid_template())
    a, b = some_state(chart, RNG), some_state(chart, RNG)
    assert np.allclose(a.extrapolated(b, 0).alpha, b.alpha) and np.allclose(
        a.extrapolated(b, -1).offset, a.offset
    )
    c = a.extrapolated(b, 1)
    assert (
        c.rotation * b.rotation.inv() * (b.rotation * a.rotation.inv()).inv()
    ).magnitude() < 1e-12


def test_rigid_motion_moves_the_template():
    chart = Atlas(grid_template())
    rest = State(np.zeros(15), np.zeros((42, 3)), Rotation.identity(), np.zeros(3))
    turn, shift = Rotation.from_rotvec([0.2, -0.1, 0.3]), np.array([0.02, -0.01, 0.05])
    state = State(rest.alpha, rest.offset, *chart.rigid(turn, shift))
    assert np.allclose(
        chart.surface(state).vertices, turn.apply(chart.surface(rest).vertices) + shift
    )


def test_fitted_finds_the_state_of_given_vertices():
    chart = Atlas(grid_template(11, 11))
    rest = State(np.zeros(15), np.zeros((121, 3)), Rotation.identity(), np.zeros(3))
    smooth = some_state(chart, RNG, 0.03)
    smooth.offset[:, 2] = 0
    goal = chart.surface(smooth).vertices
    found = chart.fitted(rest, goal, 20)
    assert np.abs(chart.surface(found).vertices - goal).max() < 2e-4


def test_absorbed_leaves_the_surface_and_as_little_relief_as_the_jet_can():
    chart = Atlas(grid_template(13, 14, order=4))
    state = some_state(chart, RNG)
    fine = (
        state.offset[:, 2] + chart.surface(state).basis @ RNG.normal(size=len(chart.bending)) * 0.1
    )
    state = dataclasses.replace(state, offset=np.column_stack([state.offset[:, :2], fine]))
    found = chart.with_relief_in_jet(state, ridge=1e-12)
    assert np.allclose(chart.surface(found).vertices, chart.surface(state).vertices, atol=1e-12)
    basis = chart.surface(state).basis
    assert np.abs(basis.T @ fine).max() > 0.1 and np.abs(basis.T @ found.offset[:, 2]).max() < 1e-6


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
