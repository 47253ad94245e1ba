from dataclasses import replace

import numpy as np
import pytest
import torch

import onefit
from onefit import teach
from onefit.body import skinning
from onefit.garment.charts import PatchedGarment
from onefit.objective.objective import posed
from onefit.training import OneFitTraining, Settings, TrainingData
from onefit.training.projection import Projection, unposed
from onefit.training.teacher import lesson, lessons, path_of
from polyfit.errors import InputError
from polyfit.training import Processes

SMALL = Settings(garments=("shorts",), batch=600, epochs=1, lr_epochs=1, epoch_steps=40, shapes=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lessons")
    arguments = ["shorts", "-o", str(folder), "--kinds", "walk", "--seconds", "0.3"]
    teach.main([*arguments, "--finish", "1"])
    return folder


def test_lessons_are_files_of_every_frame(folder, data):
    (made,) = lessons(folder, data.garments[0][0])
    assert made.poses.shape == (9, 24, 3) and made.changes.shape[2] == 9
    assert torch.isfinite(made.changes).all() and made.changes.abs().max() > 1e-3


@pytest.fixture(scope="module")
def data():
    motion = onefit.Motion.generate("walk", seconds=0.3)
    return TrainingData([onefit.Garment.template("shorts")], motions=[motion], shapes=0)


def test_what_patches_made_is_projected_back(data):
    patched = data.garments[0][0]
    # of the coefficients that the vertices see
    changes = Projection(patched)(1e-2 * torch.randn(len(patched.garment), 2, 3).cumsum(0) / 50)
    moved = patched.blend @ changes.flatten(0, 1)
    again = patched.blend @ Projection(patched)(moved).flatten(0, 1)
    assert moved.abs().max() > 1e-4
    assert (again - moved).norm() < 1e-2 * moved.norm()  # the ridge takes the rest


def test_unposed_points_are_posed_where_they_were(data):
    garment = data.garments[0][0].garment
    maps = torch.eye(3, 4).repeat(2, 24, 1, 1) + 0.1 * torch.randn(2, 24, 3, 4)
    points = torch.randn(len(garment), 2, 3)
    at = posed(points, garment.blend_weights, maps).transpose(0, 1)
    assert torch.allclose(unposed(at, garment.blend_weights, maps), points, atol=1e-4)


def test_a_lesson_gives_the_drape_back():
    # without a finish: a network's drape is made of patches, and nothing of it may be lost
    draper = onefit.load()
    garment, shape = draper.garment("shorts"), torch.full((6,), 0.6)
    motion = onefit.Motion.generate("walk", seconds=0.3)
    made = lesson(draper, garment, motion, shape, finish=0, material="cotton")
    drape = draper.drape(garment, motion, shape)
    maps = skinning.transforms(draper.model.body(shape), made.poses, made.translation)
    moved = drape.rest[:, None] + draper.patched(garment).blend @ made.changes.flatten(0, 1)
    again = posed(moved, garment.blend_weights, maps).transpose(0, 1)
    plain = draper.drape(garment, motion, shape, skinning_only=True)
    left = (again - drape.vertices).square().mean().sqrt()
    assert left < 0.001 and left < 0.2 * (drape.vertices - plain.vertices).square().mean().sqrt()


def test_lessons_that_are_there_are_kept(folder):
    path = path_of(folder, "shorts", "walk-0")
    before = path.stat().st_mtime_ns
    teach.main(["shorts", "-o", str(folder), "--kinds", "walk", "--seconds", "0.3"])
    assert path.stat().st_mtime_ns == before


def test_regression_comes_nearer_to_the_lessons(folder, data):
    training = OneFitTraining(replace(SMALL, teacher=str(folder)), data, Processes("cpu"))
    losses = [training.step()["loss"] for _ in range(40)]
    assert set(training.loss(torch.Generator().manual_seed(0))) == {"regression"}
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:5])


def test_what_is_missing_is_said(folder, data, tmp_path):
    with pytest.raises(InputError, match="no lesson of shorts; onefit.teach makes them"):
        lessons(tmp_path, data.garments[0][0])
    other = PatchedGarment(data.garments[0][0].garment, data.standard, order=3)
    with pytest.raises(InputError, match="another garment, or another order"):
        lessons(folder, other)
    with pytest.raises(InputError, match="--kinds dance: choose among"):
        teach.main(["shorts", "-o", str(tmp_path), "--kinds", "dance"])
    with pytest.raises(InputError, match="lessons are of garments"):
        replace(SMALL, teacher="x", cuts=3)
