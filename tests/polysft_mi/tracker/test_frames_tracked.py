"""Frames of the tracker against the truth, and what it decides by."""

import copy
import itertools
import math
import shutil

import cv2
import numpy as np
import pytest
import synthetic
from problems import data_of, problem_of

from polysft_mi.objective import FrameContext, FrameMemory, Objective
from polysft_mi.scene.rules import Rules
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import CHECKPOINT, FrameTracker, Track, track
from polysft_mi.tracker.relocate import TemplateFeatures, rigid_motion

PCA = {"canonical_frame": "pca", "patches": 0}


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
        problem = problem_of(moved, rules=Rules(margin=0.0), last=0, texture_fit=fit)
        tracker = FrameTracker(problem)
        tracker.solve([problem.atlas.state(problem.patch.rest().to_numpy())], [0])
        objective = tracker.objective
        data, finest = objective.data, objective.usual[-1].blur
        misfit.append(data.misfit(problem.template.vertices, 0, finest))
    assert misfit[1] < 0.6 * misfit[0], misfit


def test_tracks_a_bending_sheet_and_says_how_sure_it_is(truth, tracked, tmp_path):
    problem = problem_of(truth.folder)
    assert tracked.solver == "gauss-newton"
    error = [
        np.linalg.norm(problem.surface(Unknowns.from_numpy(s)) - t, axis=1)
        for s, t in zip(tracked.states, truth.vertices)
    ]
    flat = np.linalg.norm(truth.vertices[-1] - truth.vertices[0], axis=1)
    assert max(x.mean() for x in error) < 0.003 and error[-1].mean() < 0.15 * flat.mean()
    assert set(tracked.certainty) == {0, 1, 2, 3} and all(
        s.shape == (2, 108) and (s > 0).all() for s in tracked.certainty.values()
    )
    again = track(FrameTracker(problem), 4, str(tmp_path))
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
    found = TemplateFeatures(data_of(problem))
    motion_in = lambda image: rigid_motion(problem.camera, *found.matches(image))
    turn, shift = motion_in(problem.sequence.frame(1))
    there = turn.apply(truth.vertices[0]) + shift
    assert (
        np.linalg.norm(there - truth.vertices[1], axis=1).mean()
        < 0.006
        < 0.1 * np.linalg.norm(truth.vertices[1] - truth.vertices[0], axis=1).max()
    )
    assert motion_in(np.zeros((240, 320, 3), np.float32)) is None


def test_tracks_tell_where_a_sheet_jumped_to(tmp_path):
    """Those whose points are known and that are seen there; where there are too few, none do."""
    truth = synthetic.cloth(
        tmp_path / "cloth", frames=2, size=(320, 240), bend=0.3, turn=0.4, shift=0.04
    )
    camera = problem_of(truth.folder).camera
    places = np.stack([camera.project(v)[0] for v in truth.vertices])
    visible = np.ones(places.shape[:2], bool)
    visible[1, ::3] = False
    places[1, ::3] += 100
    np.savez(tmp_path / "tracks.npz", tracks=places, visible=visible)
    objective = Objective(problem_of(truth.folder, tracks=str(tmp_path / "tracks.npz")))
    objective.observe(0, truth.vertices[0])
    points, pixels = objective.matches(1, truth.vertices[0])
    turn, shift = rigid_motion(camera, points, pixels)
    there = turn.apply(truth.vertices[0]) + shift
    assert (
        np.linalg.norm(there - truth.vertices[1], axis=1).mean()
        < 0.006
        < 0.1 * np.linalg.norm(truth.vertices[1] - truth.vertices[0], axis=1).max()
    )
    assert rigid_motion(camera, points[:5], pixels[:5]) is None


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
    done = track(FrameTracker(problem), 4, str(tmp_path))
    for state in done.states:
        vertices = problem.surface(Unknowns.from_numpy(state))
        assert (
            np.isfinite(vertices).all()
            and np.linalg.norm(vertices - truth.vertices[0], axis=1).max() < 1.0
        )
        assert problem.visible_share(vertices) > 0.5
    assert not done.lost


def test_large_templates_have_no_relief(truth, tmp_path):
    count = len(truth.vertices[0])
    problem = problem_of(truth.folder, rules=Rules(relief_vertices=count - 1))
    done = track(FrameTracker(problem), 3, str(tmp_path))
    assert not done.states[-1]["delta_w"].any()


def test_relief_moves_only_where_it_may(truth, tracked, tmp_path):
    """Not in the first frame, nor where its weight is zero, nor in noise; else the more it weighs,
    the less there is of it.
    """
    found = {}
    for weight, frames in ((0.0, 2), (10.0, 4)):
        problem = problem_of(truth.folder, k_relief=weight)
        out = tmp_path / str(weight)
        out.mkdir()
        found[weight] = track(FrameTracker(problem), frames, str(out))
    assert not any(x.states[0]["delta_w"].any() for x in (tracked, *found.values()))
    none, little, usual = (
        np.abs(x.states[-1]["delta_w"]).mean() for x in (found[0.0], found[10.0], tracked)
    )
    assert none == 0 < little < 0.1 * usual
    noisy = Rules(noise_misfit=1e-6)
    done = track(FrameTracker(problem_of(truth.folder, rules=noisy)), 3, str(tmp_path))
    assert all(np.abs(state["delta_w"]).max() < 1e-6 * usual for state in done.states)


def test_noise_is_the_least_misfit_but_for_the_first_frame():
    """The first frame fits itself: the texture was taken from it."""
    noise = lambda known: FrameMemory.of(known).noise
    assert math.isnan(noise([])) and FrameContext(1, memory=FrameMemory.of([])).is_first
    first = FrameMemory(misfit=0.01, scales={"stage": 0.4})
    assert noise([first]) == 0.01
    known = [first, FrameMemory(0.03, least_misfit=0.03), FrameMemory(0.05, least_misfit=0.03)]
    assert noise(known) == 0.03 and noise([*known, None]) == 0.03
    # a frame that was lost says nothing of the robust scale
    assert FrameMemory.of([first]).scales and not FrameMemory.of([first, None]).scales


def test_the_least_misfit_goes_from_frame_to_frame(truth, tracked):
    problem = problem_of(truth.folder)
    misfit, least = (
        [getattr(m, name) for m in tracked.memories] for name in ("misfit", "least_misfit")
    )
    assert math.isnan(least[0]) and least[-1] > 0
    assert all(b <= a for a, b in itertools.pairwise(least[1:]))
    data, finest = data_of(problem), problem.rules.blurs[-1]
    bare = [
        data.misfit(problem.surface(Unknowns.from_numpy(s)), k, finest)
        for k, s in enumerate(tracked.states)
    ]
    # of the texture as the template has it, one small step before
    assert least[1] == pytest.approx(bare[1], rel=0.1)
    assert least[-1] == pytest.approx(min(bare[1:]), rel=0.1)
    assert misfit[1] < 0.9 * least[1]  # the sheet's own image explains the frame better


def test_a_checkpoint_keeps_what_is_known(truth, tracked, tmp_path):
    stages = FrameTracker(problem_of(truth.folder)).objective.stages
    tracked = copy.deepcopy(tracked)
    tracked.memories[1] = None
    tracked.save(tmp_path / CHECKPOINT, stages)
    found = Track.load(tmp_path / CHECKPOINT, stages)
    assert found.memories[1] is None and found.solver == "gauss-newton"
    for a, b in zip(tracked.memories, found.memories, strict=True):
        if a is not None:
            assert a.scales == b.scales and len(a.scales) == 3
            assert a.light.numbers() == b.light.numbers()
            for name in ("misfit", "outlier_share", "least_misfit", "explained"):
                assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)


@pytest.mark.parametrize(
    "rows, columns, asked, order", [(9, 12, {}, 8), (9, 12, {"order": 3}, 3), (5, 6, {}, 4)]
)
def test_order_of_the_jet(tmp_path, rows, columns, asked, order):
    """Eight, as far as the vertices determine it, or what is asked."""
    still = synthetic.cloth(
        tmp_path / "still", frames=1, size=(160, 120), rows=rows, columns=columns, bend=0.0
    )
    problem = problem_of(still.folder, **asked)
    rest = problem.atlas.state(problem.patch.rest().to_numpy())
    solution = FrameTracker(problem).solve([rest], [0])
    assert problem.template.order == order
    assert solution.states[0].alpha.size == (order + 1) * (order + 2) // 2


def tracker_of(folder, **settings):
    return FrameTracker(problem_of(folder, **settings))


def test_the_solver_follows_from_the_terms(truth):
    chosen = [
        tracker_of(truth.folder, **settings).solver.name
        for settings in ({}, {"rgb_norm": "l1"}, {"solver": "adam"}, {"preset": "paper"} | PCA)
    ]
    assert chosen == ["gauss-newton", "adam", "adam", "adam"]
