"""Buttons and buckles hold cloth together, from the file to the simulation."""

import numpy as np
import pytest
import scripts
from surfaces import joined, sheet, sphere

import onefit
from onefit.garment import Garment
from onefit.garment.reading.render_mesh import RenderMesh
from onefit.garment.reading.stitches import stitched
from onefit.physics import Settings


def found(cloth, *buttons):
    V, F = joined(cloth, *buttons)
    return stitched(RenderMesh.bound(V, F, None, *cloth), *cloth)


def layers(gap):
    """Two sheets, one ``gap`` [m] above the other."""
    V, F = sheet(size=0.2)[:2]
    return joined((V, F), (V + [0, 0, gap], F))


def button(place, radius=0.006):
    V, F = sphere(radius, 1)
    return V * [1, 1, 0.5] + place, F


def test_a_button_holds_two_layers_not_one():
    one, two = sheet(size=0.2)[:2], layers(0.008)
    assert len(found(one, button([0.01, 0.02, 0.004]))) == 0
    stitches = found(two, button([0.01, 0.02, 0.004]))
    assert len(stitches) == 1 and stitches.lengths[0] == pytest.approx(0.012, abs=0.005)
    upper = len(two[0]) // 2
    assert (stitches.start[0] < upper) != (stitches.corners[0] < upper).all()
    end = stitches.barycentric[0] @ two[0][stitches.corners[0]]
    assert np.abs(end[:2] - [0.01, 0.02]).max() < 0.01
    pairs, lengths = stitches.edges(two[0])
    assert lengths == pytest.approx(
        np.linalg.norm(two[0][pairs[:, 0]] - two[0][pairs[:, 1]], axis=1)
    )


def test_what_is_too_far_away_holds_nothing():
    assert len(found(layers(0.05), button([0, 0, 0.006]))) == 0


def test_parts_that_touch_are_one_buckle():
    cloth = layers(0.03)
    lower, upper = button([0, 0, 0.004]), button([0, 0, 0.026])
    middle = button([0, 0, 0.015], 0.012)
    assert len(found(cloth, lower, upper)) == 0
    assert len(found(cloth, lower, middle, upper)) == 1


@pytest.mark.parametrize("buttons", [0, 5])
def test_a_buttoned_front_stays_closed(buttons):
    V, F, _, (left, right) = scripts.load("docs/onefit_file.py").cut_open("tank", buttons)
    garment = Garment.of_mesh("top", V, F)
    assert len(garment.stitches) == buttons
    quick = Settings(lead=0.3, settling=0.1)
    motion = onefit.Motion.generate("dance", seconds=0.3)
    drape = onefit.load().simulate(garment, motion, settings=quick)
    seen = drape.render_vertices()
    gap = np.linalg.norm(seen[:, left] - seen[:, right], axis=2).mean(axis=1)
    assert gap[-1] < 0.015 if buttons else gap[-1] > 0.05
    assert drape.measures().collision == 0
