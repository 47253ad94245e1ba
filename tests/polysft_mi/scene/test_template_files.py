"""Templates whose files Mitsuba's own loaders do not understand: what is rendered is what is
tracked.
"""

import numpy as np
import pytest
import synthetic
from loading import loaded

from polysft_mi import capture


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    truth = synthetic.cloth(tmp_path_factory.mktemp("files") / "sheet", frames=1, size=(48, 36))
    capture.prepare_folder(str(truth.folder))
    return truth


def rendered(experiment):
    """The corners (F, 3, 3) of the triangles that Mitsuba has."""
    positions = np.array(experiment.mesh.vertex_positions_buffer()).reshape(-1, 3)
    return positions[np.array(experiment.mesh.faces_buffer()).reshape(-1, 3)]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text.encode("utf-8-sig"),
        lambda text: text.encode("utf-16"),
        lambda text: text.replace(" ", " \\\n ").encode(),
    ],
    ids=["byte order mark", "UTF-16", "continued lines"],
)
def test_files_that_mitsubas_loader_misreads(sequence, spoil):
    scene, path = sequence.folder / "scene.xml", sequence.folder / "template.obj"
    plain = loaded(scene)
    whole = path.read_bytes()
    try:
        path.write_bytes(spoil(whole.decode()))
        experiment = loaded(scene)
    finally:
        path.write_bytes(whole)
    np.testing.assert_array_equal(rendered(experiment), rendered(plain))
    np.testing.assert_array_equal(experiment.template.vertices, plain.template.vertices)
    np.testing.assert_array_equal(experiment.corner, plain.corner)


def test_a_concave_polygon_is_rendered_as_it_is(sequence):
    """A dart in the picture's middle, whose fan from its first corner would leave it."""
    scene, path = sequence.folder / "scene.xml", sequence.folder / "template.obj"
    z = float(sequence.vertices[0][:, 2].mean())
    dart = 0.1 * np.array([[1, 0], [-1, 1], [-0.4, 0], [-1, -1]]) + sequence.vertices[0][
        :, :2
    ].mean(0)
    whole = path.read_bytes()
    lines = [f"v {x} {y} {z}\nvt {k / 4} {k % 2}" for k, (x, y) in enumerate(dart)]
    try:
        path.write_text("\n".join([*lines, "f 2/2 3/3 4/4 1/1"]))
        experiment = loaded(scene)
    finally:
        path.write_bytes(whole)
    corners = rendered(experiment)
    np.testing.assert_allclose(
        corners, experiment.template.vertices[experiment.template.faces], atol=1e-6
    )
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert 0.5 * np.abs(across).sum() == pytest.approx(0.1**2 * 1.4, rel=1e-4)
