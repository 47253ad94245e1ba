"""Problems of the tracker from folders that :mod:`synthetic` makes, templates of grids, and normal
equations written out. Import only where a Mitsuba variant is set."""

import dataclasses

import numpy as np
import synthetic
from scipy.spatial.transform import Rotation
from worn import arm

from polysft_mi import prepare
from polysft_mi.objective import Objective, Problem
from polysft_mi.scene import experiment as scene
from polysft_mi.surface.atlas import State
from polysft_mi.surface.template import Template


def small_cloth(folder, frames):
    """A cloth of 9 x 12 vertices in images of 160 x 120, in the new folder ``folder``/cloth."""
    return synthetic.cloth(folder / "cloth", frames=frames, size=(160, 120), rows=9, columns=12)


def small_tube(folder, frames):
    """A sleeve of 9 x 18 vertices, whose texture has a seam, in images of 160 x 120, in the new
    folder ``folder``/tube.
    """
    return synthetic.cloth(
        folder / "tube", frames=frames, size=(160, 120), rows=9, columns=18, shape=synthetic.tube
    )


def problem_of(folder, rules=None, **settings):
    """The problem of a folder of :mod:`synthetic`, under ``rules`` and settings."""
    prepare.main([str(folder), "--overwrite"])
    experiment = scene.load(str(folder / "scene.xml"), settings)
    return Problem(experiment, experiment.sequence(), rules)


def on_an_arm(problem, rng):
    """A problem of a sleeve, on an arm that bends, in drapes that are not the template."""
    template, count = problem.template, len(problem.sequence)
    draped = 3e-3 * rng.normal(size=(count, *template.vertices.shape))
    bend, places = 0.2 * np.arange(count), 0.01 * rng.normal(size=(count, 3))
    problem.sequence.carrier = arm(template.vertices, bend, places, draped, template.faces)
    worn = Problem(problem.experiment, problem.sequence, problem.rules)
    worn.settings = dataclasses.replace(worn.settings, body="known")
    return worn


def data_of(problem):
    """The :class:`polysft_mi.images.data_term.DataTerm` of a problem."""
    return Objective(problem).data


def grid_template(rows=6, columns=7, order=4, bend=4.0):
    vertices = synthetic.sheet(0.7, rows, columns, bend=bend)
    v, u = np.meshgrid(np.linspace(1, 0, rows), np.linspace(0, 1, columns), indexing="ij")
    return Template.fit(
        vertices,
        synthetic.grid_faces(rows, columns),
        np.stack([u, v], -1).reshape(-1, 2),
        order,
    )


def tube_template(rows=9, columns=18, order=4):
    """A sleeve, held by three patches or more."""
    return Template.fit(
        synthetic.tube(0.4, rows, columns), *synthetic.tube_faces(rows, columns), order
    )


def some_state(chart, rng, size=0.05):
    """A state of random unknowns of about ``size``."""
    n, (k, a) = len(chart.template.vertices), chart.template.alpha.shape
    turns = Rotation.from_rotvec(rng.normal(size=(k, 3)) * size)
    return State(
        rng.normal(size=(k, a)) * size,
        rng.normal(size=(n, 3)) * size,
        turns,
        rng.normal(size=(k, 3)) * size,
    )


def at_rest(chart):
    """The state of the undeformed template."""
    t = chart.template
    return State(
        np.zeros(t.alpha.shape),
        np.zeros(t.vertices.shape),
        Rotation.identity(len(t)),
        np.zeros((len(t), 3)),
    )


def dense(pattern, normal):
    """The matrix and the gradient of normal equations, local unknowns first."""
    d = normal.local.shape[-1]
    n = d * pattern.count
    h = np.zeros((n, n))
    for i, j, block in zip(pattern.row, pattern.column, normal.local):
        h[d * i : d * i + d, d * j : d * j + d] = block
    return np.block([[h, normal.cross], [normal.cross.T, normal.glob]]), np.concatenate(
        [normal.local_gradient.ravel(), normal.gradient]
    )
