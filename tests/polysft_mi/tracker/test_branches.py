"""A sheet and its mirror image, noise and folds: both are tracked while the video does not tell."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import synthetic
from problems import problem_of, small_cloth

from polysft_mi.objective import FrameMemory
from polysft_mi.pictures import Drawing, write_report
from polysft_mi.results import Run, outputs
from polysft_mi.scene.rules import Rules
from polysft_mi.surface.patch import Unknowns
from polysft_mi.tracker import CHECKPOINT, FrameTracker, Track, branches, track

ORIGIN = np.array([0.1, -0.2, 0.05])


def test_the_mirror_image_lies_behind_the_plane_as_far_as_the_sheet_before_it():
    flat = synthetic.sheet(0.0, 9, 12)
    assert np.abs(branches.mirrored(flat, ORIGIN) - flat).max() < 1e-12
    bent = synthetic.sheet(1.0, 9, 12)
    image = branches.mirrored(bent, ORIGIN)
    rays, others = bent - ORIGIN, image - ORIGIN
    along = np.linalg.norm(np.cross(rays, others), axis=1)
    assert along.max() < 1e-12  # each vertex stays on its ray
    middle = bent.mean(0)
    normal = np.linalg.svd(bent - middle, full_matrices=False)[2][2]
    height, other = ((x - middle) @ normal for x in (bent, image))
    assert np.abs(height).max() > 0.01
    assert np.abs(height + other).max() < 1e-9


def of_costs(*costs, lost=()):
    """A track of frames that cost so much."""
    states = [{"alpha": np.full(2, k)} for k in range(len(costs))]
    return Track(states=states, totals=[{"rgb": c} for c in costs], lost=dict.fromkeys(lost, ""))


def test_the_branch_that_saves_a_frames_cost_is_kept():
    done = of_costs(1.0, 1.0)
    other = branches.split(done, 1)
    assert done.other is other and done.fork == 1
    other.states[1] = {"alpha": np.ones(2)}
    assert np.array_equal(done.states[1]["alpha"], [1, 1]) and done.states[0] is other.states[0]
    for own, others in ((1.0, 0.8), (1.5, 1.0), (1.4, 1.0)):
        assert not branches.decide(done, 1.0)
        for t, cost in ((done, own), (other, others)):
            t.states.append({"alpha": np.full(2, cost)})
            t.totals.append({"rgb": cost, "uv": None})
    assert branches.ahead(done) == pytest.approx(1.1 / 0.95)
    assert branches.decide(done, 1.0)
    assert done.totals[2]["rgb"] == 0.8 and done.other.totals[2]["rgb"] == 1.0


def test_a_branch_that_is_lost_loses():
    done = of_costs(1.0, 1.0, lost=[1])
    other = branches.split(done, 0)
    other.lost.clear()
    other.totals = [{"rgb": 5.0}] * 2
    assert branches.ahead(done) == math.inf
    assert branches.decide(done, 1.0) and not done.lost


def test_a_frame_that_both_lose_tells_nothing():
    done = of_costs(1.0, 1.0, 1.0, lost=[1])
    other = branches.split(done, 0)
    assert branches.ahead(done) == 0
    other.totals[2] = {"rgb": 0.9}
    assert branches.ahead(done) == pytest.approx(0.1 / 0.95)
    done = of_costs(1.0, lost=[0])
    branches.split(done, 0)
    assert branches.ahead(done) == 0 and not branches.decide(done, 1.0)


def of_a_cloth(folder):
    truth = small_cloth(folder, frames=6)
    return truth, problem_of(truth.folder)


def error(problem, state, vertices):
    return np.linalg.norm(problem.surface(Unknowns.from_numpy(state)) - vertices, axis=1).mean()


def test_a_track_on_the_wrong_side_comes_back(tmp_path):
    truth, problem = of_a_cloth(tmp_path)
    tracker = FrameTracker(problem)
    done = track(tracker, 3, tmp_path)
    atlas, origin = problem.atlas, problem.camera.origin
    right = atlas.state(done.states[2])
    image = branches.mirrored(atlas.surface(right).vertices, origin)
    wrong = atlas.arrays(atlas.with_relief_in_jets(atlas.reaching(image, right)))
    done.states[2] = Unknowns.from_numpy(wrong).to_numpy()
    assert error(problem, done.states[2], truth.vertices[2]) > 0.003
    done.other, done.mirror_at = None, 3
    done.save(tmp_path / CHECKPOINT, tracker.objective.stages)
    last = track(FrameTracker(problem), 6, tmp_path, resume=True)
    true, other = truth.vertices[5], branches.mirrored(truth.vertices[5], origin)
    assert error(problem, last.states[5], true) < 0.5 * error(problem, last.states[5], other)


def test_an_image_that_costs_much_more_is_not_tried_again_soon(tmp_path):
    truth = synthetic.cloth(tmp_path / "cloth", size=(240, 180), bend=6.0)
    done = track(FrameTracker(problem_of(truth.folder)), 5, tmp_path)
    assert done.other is None and done.mirror_at > 5


@pytest.fixture(scope="module")
def undecided(tmp_path_factory):
    """A problem whose rules decide nothing, its track, and the track's folder: of a sheet far away
    that bends much, so that no rounding leads from its mirror image back to it.
    """
    folder = tmp_path_factory.mktemp("undecided")
    rules = dataclasses.replace(Rules(), mirror_share=math.inf)
    truth = synthetic.cloth(folder / "cloth", size=(320, 240), bend=10.0, depth=1.0)
    problem = problem_of(truth.folder, rules=rules)
    out = folder / "out"
    out.mkdir()
    return problem, track(FrameTracker(problem), 5, out), out


def test_both_branches_outlive_an_interruption(undecided, tmp_path):
    problem, there, _ = undecided
    assert there.other is not None and 0 < there.fork < 4
    assert np.isfinite(branches.ahead(there)) and branches.ahead(there) <= 0  # the cheaper is shown
    track(FrameTracker(problem), there.fork + 1, tmp_path)
    again = track(FrameTracker(problem), 5, tmp_path, resume=True)
    for a, b in ((there, again), (there.other, again.other)):
        for x, y in zip(a.states, b.states, strict=True):
            assert all(np.array_equal(x[name], y[name]) for name in x)
    assert again.fork == there.fork


def test_what_stays_undecided_is_shown(undecided):
    problem, done, out = undecided
    cameras = problem.camera, problem.sequence.cameras
    text = outputs.resolved_scene(problem.experiment)
    outputs.write_beginning(out, text, *cameras, "the command", 15, "")
    with Drawing(problem, {}, out, exr_frames=0, about={}) as drawing:
        summary, plotted = outputs.write(problem, done, out, drawing, fps=15, command="the command")
        plotted()
    run = Run.open(out)
    assert summary["undecided"]["from"] == done.fork
    apart = 1e3 * np.linalg.norm(run.other - run.vertices, axis=-1)
    assert np.isclose(apart.max(), summary["undecided"]["apart_mm"])
    assert not apart[: done.fork].any() and (apart[done.fork :].max(1) > 0).all()
    page = Path(write_report(out)).read_text(encoding="utf-8")
    assert f"Undecided: from frame {done.fork} on" in page and "second surface" in page
    decided = dataclasses.replace(done, other=None)
    with Drawing(problem, {}, out, exr_frames=0, about={}) as drawing:
        _, plotted = outputs.write(problem, decided, out, drawing, fps=15, command="the command")
        plotted()
    assert Run.open(out).other is None


def test_a_closed_surface_has_no_mirror_image(tmp_path):
    truth = synthetic.cloth(
        tmp_path / "tube", frames=2, size=(160, 120), rows=9, columns=18, shape=synthetic.tube
    )
    problem = problem_of(truth.folder)
    assert not FrameTracker(problem).mirrors
    assert FrameTracker(of_a_cloth(tmp_path)[1]).mirrors


def test_bold_frames_take_a_misfit_that_grew_for_folds():
    quiet = FrameMemory(misfit=0.06, least_misfit=0.06, bold=True)
    grown = dataclasses.replace(quiet, misfit=0.12)
    assert quiet.distrust == pytest.approx(0.06) and grown.distrust == pytest.approx(0.03)
    assert dataclasses.replace(grown, bold=False).distrust == 0.06
    assert math.isnan(FrameMemory(bold=True).distrust)


def test_a_second_pass_begins_after_the_first_frame_that_was_solved():
    done = of_costs(1.0, 2.0, 3.0, lost=[0])
    done.memories = [None, FrameMemory(misfit=0.1), FrameMemory(misfit=0.2)]
    again = branches.second_pass(done)
    assert len(again.states) == len(again.totals) == again.next_window == 2
    assert again.memories[1] == FrameMemory(misfit=0.1, bold=True) and not done.memories[1].bold
    assert again.lost == {0: ""}


@pytest.mark.parametrize(
    "rgb, outline, shading, verdict",
    [(1.0, 0.8, 1.0, "kept"), (0.5, 0.99, 0.99, "dropped"), (0.9, 1.2, 0.9, "dropped")],
)
def test_witnesses_say_whether_a_second_pass_is_kept(rgb, outline, shading, verdict):
    done = of_costs(1.0, 1.0, 1.0)
    for terms in done.totals:
        terms |= {"silhouette": 1.0, "shading": 1.0, "tracks": None}
    done.memories = [FrameMemory(misfit=0.1)] * 3
    done.seconds = [1.0] * 3
    done.again = branches.second_pass(done)
    for k in (1, 2):
        done.again.states.append({"alpha": np.full(2, -k)})
        done.again.totals.append({"rgb": rgb, "silhouette": outline, "shading": shading})
        done.again.memories.append(FrameMemory(misfit=0.1, bold=True))
        done.again.seconds.append(0.5)
    branches.settle(done, 0.05)
    assert done.second == verdict and done.again is None
    assert done.states[2]["alpha"][0] == (-2 if verdict == "kept" else 2)
    assert done.seconds == [1.0, 1.5, 1.5]


def rippled(t, rows, columns):
    """A sheet whose ripples, finer than its jet, grow with the time t."""
    points = synthetic.sheet(t, rows, columns, bend=1.0)
    points[:, 2] += 0.015 * t * np.sin(2 * np.pi * points[:, 0] / 0.06)
    return points


@pytest.fixture(scope="module")
def rippling(tmp_path_factory):
    """A rippling cloth, its problem under rules for which its images are noisy, and its track."""
    folder = tmp_path_factory.mktemp("rippling")
    rules = dataclasses.replace(Rules(), noise_misfit=3e-3, noise_power=4.0, rim=0.0)
    truth = synthetic.cloth(
        folder / "cloth", frames=6, size=(320, 240), rows=13, columns=25, shape=rippled
    )
    problem = problem_of(truth.folder, rules=rules)
    return truth, problem, track(FrameTracker(problem), 6, folder)


def test_a_noisy_video_is_tracked_twice(rippling, tmp_path):
    truth, problem, twice = rippling
    rules = dataclasses.replace(problem.rules, second_pass=1.0)
    once = track(FrameTracker(problem_of(truth.folder, rules=rules)), 6, tmp_path)
    assert not once.second and twice.second and twice.again is None
    costs = [sum(x["silhouette"] + x["shading"] for x in t.totals) for t in (once, twice)]
    assert costs[1] < costs[0] if twice.second == "kept" else costs[1] == costs[0]


def test_a_second_pass_outlives_an_interruption(rippling, tmp_path):
    _, problem, there = rippling

    def stop(done, *_):
        if done == 6 + 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track(FrameTracker(problem), 6, tmp_path, progress=stop)
    assert Track.load(tmp_path / CHECKPOINT).again.next_window == 3
    again = track(FrameTracker(problem), 6, tmp_path, resume=True)
    assert again.second == there.second and again.again is None
    for x, y in zip(there.states, again.states, strict=True):
        assert all(np.array_equal(x[name], y[name]) for name in x)


def test_a_video_is_doubtful_where_caution_costs(tmp_path):
    folder = Path(of_a_cloth(tmp_path)[1].experiment.path).parent
    memories = [FrameMemory(misfit=m, least_misfit=0.07) for m in (0.07, 0.07, 0.14, 0.14, 0.14)]
    totals = [{"rgb": 1.0, "uv": None, "relief": cost} for cost in (0.0, 0.05, 0.05, 0.05, 0.05)]
    assert not FrameTracker(problem_of(folder, window=2)).doubts(totals, memories)
    tracker = FrameTracker(problem_of(folder))
    assert tracker.doubts(totals, memories)
    assert not tracker.doubts([{**x, "rgb": 100.0} for x in totals], memories)
    assert not tracker.doubts(totals, [dataclasses.replace(m, misfit=0.07) for m in memories])
    assert not tracker.doubts(totals, [dataclasses.replace(m, least_misfit=0.01) for m in memories])


def test_a_clear_video_is_tracked_once(tmp_path):
    _, problem = of_a_cloth(tmp_path)
    assert not track(FrameTracker(problem), 3, tmp_path).second
