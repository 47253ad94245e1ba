"""The paper's values in one word: over a scene's own, under those of -D."""

import dataclasses

import numpy as np
import pytest
import synthetic

from polysft_mi import prepare
from polysft_mi.errors import InputError
from polysft_mi.objective import Objective, Problem
from polysft_mi.scene import experiment as scene
from polysft_mi.scene.settings import PRESETS, Settings


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    """A bent sheet's folder, whose scene has values of its own."""
    folder = tmp_path_factory.mktemp("preset") / "sheet"
    truth = synthetic.cloth(folder, frames=2, bend=3.0)
    prepare.main([str(truth.folder), "-q"])
    path = truth.folder / "scene.xml"
    text = path.read_text()
    for name, value in (("k_tc", "7.0"), ("stride", "2")):
        default = getattr(Settings(), name)
        assert f'name="{name}" value="{default}"' in text
        text = text.replace(f'name="{name}" value="{default}"', f'name="{name}" value="{value}"')
    path.write_text(text)
    return path


def test_a_preset_wins_over_the_scene_and_a_value_that_is_given_over_both(sheet):
    assert scene.load(sheet).settings.k_tc == 7.0
    chosen = scene.load(sheet, {"preset": "paper", "k_mi": "0.3"}).settings
    expected = {**PRESETS["paper"], "k_mi": 0.3}
    assert {name: getattr(chosen, name) for name in expected} == expected
    assert chosen.k_tc == 0.05 and chosen.stride == 2  # the paper says nothing of the latter
    with pytest.raises(InputError, match="preset = 'papers'; known values: none, paper"):
        scene.load(sheet, {"preset": "papers"})


def test_a_preset_says_all_but_what_the_input_is_and_how_it_is_read():
    # weights of what it has not, too, and a scale of norms that it has not
    data = "first last stride fps track_centre depth_unit depth_known_to body_model body_up seed"
    unused = "k_cameras k_tracks k_depth k_drape k_pose rgb_scale"
    names = {f.name for f in dataclasses.fields(Settings)}
    assert names - set(PRESETS["paper"]) == {"preset", *data.split(), *unused.split()}


def test_the_papers_objective_has_its_terms_alone_and_its_solver(sheet):
    from polysft_mi.tracker import FrameTracker

    experiment = scene.load(sheet, {"preset": "paper"})
    problem = Problem(experiment, experiment.sequence())
    names = [term.name for term in Objective(problem).terms]
    assert names == ["rgb", "silhouette", "inextensibility", "temporal"]
    assert FrameTracker(problem).solver.name == "adam"


def test_the_papers_template_is_one_jet_in_the_transformers_frame(sheet):
    from polyfit.network import PolyFit

    template = scene.load(sheet, {"preset": "paper"}).template
    assert len(template) == 1 and template.order == 4
    expected = PolyFit.pretrained(name="paper").frame_of(template.vertices)
    R = template.rotation[0]
    assert np.allclose(R, expected.R, atol=1e-6) and np.allclose(R.T @ R, np.eye(3), atol=1e-12)
    pca = scene.load(sheet, {"preset": "paper", "canonical_frame": "pca"}).template
    assert not np.allclose(R, pca.rotation[0], atol=1e-3)
    assert template.residual_rms < 0.1 * np.ptp(template.vertices, axis=0).max()


def test_a_template_that_one_jet_cannot_hold_is_refused(tmp_path):
    tube = synthetic.cloth(tmp_path / "tube", frames=1, shape=synthetic.tube)
    prepare.main([str(tube.folder), "-q"])
    with pytest.raises(InputError, match="one jet cannot hold it"):
        scene.load(tube.folder / "scene.xml", {"patches": "1"})
