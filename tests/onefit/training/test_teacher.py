from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import onefit
from onefit import tailor, teach
from onefit.body import skinning
from onefit.garment.sewing import cuts
from onefit.objective import Weights
from onefit.objective.objective import posed
from onefit.training import OneFitTraining, Settings, TrainingData, data
from onefit.training.projection import Projection, unposed
from onefit.training.teacher import SETTINGS, garment_of, lesson, lessons, path_of, taught
from polyfit.errors import InputError
from polyfit.mesh import write_ply
from polyfit.training import Processes

SMALL = Settings(batch=240, epochs=1, lr_epochs=1, epoch_steps=40, shapes=0)
PATCHES = 30
CUT = dict(patches=PATCHES)
ARGUMENTS = ["shorts", "--kinds", "walk", "--seconds", "0.3", "--vertices", "600"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lessons")
    teach.main([*ARGUMENTS, "-o", str(folder), "--steps", "1", "--seeds", "2"])
    return folder


@pytest.fixture(scope="module")
def learned(folder):
    garment = garment_of(folder, "shorts")
    return TrainingData([garment], lessons=[lessons(folder, garment)], shapes=3, patching=CUT)


def test_lessons_are_files_of_every_frame(folder):
    assert taught(folder) == ("shorts",)
    garment = garment_of(folder, "shorts")
    one, two = lessons(folder, garment)
    assert 500 < len(garment) < 800
    assert one.poses.shape == (9, 24, 3) and one.displacement.shape == (len(garment), 9, 3)
    assert torch.isfinite(one.displacement).all() and one.displacement.abs().max() > 1e-3
    standard = onefit.AnnyBody().standard_shape
    assert torch.equal(one.shape, standard) and not torch.equal(two.shape, standard)


def test_bodies_are_those_of_the_lessons_and_the_standard_one_is_first(learned):
    (found,) = learned.lessons
    assert len(learned.shapes) == 2
    assert torch.equal(learned.shapes[0], learned.model.standard_shape)
    assert torch.equal(learned.shapes[1], found[1].shape)
    assert torch.allclose(learned.standard.vertices, learned.model.body().vertices)


def test_what_patches_made_is_projected_back(learned):
    patched = learned.garments[0][0]
    # of the coefficients that the vertices see
    changes = Projection(patched)(1e-2 * torch.randn(len(patched.garment), 2, 3).cumsum(0) / 50)
    moved = patched.blend @ changes.flatten(0, 1)
    again = patched.blend @ Projection(patched)(moved).flatten(0, 1)
    assert moved.abs().max() > 1e-4
    assert (again - moved).norm() < 1e-2 * moved.norm()  # the ridge takes the rest


def test_unposed_points_are_posed_where_they_were(learned):
    garment = learned.garments[0][0].garment
    maps = torch.eye(3, 4).repeat(2, 24, 1, 1) + 0.1 * torch.randn(2, 24, 3, 4)
    points = torch.randn(len(garment), 2, 3)
    at = posed(points, garment.blend_weights, maps).transpose(0, 1)
    assert torch.allclose(unposed(at, garment.blend_weights, maps), points, atol=1e-4)


def test_a_lesson_gives_the_drape_back():
    draper = onefit.load()
    garment, shape = draper.garment("shorts"), torch.full((6,), 0.6)
    motion = onefit.Motion.generate("walk", seconds=0.3)
    made = lesson(draper, garment, motion, shape, steps=1, material="silk")
    how = dict(steps=1, material="silk", settings=SETTINGS)
    drape = draper.simulate(garment, motion, shape, **how)
    maps = skinning.transforms(draper.model.body(shape), made.poses, made.translation)
    moved = drape.rest[:, None] + made.displacement.float()
    again = posed(moved, garment.blend_weights, maps).transpose(0, 1)
    assert (again - drape.vertices).norm(dim=-1).max() < 2e-4  # half precision


def test_lessons_that_are_there_are_kept(folder):
    path = path_of(folder, "shorts", "walk-0")
    before = path.stat().st_mtime_ns
    teach.main([*ARGUMENTS, "-o", str(folder), "--steps", "1"])
    assert path.stat().st_mtime_ns == before


@pytest.mark.slow
def test_cuts_are_taught_by_their_names(tmp_path, monkeypatch):
    monkeypatch.setattr(cuts, "Block", partial(cuts.Block, spacing=0.024))  # thrice as coarse
    arguments = ["--cuts", "1", "--kinds", "idle", "walk", "--each", "1", "--seconds", "0.1"]
    arguments += ["--vertices", "500", "--steps", "1", "--shapes", "0"]
    teach.main([*arguments, "-o", str(tmp_path)])
    (name,) = taught(tmp_path)
    assert name == "tshirt__cut_0"
    (made,) = lessons(tmp_path, garment_of(tmp_path, name))
    assert made.poses.shape[0] == 3


def test_windows_of_lessons_are_their_frames(learned):
    (found,) = learned.lessons
    windows, asked, wanted = learned.lesson_windows(0, 5, torch.Generator().manual_seed(0))
    assert windows.poses.shape == (5, data.LESSON_LENGTH, 24, 3)
    assert asked.shape == (5, data.LESSON_FRAMES)
    assert asked.min() >= data.LESSON_LENGTH - data.LESSON_LAST
    for b, d in enumerate(wanted.unflatten(1, asked.shape).unbind(1)):
        at = [x for x in found if torch.equal(x.shape, learned.shapes[windows.number[b]])]
        poses = windows.poses[b, asked[b]]
        for pose, there in zip(poses, d.unbind(1)):
            frame = (at[0].poses == pose).flatten(1).all(1).nonzero()[0, 0]
            assert torch.equal(there, at[0].displacement[:, frame].float())


@pytest.mark.slow
def test_regression_comes_nearer_to_the_lessons(folder, learned):
    alone = Weights(k_c=0.0, k_m=0.0)
    settings = replace(SMALL, teacher=str(folder), weights=alone)
    training = OneFitTraining(settings, learned, Processes("cpu"))
    losses = [training.step()["loss"] for _ in range(80)]
    assert set(training.loss(torch.Generator().manual_seed(0))) == {"regression"}
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:5])


def test_the_regression_is_none_where_the_lesson_is_what_the_network_says(learned, folder):
    # an untrained network is plain skinning
    still = [replace(x, displacement=0 * x.displacement) for x in learned.lessons[0]]
    given = TrainingData([learned.garments[0][0].garment], lessons=[still], patching=CUT)
    training = OneFitTraining(replace(SMALL, teacher=str(folder)), given, Processes("cpu"))
    terms = training.loss(torch.Generator().manual_seed(0))
    assert terms["regression"] < 1e-8
    assert {"collision", "stretching", "bending", "gravity"} < set(terms)


def test_garments_are_drawn_by_their_lessons(learned, folder):
    garments = [learned.garments[0][0].garment] * 2
    long = TrainingData(garments, lessons=[[], *learned.lessons], patching=CUT)
    assert len(long) == 18 and long.lesson_frames.tolist() == [0, 18]
    training = OneFitTraining(replace(SMALL, teacher=str(folder)), long, Processes("cpu"))
    assert "regression" in training.loss(torch.Generator().manual_seed(0))  # never of the first


def test_what_is_missing_is_said(folder, tmp_path):
    with pytest.raises(InputError, match="no lessons; onefit.teach makes them"):
        taught(tmp_path)
    with pytest.raises(InputError, match="no lesson of tank; onefit.teach makes them"):
        garment_of(folder, "tank")
    with pytest.raises(InputError, match="of [0-9]+ vertices, not 2500: another mesh"):
        lessons(folder, onefit.Garment.template("shorts"))
    with pytest.raises(InputError, match="--kinds dance: choose among"):
        teach.main(["shorts", "-o", str(tmp_path), "--kinds", "dance"])
    with pytest.raises(InputError, match="--vertices 3: 100 or more"):
        teach.main(["shorts", "-o", str(tmp_path), "--vertices", "3"])
    with pytest.raises(InputError, match="shorts: two garments have this name"):
        teach.main(["shorts", "shorts", "-o", str(tmp_path / "no")])
    with pytest.raises(InputError, match="--seconds -1: more than 0"):
        teach.main(["shorts", "-o", str(tmp_path / "no"), "--seconds", "-1"])
    with pytest.raises(InputError, match=r"a motion of 1000000000.0 s at 30.0 frames a second"):
        teach.main(["shorts", "-o", str(tmp_path / "no"), "--seconds", "1e9"])
    shorts = onefit.Garment.template("shorts")
    for name in ("s-1.ply", "s_1.ply"):
        write_ply(tmp_path / name, shorts.vertices, shorts.faces)
    with pytest.raises(InputError, match="s_1: two garments have this name"):
        teach.main(
            [str(tmp_path / name) for name in ("s-1.ply", "s_1.ply")] + ["-o", str(tmp_path / "no")]
        )
    with pytest.raises(InputError, match="s-1.ply: is a file; a folder is needed"):
        teach.main(["shorts", "-o", str(tmp_path / "s-1.ply"), "--seconds", "1"])
    with pytest.raises(InputError, match="s-1.ply: is a file; a folder is needed"):
        tailor.main(["skirt", "-o", str(tmp_path / "s-1.ply")])
    assert not (tmp_path / "no").exists()
    with pytest.raises(InputError, match="lessons have their own garments"):
        replace(SMALL, teacher="x", cuts=3)
    with pytest.raises(InputError, match="--scale: for garments' files"):
        replace(SMALL, teacher="x", read=dict(scale=0.01))


@pytest.mark.parametrize("broken", [b"no archive", b"PK of another kind"])
def test_a_broken_lesson_is_named(folder, tmp_path, broken):
    garment, (whole, _) = garment_of(folder, "shorts"), sorted(folder.glob("*--*.npz"))
    (tmp_path / whole.name).write_bytes(broken)
    (tmp_path / "shorts.npz").write_bytes(broken)
    with pytest.raises(InputError, match=f"{whole.name}: cannot be read as a lesson"):
        lessons(tmp_path, garment)
    with pytest.raises(InputError, match="shorts.npz: cannot be read as a lesson"):
        garment_of(tmp_path, "shorts")
    np.savez(tmp_path / "shorts.npz", vertices=garment.vertices)
    with pytest.raises(InputError, match="shorts.npz: no lesson, for it misses faces"):
        garment_of(tmp_path, "shorts")


def test_lessons_that_were_made_otherwise_are_not_mixed_in(folder):
    with pytest.raises(InputError, match=r"lessons made otherwise \(steps 1, material cotton\)"):
        teach.main([*ARGUMENTS, "-o", str(folder), "--material", "silk"])
