"""Frames of the second-order solver against the truth; its decisions one by one."""

import itertools
import math
import shutil

import cv2
import numpy as np
import pytest
import synthetic
from problems import problem_of
from scipy.linalg import LinAlgError

from polysft_mi import solvers
from polysft_mi.errors import InputError
from polysft_mi.images.light import Light
from polysft_mi.images.registration import Registration
from polysft_mi.objective.second_order import Context, SecondOrder
from polysft_mi.scene.rules import Rules
from polysft_mi.scene.settings import Settings
from polysft_mi.solvers.gauss_newton import GaussNewton
from polysft_mi.solvers.gauss_newton.descent import Descent, Found, check_step
from polysft_mi.solvers.gauss_newton.relocate import Relocator
from polysft_mi.solvers.gauss_newton.starts import Starts
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import track

RNG = np.random.default_rng(4)


def test_texture_is_fitted_to_the_first_frame(truth, tmp_path):
    moved = tmp_path / "moved"
    moved.mkdir()
    for name in ("frames", "masks", "camera.json", "texture.png"):
        (moved / name).symlink_to(truth.folder / name)
    synthetic.write_obj(
        moved / "template.obj", truth.vertices[0], 0.02 + 0.96 * truth.uv, truth.faces
    )
    misfit = []
    for fit in ("none", "auto"):
        problem = problem_of(moved, rules=Rules(texture_misfit=0.0), last=0, texture_fit=fit)
        solver = GaussNewton(problem.settings)
        solver._prepare(problem, None)
        finest = solver._descent.usual[-1].blur
        misfit.append(solver._images.misfit(problem.template.vertices, 0, finest))
    assert misfit[1] < 0.6 * misfit[0], misfit


def test_tracks_a_bending_sheet_and_says_how_sure_it_is(truth, tracked, tmp_path):
    problem = problem_of(truth.folder)
    assert problem.settings.solver == "gauss-newton"
    error = [
        np.linalg.norm(problem.surface(Unknowns.from_numpy(s)) - t, axis=1)
        for s, t in zip(tracked.states, truth.vertices)
    ]
    flat = np.linalg.norm(truth.vertices[-1] - truth.vertices[0], axis=1)
    assert max(x.mean() for x in error) < 0.003 and error[-1].mean() < 0.15 * flat.mean()
    assert set(tracked.sigma) == {0, 1, 2, 3} and all(
        s.shape == (108,) and (s > 0).all() for s in tracked.sigma.values()
    )
    again = track(problem, solvers.create(problem.settings), 4, str(tmp_path))
    for a, b in zip(tracked.states, again.states, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a)


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


@pytest.mark.parametrize(
    "explained, misfits, passes, kept, vain",
    [
        (0.03, [0.1, 0.08, 0.0795, 0.01], 3, 2, False),  # until it gains little
        (0.03, [0.2 * 0.9**k for k in range(12)], 9, 8, False),  # or eight times
        (0.03, [0.1, 0.025, 0.01], 2, 1, False),  # or it is explained
        (0.03, [0.1, 0.11, 0.01], 2, 0, True),  # what is worse is not kept
        (0.03, [0.1, 0.0995, 0.01], 2, 1, True),
        (0.03, [0.025, 0.01], 1, 0, False),
        (0.005, [0.015, 0.01], 1, 0, False),
        (None, [0.3, 0.01], 1, 0, False),  # the first frame
    ],
)
def test_what_is_not_explained_goes_through_the_fine_stages_again(
    problem, monkeypatch, explained, misfits, passes, kept, vain
):
    descent, seen = Descent(SecondOrder(problem)), []

    class Pass(Found):
        misfit = cost = property(lambda self: misfits[self.state])

    def stage_by_stage(state, context, stages, iterations):
        seen.append((state, stages))
        return Pass(len(seen) - 1, None, {})

    monkeypatch.setattr(descent, "_stages", stage_by_stage)
    noise = math.nan if explained is None else 0.0
    context = Context(5, None, noise, Light.unknown(Rules()), {}, explained or 0.0)
    every = descent.far, *descent.usual
    found = descent.descend(-1, context, every)
    assert seen[0] == (-1, every)
    assert seen[1:] == [(k, descent.usual[1:]) for k in range(passes - 1)]
    assert found.state == kept and found.more_is_vain == vain


def test_what_is_suspect_is_measured_from_the_noise(problem):
    starts = Starts(problem, Descent(SecondOrder(problem)))
    usual = [0.9, 0.21, 0.22, 0.24, 0.23, 0.22]
    assert starts._suspect_above(usual, 0.2) == pytest.approx(0.2 + 1.25 * 0.02 + 0.03)
    assert starts._suspect_above(usual, 0.0) == pytest.approx(1.25 * 0.22 + 0.03)
    assert starts._suspect_above([0.2, 0.2], 0.0) == math.inf


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


def test_steps_that_lead_nowhere_are_refused():
    uv, g = np.zeros((5, 2)), np.zeros(10)
    check_step((g, uv), 1)
    g[0] = 100.0  # of the coefficients: no bound
    check_step((g, uv), 1)
    for bad in ((g + np.eye(10)[9] * 3, uv), (g, uv - 3), (g * np.nan, uv)):
        with pytest.raises(LinAlgError):
            check_step(bad, 1)


def test_large_templates_have_no_relief(truth, tmp_path):
    count = len(truth.vertices[0])
    problem = problem_of(truth.folder, rules=Rules(relief_vertices=count - 1))
    done = track(problem, solvers.create(problem.settings), 3, str(tmp_path))
    assert not done.states[-1]["delta_w"].any()


def test_relief_moves_only_where_it_may(truth, tracked, tmp_path):
    """Not in the first frame, nor where its weight is zero; else the more it weighs, the less there
    is of it.
    """
    found = {}
    for weight, frames in ((0.0, 2), (10.0, 4)):
        problem = problem_of(truth.folder, k_relief=weight)
        out = tmp_path / str(weight)
        out.mkdir()
        found[weight] = track(problem, solvers.create(problem.settings), frames, str(out))
    assert not any(x.states[0]["delta_w"].any() for x in (tracked, *found.values()))
    none, little, usual = (
        np.abs(x.states[-1]["delta_w"]).mean() for x in (found[0.0], found[10.0], tracked)
    )
    assert none == 0 < little < 0.1 * usual


def test_noise_is_the_least_misfit_but_for_the_first_frame(problem):
    """The first frame fits itself: the texture was taken from it."""
    solver = GaussNewton(problem.settings)
    solver._prepare(problem, None)
    noise = lambda known: solver._context(1, None, known).noise
    assert math.isnan(noise([]))
    first = {"misfit": 0.01, "least_misfit": None}  # as a checkpoint has it
    assert noise([first]) == 0.01
    known = [first, {"misfit": 0.03, "least_misfit": 0.03}, {"misfit": 0.05, "least_misfit": 0.03}]
    assert noise(known) == 0.03 and noise([*known, {}]) == 0.03


def test_the_least_misfit_goes_from_frame_to_frame(truth, tracked):
    problem = problem_of(truth.folder)
    misfit, least = ([t[name] for t in tracked.totals] for name in ("misfit", "least_misfit"))
    assert least[0] is None and least[-1] > 0
    assert all(b <= a for a, b in itertools.pairwise(least[1:]))
    images, finest = Registration(problem), problem.rules.blurs[-1]
    bare = [
        images.misfit(problem.surface(Unknowns.from_numpy(s)), k, finest)
        for k, s in enumerate(tracked.states)
    ]
    # of the texture as the template has it
    assert least[1] == pytest.approx(bare[1], rel=0.02)
    assert least[-1] == pytest.approx(min(bare[1:]), rel=0.1)
    assert misfit[1] < 0.9 * least[1]  # the sheet's own image explains the frame better


@pytest.mark.parametrize(
    "rows, columns, asked, order", [(9, 12, {}, 8), (9, 12, {"order": 3}, 3), (5, 6, {}, 4)]
)
def test_order_of_the_jet(tmp_path, rows, columns, asked, order):
    """Eight, as far as the vertices determine it, or what is asked."""
    still = synthetic.cloth(
        tmp_path / "still", frames=1, size=(160, 120), rows=rows, columns=columns, bend=0.0
    )
    problem = problem_of(still.folder, **asked)
    solution = solvers.create(problem.settings).solve(problem, [problem.patch.rest()], [0])
    assert problem.template.order == order
    assert solution.window[0].to_numpy()["delta_alpha"].size == (order + 1) * (order + 2) // 2


def test_settings_that_do_not_go_together():
    with pytest.raises(InputError, match="one of them looks both ways"):
        solvers.create(Settings(window=3, smooth=0.1))
    with pytest.raises(InputError, match="window = 1, or sweeps = 0"):
        solvers.create(Settings(window=3, sweeps=1))
    with pytest.raises(InputError, match="sweeps = 1 with solver = adam"):
        solvers.create(Settings(solver="adam", sweeps=1))
    with pytest.raises(InputError, match="gain"):
        solvers.create(Settings(brightness="gain"))
    assert Settings().width == 1 and Settings(solver="adam").width == 3
    assert Settings().lighting == "local" and Settings(solver="adam").lighting == "none"
    cases = Settings(), Settings(solver="adam"), Settings(order=6)
    assert [[s.jet_order(patches) for patches in (1, 3)] for s in cases] == [[8, 5], [4, 4], [6, 6]]
