"""The template of sequences in the form of Kinect-Paper: its grid and its pose."""

import os
import re

import cv2
import numpy as np
import pytest
import synthetic
from loading import loaded

from polysft_mi.capture import prepare_folder
from polysft_mi.errors import InputError
from polysft_mi.scene import kinect_paper
from polysft_mi.scene.kinect_paper import template as kinect_paper_template
from polysft_mi.surface import meshio


@pytest.mark.parametrize(
    "rows, columns, resolution", [(5, 6, 33), (9, 9, 17), (3, 2, 5), (2, 2, 6)]
)
def test_kinect_paper_template(tmp_path, rows, columns, resolution):
    truth = synthetic.kinect_paper(tmp_path / "data", frames=1, rows=rows, columns=columns)
    vertices, faces, uv = kinect_paper_template(str(truth.folder), resolution, "none")
    meshio.check_template(vertices, faces, uv)
    assert vertices.shape == (resolution**2, 3) and len(faces) == 2 * (resolution - 1) ** 2
    np.testing.assert_allclose(
        vertices, synthetic.sheet(0, resolution, resolution), atol=1e-9
    )  # the sheet is flat and evenly spaced
    normals = [
        np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
        for v, f in ((vertices, faces), (truth.vertices[0], truth.faces))
    ]
    assert (normals[0] @ normals[1].mean(0) > 0).all()
    # uv is a place in frame 1: the texture's colours are found there
    image = cv2.imread(str(truth.folder / "frame_001.png"))[..., ::-1]
    extent = np.ptp(vertices[:, :2], axis=0)
    keep = (np.abs(vertices[:, :2]) < 0.42 * extent).all(axis=1)
    at = uv[keep] * (96, -72) + (0, 72) - 0.5
    seen = cv2.remap(
        image.astype(np.float32), *at.astype(np.float32).T[..., None], cv2.INTER_LINEAR
    )[:, 0]
    place = vertices[keep, :2] / extent + 0.5
    texture = synthetic.texture_image().astype(np.float32)
    printed = cv2.remap(
        texture, *(place * 64 - 0.5).astype(np.float32).T[..., None], cv2.INTER_LINEAR
    )[:, 0]
    assert np.abs(seen - printed).max() < 12


def test_kinect_paper_pose_fit(tmp_path):
    """A pose that misses by three pixels is moved to where the sheet is, whatever the resolution,
    and a line says so.
    """
    truth = synthetic.kinect_paper(tmp_path / "data", frames=1, size=(384, 288))
    folder, camera = str(truth.folder), kinect_paper.camera(str(truth.folder))

    def missed(vertices, resolution):
        exact = camera.project(synthetic.sheet(0, resolution, resolution))
        return np.sqrt(((camera.project(vertices) - exact) ** 2).sum(1).mean())

    pose = np.loadtxt(truth.folder / "cam.ext")
    pose[:, :3] = cv2.Rodrigues(np.array([0.02, -0.025, 0.006]))[0] @ pose[:, :3]
    pose[:, 3] += (3, -2, 6)
    np.savetxt(truth.folder / "cam.ext", pose)
    said = []
    given = kinect_paper_template(folder, 9, "none", said.append)[0]
    assert missed(given, 9) > 3
    assert missed(kinect_paper_template(folder, 33)[0], 33) < 0.2
    vertices, _, uv = kinect_paper_template(folder, 9, say=said.append)
    assert missed(vertices, 9) < 0.2
    np.testing.assert_allclose(uv * (384, -288) + (0, 288), camera.project(vertices))
    assert said[0] == "pose: from cam.ext" and re.fullmatch(
        r"pose: from cam.ext, moved by [34]\.\d pixels to the edges of frame_001.png", said[1]
    )
    experiment = loaded(prepare_folder(folder, resolution=9)[0])
    np.testing.assert_allclose(experiment.template.vertices, vertices, atol=1e-6)
    noise = np.random.default_rng(0).integers(0, 255, (288, 384, 3)).astype(np.uint8)
    cv2.imwrite(str(truth.folder / "frame_001.png"), noise)  # no edge tells
    np.testing.assert_array_equal(kinect_paper_template(folder, 9)[0], given)
    with pytest.raises(InputError, match="pose_fit = 'yes'; auto or none is needed"):
        kinect_paper_template(folder, 9, "yes")


def test_real_kinect_paper(shared_data, tmp_path):
    folder = str(shared_data / "kinect_paper")
    vertices, _faces, uv = kinect_paper_template(folder, pose_fit="none")
    own = np.loadtxt(os.path.join(folder, "mesh.pts"))
    pose = np.loadtxt(os.path.join(folder, "cam.ext"))
    np.testing.assert_allclose(
        vertices.reshape(33, 33, 3)[::4, ::4].reshape(-1, 3),
        1e-3 * (own @ pose[:, :3].T + pose[:, 3]),
        atol=1e-9,
    )
    assert (
        np.loadtxt(os.path.join(folder, "mesh.tri")) == kinect_paper_template(folder, 9)[1]
    ).all()
    # the printed area has a dark frame: the template's left edge runs along it, within a few
    # pixels, the paper around it is white
    image = cv2.cvtColor(cv2.imread(os.path.join(folder, "frame_001.png")), cv2.COLOR_BGR2GRAY)
    edge = (uv.reshape(33, 33, 2)[4:29, 0] * (640, -480) + (0, 480)).astype(int)
    darkest = np.array([image[y, x - 6 : x + 7].min() for x, y in edge])
    outside = np.array([image[y, x - 25 : x - 12].min() for x, y in edge])
    assert (darkest < 130).mean() > 0.9 and (outside > 150).mean() > 0.9
    # fitted, it lies on the frame's middle: along straight lines between its corners pixels are
    # dark, two pixels off they are paper or print
    fitted, _, _ = kinect_paper_template(folder)
    corner = kinect_paper.camera(folder).project(fitted)[[0, 32, 1088, 1056]]
    grey = lambda d: np.concatenate(
        [_along(image, a, b, d) for a, b in zip(corner, np.roll(corner, -1, axis=0))]
    )
    assert grey(0).mean() < 130 < 165 < min(grey(-3).mean(), grey(3).mean())
    assert (
        np.ptp(np.linalg.norm(fitted - vertices, axis=1)) < 0.02
        and np.linalg.norm(fitted - vertices, axis=1).max() < 0.02
    )


def _along(image, a, b, aside):
    """Pixels (100,) of an image (H, W) on the line from a to b, moved by so many pixels to its
    side.
    """
    step = (b - a) / np.linalg.norm(b - a)
    at = a + np.linspace(0.05, 0.95, 100)[:, None] * (b - a) + aside * step[::-1] * (-1, 1) - 0.5
    return cv2.remap(
        image.astype(np.float32), *at.astype(np.float32).T[..., None], cv2.INTER_LINEAR
    )[:, 0]
