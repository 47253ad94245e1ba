"""What a draper keeps of garments, what it tells while it drapes, and what a drape measures."""

import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

import onefit
from onefit.contact import ContactSettings
from onefit.garment import Garment
from onefit.objective import crossings
from onefit.physics import Material, Settings
from polyfit.errors import InputError
from polyfit.mesh import write_ply


@pytest.fixture(scope="module")
def draper():
    return onefit.load()


@pytest.fixture(scope="module")
def coarse():
    return Garment.template("shorts").remeshed(300)


def in_its_place(place, garment):
    """A garment like ``garment`` that lies in memory where another one was, at ``place``."""
    others = []
    for _ in range(10_000):
        others.append(replace(garment))
        if id(others[-1]) == place:
            return others[-1]
    raise AssertionError("the place was not used again")


def test_a_garment_gets_no_patches_of_one_that_is_gone(draper, coarse):
    gone = replace(Garment.template("tank"))
    patches, place = weakref.ref(draper.patched(gone)), id(gone)
    draper.codes(gone)
    del gone
    assert patches() is None  # nothing is kept of it
    other = in_its_place(place, coarse)
    assert len(draper.patched(other).vertex_patch) == len(other)
    assert len(draper.codes(other)) == len(draper.patched(other))
    assert draper.patched(other) is draper.patched(other)


def test_arguments_of_a_wrong_kind_are_refused_in_one_line(draper, coarse):
    walk = onefit.Motion.generate("walk", seconds=0.1)
    for how, message in (
        (dict(material=None), "^material 'None': choose among cotton"),
        (dict(material=7), "^material '7': choose among cotton"),
        (dict(steps=1.5), "^steps = 1.5; a whole number, 1 or more, is needed$"),
    ):
        with pytest.raises(InputError, match=message):
            draper.simulate(coarse, walk, **how)
    for how, message in (
        (dict(newton=0), "^newton = 0; a whole number, 1 or more, is needed$"),
        (dict(iterations=2.5), "^iterations = 2.5; a whole number, 1 or more, is needed$"),
        (dict(parts=0), "^parts = 0; a whole number, 1 or more, is needed$"),
        (dict(stride=0), "^stride = 0; a finite number above 0 is needed$"),
        (dict(damping="a"), "^damping = 'a'; a finite number, 0 or more, is needed$"),
        (dict(contact=None), "^contact = None: ContactSettings are needed$"),
    ):
        with pytest.raises(InputError, match=message):
            Settings(**how)
    for device, message in (("foo", "cpu or cuda is needed"), ("cuda:99", "no such CUDA device")):
        with pytest.raises(InputError, match=f"^device {device}: .*{message}"):
            onefit.load(device=device)
    for call, message in (
        (lambda: onefit.load(None), "^weights of type NoneType; a file's name is needed"),
        (lambda: onefit.load(model="smpl"), "^model = 'smpl'; a body model, as"),
        (lambda: draper.simulate(coarse, walk, settings={"room": 0}), "Settings are needed"),
        (lambda: ContactSettings(room="a"), "^room = 'a'; a finite number, 0 or more, is needed"),
        (lambda: replace(Material.named("silk"), drag="a"), "^material: drag = 'a'; a finite"),
        (lambda: replace(Material.named("silk"), density=0), "density = 0; a finite number above"),
    ):
        with pytest.raises(InputError, match=message):
            call()
    for count in (0, 3, "300"):
        with pytest.raises(InputError, match=f"^count = {count}: 100 to 1,000,000 vertices"):
            coarse.remeshed(count)
    with pytest.raises(InputError, match="^motion of type ndarray; a Motion"):
        draper.drape(coarse, np.zeros((3, 24, 3)))


def test_each_frame_is_told(draper, coarse):
    told = []
    motion = onefit.Motion.generate("walk", seconds=0.7)
    drape = draper.drape(coarse, motion, eased=False, advance=lambda: told.append(1))
    assert len(told) == len(drape.vertices) > 16  # more than one batch


def test_energies_are_of_the_material(draper, coarse):
    drape = draper.drape(coarse, onefit.Motion.generate("walk", seconds=0.1), eased=False)
    assert drape.material is None
    of = lambda name: replace(drape, material=name and onefit.Material.named(name)).measures()
    jersey, cotton, denim = of("jersey"), of("cotton"), of("denim")
    heavier = (denim.energy - cotton.energy) / (jersey.energy - cotton.energy)
    assert heavier == pytest.approx((0.40 - 0.15) / (0.18 - 0.15), rel=1e-3)
    assert of(None).energy == pytest.approx(
        cotton.energy + (jersey.energy - cotton.energy) * 5 / 3, rel=1e-3
    )  # 0.2 kg/m^2


def test_what_grading_pushes_through_itself_comes_apart(draper, monkeypatch):
    """Where layers of the template come through each other on another body, as a vertex of the
    front that lands behind the back here.
    """
    garment, graded = Garment.template("tank").remeshed(500), Garment.graded
    front = int(garment.vertices[:, 1].argmin())

    def poked(self, body):
        rest = graded(self, body).clone()
        rest[front, 1] = rest[:, 1].max() + 0.05
        return rest

    faces = garment.faces.numpy()
    shape = draper.model.random_shape(np.random.default_rng(3))
    monkeypatch.setattr(Garment, "graded", poked)
    through = crossings(garment.graded(draper.model.body(shape)).numpy(), faces)
    made = draper.drape(garment, onefit.Motion.generate("walk", seconds=0.1), shape)
    assert through > 0 and crossings(made.rest.numpy(), faces) == 0


def test_two_threads_drape_as_one_does(draper, coarse):
    motions = [onefit.Motion.generate(kind, seconds=0.5) for kind in ("walk", "dance")] * 2
    expected = [draper.drape(coarse, motion, eased=False).vertices for motion in motions]
    other = onefit.Draper(draper.trained, draper.model)
    with ThreadPoolExecutor(2) as threads:
        one, two = threads.map(other.patched, [coarse] * 2)
        drapes = threads.map(lambda motion: other.drape(coarse, motion, eased=False), motions)
        assert all(torch.equal(d.vertices, x) for d, x in zip(drapes, expected))
    assert one is two  # made once


def test_a_file_that_changes_is_read_again(draper, coarse, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, faces = tmp_path / "shorts.ply", coarse.faces.numpy()
    write_ply(path, coarse.vertices.numpy(), faces)
    first = draper.garment("shorts.ply")
    assert draper.garment(path) is first and draper.garment("tank") is draper.garment("tank")
    write_ply(path, coarse.vertices.numpy() + [0, 0, 0.01], faces)
    again = draper.garment("shorts.ply")
    assert (again.vertices - first.vertices)[:, 2].mean() == pytest.approx(0.01, abs=1e-3)
