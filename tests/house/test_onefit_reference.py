"""The reference by simulation: what it hands to the simulator, and the figures it prints. The
simulator itself need not be installed.
"""

import importlib.util

import cloth_simulation as simulation
import numpy as np
import pytest
import torch
from scripts import load

import onefit
from onefit.garment import Garment, standard_body
from onefit.objective.folds import inner_edges
from onefit.physics import MATERIALS
from polyfit.errors import InputError

reference = load("benchmarks/onefit_reference.py")


def tube(radius, n=64, rows=12):
    """A tube of even triangles around z: vertices (N, 3) [m], faces (F, 3), area [m^2]."""
    side = 2 * np.pi * radius / n
    k = np.arange(n)
    after = (k + 1) % n
    turn = 2 * np.pi * (k[None] + 0.5 * (np.arange(rows) % 2)[:, None]) / n
    z = np.broadcast_to(np.arange(rows)[:, None] * side * np.sqrt(3) / 2, turn.shape)
    V = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], -1).reshape(-1, 3)
    F = []
    for r in range(rows - 1):
        a, b = r * n, (r + 1) * n
        if r % 2 == 0:
            F += [
                np.stack([a + k, a + after, b + k], 1),
                np.stack([a + after, b + after, b + k], 1),
            ]
        else:
            F += [
                np.stack([a + k, b + after, b + k], 1),
                np.stack([a + k, a + after, b + after], 1),
            ]
    F = np.concatenate(F)
    return V, F, 2 * np.pi * radius * side * np.sqrt(3) / 2 * (rows - 1)


def sides_of(V, F):
    return np.linalg.norm(V[np.roll(F, -1, axis=1)] - V[F], axis=2)


def test_triangles_laid_flat_have_their_sides():
    V, F, area = tube(0.1)
    sides = sides_of(V, F)
    flat = simulation.flattened(sides)
    one, two = flat[:, :, 0], flat[:, :, 1]
    found = np.stack([np.linalg.norm(x, axis=1) for x in (one, two - one, two)], 1)
    assert found == pytest.approx(sides, rel=1e-9)
    assert np.linalg.det(flat).sum() / 2 == pytest.approx(area, rel=0.002)


def test_a_bent_tube_costs_half_of_its_stiffness_times_squared_curvature_and_area():
    radius, bending = 0.08, 1e-5
    V, F, area = tube(radius)
    edges, pair = (x.numpy() for x in inner_edges(torch.as_tensor(F)))
    opposite = [
        [next(v for v in F[f] if v not in e) for f in fs]
        for e, fs in zip(edges.tolist(), pair.tolist())
    ]
    length, stiffness = simulation.hinges(
        np.concatenate([opposite, edges], 1), F, sides_of(V, F), bending
    )
    assert length == pytest.approx(np.linalg.norm(V[edges[:, 0]] - V[edges[:, 1]], axis=1))
    normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.arccos(np.clip((normal[pair[:, 0]] * normal[pair[:, 1]]).sum(1), -1, 1))
    energy = (stiffness * length * angle**2 / 2).sum()
    assert energy == pytest.approx(bending / 2 / radius**2 * area, rel=0.12)


def test_between_frames_a_parabola_is_a_parabola():
    t = np.arange(6.0)
    frames = np.stack([0.3 * t**2 - t, t, 0 * t], -1)[:, None]
    for time in (1.0, 1.25, 3.9):
        value, slope = simulation.between(frames, time)
        assert value[0] == pytest.approx([0.3 * time**2 - time, time, 0])
        assert slope[0] == pytest.approx([0.6 * time - 1, 1, 0])


def test_air_resists_along_the_normal_with_the_squared_speed():
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    v = np.tile([3.0, 0.0, 2.0], (3, 1))
    force = simulation.pressure(x, v, np.array([[0, 1, 2]]), drag=1.1)
    assert force.sum(0) == pytest.approx([0, 0, -1.1 / 2 * simulation.AIR * 0.5 * 2.0**2])


@pytest.fixture(scope="module")
def tank():
    draper, garment = onefit.load(), Garment.template("tank")
    motion = onefit.Motion.generate("walk", seconds=0.3, seed=3)
    return garment, motion, draper.drape(garment, motion, skinning_only=True)


def test_a_row_tells_what_is_wrong_with_a_drape(tank):
    garment, _, skinned = tank
    row = lambda x: reference.figures(x, skinned, garment, skinned.rest)
    wave, _, swing, hang, strain, inside, faces, _, rims, crossed = row(skinned.vertices)
    assert wave < 2 and swing == hang == rims == 0 and 1 < strain < 10 and inside < 5 > faces
    pierced = skinned.vertices.clone()
    pierced[:, garment.vertices[:, 1] > 0, 1] -= 0.5  # one side through the other
    assert row(pierced)[9] > crossed + 20
    slid = skinned.vertices.clone()
    slid[..., 2] -= 0.05  # off the shoulders
    worse = row(slid)
    assert worse[8] == pytest.approx(50, abs=0.1) and worse[3] == pytest.approx(50, abs=0.1)
    assert worse[5] > 5 and worse[6] > 5


@pytest.mark.skipif(importlib.util.find_spec("newton") is not None, reason="newton is installed")
def test_without_the_simulator_one_line_says_what_to_install(tank, tmp_path):
    garment, motion, _ = tank
    with pytest.raises(InputError, match="pip install newton"):
        reference.simulated(
            str(tmp_path), garment, motion, standard_body(), MATERIALS["cotton"],
            simulation.Settings(),
        )  # fmt: skip
