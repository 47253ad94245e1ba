"""What physics tells of hidden cloth: cloth that is held where it is seen."""

import numpy as np
from scripts import load

from onefit.physics import MATERIALS, Sheet

physics = load("benchmarks/physics.py")


def strip(count=6):
    """Vertices (N, 3) [m] and faces (F, 3) of a strip of 2 cm along x, z up."""
    x = 0.02 * np.arange(count)
    vertices = np.stack([np.repeat(x, 2), np.tile([0, 0.02], count), np.zeros(2 * count)], 1)
    faces = [[k, k + 2, k + 1] for k in range(0, 2 * count - 2, 2)]
    faces += [[k + 1, k + 2, k + 3] for k in range(0, 2 * count - 2, 2)]
    return vertices, np.array(faces)


def test_what_is_held_follows_and_the_rest_falls():
    rest, faces = strip()
    holds = np.zeros((10, len(rest)), dtype=bool)
    holds[:, :4] = True
    targets = rest + np.linspace(0, 0.01, 10)[:, None, None] * [0, 0, 1]
    found = physics.free_cloth(Sheet(rest, faces, MATERIALS["cotton"]), targets, holds)
    assert np.abs(found - targets)[holds].max() < 2e-3
    assert (found[-1, 8:, 2] < -0.01).all()


def test_only_what_lies_well_inside_the_view_holds():
    _, faces = strip(10)
    shown = np.arange(20) < 12
    found = physics.inside(shown, faces)
    assert found[:8].all() and not found[8:].any()


def test_time_goes_evenly_from_frame_to_frame():
    frames = np.array([[0.0], [2.0], [6.0]])
    assert [physics.between(frames, t)[0] for t in (0, 0.5, 1, 1.75, 2)] == [0, 1, 2, 5, 6]
