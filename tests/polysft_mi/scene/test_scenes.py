"""The scene files of the repository: as their writer writes them, and true to their sequences."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from loading import difference, loaded
from places import ROOT
from scripts import load

from polysft_mi.capture import Layout, recognise, scene_xml
from polysft_mi.scene.sequence import Sequence

write_scenes = load("scenes/write_scenes.py")


@pytest.mark.parametrize("name", write_scenes.SCENES)
def test_scenes_are_as_the_writer_writes_them(name):
    assert (ROOT / "scenes" / f"{name}.xml").read_text(encoding="utf-8") == write_scenes.text(name)


def _place(name, shared_data):
    """The folder of a sequence, in the data's folder or one further down."""
    (place,) = [p for p in (shared_data / name, *shared_data.glob(f"*/{name}")) if p.is_dir()]
    return place


@pytest.mark.parametrize("name", [n for n in write_scenes.SCENES if n not in write_scenes.DEMOS])
def test_scenes_match_the_sequences(name, shared_data):
    layout = recognise(str(_place(name, shared_data)))
    assert dataclasses.replace(write_scenes.SCENES[name], settings={}) == layout


@pytest.mark.parametrize("name", [n for n in write_scenes.SCENES if n not in write_scenes.DEMOS])
def test_scenes_show_frame_0(name, shared_data):
    right, *mirrored = difference(
        loaded(str(ROOT / "scenes" / f"{name}.xml"), data=_place(name, shared_data))
    )
    # phi-SfT's template is some pixels away from its own texture coordinates' place in frame 0; the
    # shirt is white, and its sides are in the shade
    most = {"phi_sft_R1": 0.13, "shirt": 0.05}.get(name, 0.03)
    assert right < most and min(mirrored) > 2 * right


@pytest.mark.parametrize("name", write_scenes.DEMOS)
def test_demos(name):
    folder = ROOT / "scenes" / name
    assert sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) < 1_900_000
    layout = dataclasses.replace(write_scenes.SCENES[name], settings={}, world_to_camera=None)
    assert recognise(str(folder)) == layout  # shorter than what prepare would write
    if "body" in write_scenes.SCENES[name].settings:
        return
    experiment = loaded(str(ROOT / "scenes" / f"{name}.xml"))
    right, *mirrored = difference(experiment, 64 if name in write_scenes.LIGHTS else 1)
    assert right < (0.05 if name == "demo_shirt" else 0.03) and min(mirrored) > 2 * right
    truth = np.load(folder / "gt.npz")
    assert len(truth["vertices"]) == len(
        Sequence.open(experiment.frames, experiment.masks, size=experiment.size)
    )
    np.testing.assert_allclose(truth["vertices"][0], experiment.template.vertices, atol=1e-4)
    np.testing.assert_array_equal(truth["faces"], experiment.template.faces)


def test_comment_cannot_break_the_scene():
    layout = Layout(
        "cloth", write_scenes.SCENES["flag"].camera, "frames", "", "texture.png", "template.obj"
    )
    ET.fromstring(scene_xml(layout, ".", comment="a -- b > & --> c"))
