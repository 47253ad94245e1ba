"""Simulated garments on bodies: what they show is what their truth says. The simulator itself need
not be installed.
"""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scripts import load

from polysft_mi.errors import InputError
from polysft_mi.surface.meshio import write_obj

onefit = pytest.importorskip("onefit")
pytest.importorskip("torch")
dressed = load("benchmarks/simulate_dressed.py")
CAMERA = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 2.1], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def garment():
    made = onefit.Garment.template("tank").remeshed(400)
    return made.vertices.double().numpy(), made.faces.numpy()


def test_front_and_back_have_a_half_of_the_texture_each(garment):
    vertices, faces = garment
    texcoords, aspect = dressed.split_in_two(vertices, faces)
    assert texcoords.coordinates.min() > 0 and texcoords.coordinates.max() < 1
    halves = texcoords.coordinates[texcoords.faces][..., 0] > 0.5
    assert (halves.all(1) | ~halves.any(1)).all()  # no face lies across both
    middle = vertices[faces].mean(1)[:, 1]
    assert middle[halves.all(1)].mean() > middle[~halves.any(1)].mean() + 0.05
    assert aspect == pytest.approx(2 * np.ptp(vertices[:, 0]) / np.ptp(vertices[:, 2]))


def test_errors_of_a_motion_are_as_large_as_they_say_and_change_slowly():
    poses, places = np.zeros((45, 24, 3)), np.zeros((45, 3))
    off = [dressed.as_estimated(poses, places, np.random.default_rng(k)) for k in range(20)]
    turns = np.array([Rotation.from_rotvec(p.reshape(-1, 3)).magnitude() for p, _ in off])
    ways = np.array([np.linalg.norm(x, axis=1) for _, x in off])
    assert np.sqrt((turns**2).mean()) == pytest.approx(dressed.JOINT_ERROR, rel=0.1)
    assert np.sqrt((ways**2).mean()) == pytest.approx(dressed.ROOT_ERROR, rel=0.25)
    steps = np.array([np.diff(x, axis=0) for _, x in off])
    assert np.sqrt((steps**2).sum(-1).mean()) < 0.15 * dressed.ROOT_ERROR


def test_masks_show_the_cloth_and_the_body_hides_it(garment, tmp_path, monkeypatch):
    rest, faces = garment
    for name, value in (("SIZE", (90, 120)), ("FOCAL", 150.0), ("SAMPLES", 4)):
        monkeypatch.setattr(dressed, name, value)
    body = onefit.AnnyBody().body()
    skin, of_body = body.vertices.double().numpy(), body.faces.numpy()
    write_obj(tmp_path / "template.obj", rest, faces, dressed.split_in_two(rest, faces)[0])
    cv2.imwrite(str(tmp_path / "texture.png"), np.full((64, 64, 3), (0, 0, 255), np.uint8))
    shift = CAMERA.copy()
    shift[1, 3] = rest[:, 2].mean()
    cloth, bodies = np.stack([rest, rest + (0.1, 0, 0)]), np.stack([skin, skin + (0.1, 0, 0)])
    seen = dressed.film(
        str(tmp_path), rest, cloth, bodies, of_body, shift, np.random.default_rng(1)
    )
    centres = []
    for t, x in enumerate(cloth):
        own = x @ shift[:3, :3].T + shift[:3, 3]
        pixel = 150 * own[:, :2] / own[:, 2:] + (45, 60)
        mask = cv2.imread(str(tmp_path / "masks" / f"{t:03d}.png"), cv2.IMREAD_GRAYSCALE) > 0
        frame = cv2.imread(str(tmp_path / "frames" / f"{t:03d}.png")).astype(float)
        inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) > 0
        assert (frame[inside][:, 2] > 2 * frame[inside][:, 0]).mean() > 0.95  # red
        column, row = np.floor(pixel[seen[t]]).astype(int).T
        around = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) > 0
        assert around[row, column].mean() > 0.98
        front = x[:, 1] < np.median(x[:, 1]) - 0.02
        assert seen[t][front].mean() > 0.5 > 0.2 > seen[t][~front].mean()
        centres.append(np.nonzero(mask)[1].mean())
    assert centres[1] - centres[0] == pytest.approx(0.1 * 150 / 2.1, abs=1.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "frames", "masks", "template.obj", "texture.png"
    ]  # fmt: skip


def test_a_limb_that_went_through_the_cloth_is_told(garment):
    body = onefit.AnnyBody().body()
    skin, faces = body.vertices.double().numpy()[None], body.faces.numpy()
    rest = garment[0][None]
    dressed.check_outside(rest, skin, faces)
    with pytest.raises(InputError, match="in frame 1 the body has gone through the cloth"):
        dressed.check_outside(
            np.concatenate([rest, rest + (0, 0.05, 0)]), np.repeat(skin, 2, 0), faces
        )
