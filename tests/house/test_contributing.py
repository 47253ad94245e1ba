"""The term that CONTRIBUTING shows is one: its two forms agree, and both solvers take it."""

import dataclasses
import re

import numpy as np
import pytest
from places import ROOT
from problems import problem_of, small_cloth

from polysft_mi.objective import FrameContext, Objective
from polysft_mi.solvers.adam import Adam
from polysft_mi.solvers.gauss_newton import GaussNewton


@pytest.fixture
def objective(tmp_path):
    """An objective of the shown term and of lengths."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    names = {}
    exec(re.search(r"```python\n(.*?)```", text, re.S)[1], names)
    weights = dict(k_rgb=0.0, k_silhouette=0.0, k_shading=0.0, k_chroma=0.0, k_tc=0.0)
    found = Objective(problem_of(small_cloth(tmp_path, frames=1).folder, order=3, **weights))
    inputs = dataclasses.replace(found.inputs, settings=_Weighted(found.settings))
    found.terms.append(names["Plane"](inputs))
    return found


class _Weighted:
    """Settings with the weight of the shown term."""

    k_plane = 20.0

    def __init__(self, settings):
        self._settings = settings

    def __getattr__(self, name):
        return getattr(self._settings, name)


@pytest.mark.parametrize("name", ["gauss-newton", "adam"])
def test_a_term_of_ones_own_is_minimised(objective, name):
    rest = objective.atlas.state(objective.problem.patch.rest().to_numpy())
    frozen = objective.frozen([FrameContext(0, rest)], objective.usual[-1], [rest])
    settings = dataclasses.replace(objective.settings, period=40, lr_rigid=1e-2)
    solver = GaussNewton(objective.rules) if name == "gauss-newton" else Adam(settings)
    said = []
    report = lambda iteration, total, terms: said.append(terms["plane"])
    result = solver.minimise(frozen, [rest], report=report)
    depth = objective.atlas.surface(rest).vertices[:, 2]
    assert said[0] == pytest.approx(20 * ((depth.mean() - 0.6) ** 2), rel=0.1)
    assert result.terms["plane"] < 0.2 * said[0]
    found = objective.atlas.surface(result.states[0]).vertices[:, 2]
    assert abs(found.mean() - 0.6) < 0.5 * abs(depth.mean() - 0.6)


def test_its_two_forms_agree(objective):
    rest = objective.atlas.state(objective.problem.patch.rest().to_numpy())
    frozen = objective.frozen([FrameContext(0, rest)], objective.usual[-1], [rest])
    (model,) = frozen.quadratic([rest])
    _, terms = frozen.evaluate([objective.problem.patch.rest()])
    assert terms["plane"] == pytest.approx(model.terms["plane"], rel=1e-4)
    shift = np.array([0, 0, 1e-4])
    ends = []
    for sign in (1, -1):
        state = dataclasses.replace(rest, translation=rest.translation + sign * shift)
        ends.append(frozen.quadratic([state])[0].terms["plane"])
    assert model.normal.gradient[-1] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=0.05)
