"""Simulated sequences: what they show is what their truth says, in the form that the scenes expect.
The simulator itself need not be installed.
"""

import cv2
import numpy as np
import pytest
from places import ROOT
from problems import data_of
from scripts import load

from polyfit.mesh import edges_of
from polysft_mi.errors import InputError
from polysft_mi.objective.problem import Problem
from polysft_mi.scene import experiment as scene

simulate = load("benchmarks/simulate.py")
pictures, shapes = load("benchmarks/simulate_pictures.py"), load("benchmarks/simulate_shapes.py")
KIND = simulate.KINDS["bend"]


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """Two frames: the flat sheet, and half a wave of it, as long as before, turned a little."""
    folder = tmp_path_factory.mktemp("simulated") / "bend"
    flat, uv = simulate.sheet(KIND)
    angle = 0.8 * (uv[:, 0] - 0.5)
    x = flat.copy()
    x[:, 0], x[:, 2] = (
        KIND.size[0] / 0.8 * np.sin(angle),
        shapes.DEPTH + KIND.size[0] / 0.8 * (1 - np.cos(angle)),
    )
    nx, ny = KIND.cells
    a = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
    faces = np.concatenate(
        [np.stack([a, a + 1, a + nx + 2], 1), np.stack([a, a + nx + 2, a + nx + 1], 1)]
    )
    shape = shapes.Shape(flat, faces, uv, np.zeros(len(flat), bool), KIND.size[0] / KIND.size[1])
    seen = pictures.render(str(folder), np.stack([flat, x]), shape, np.random.default_rng(2))
    assert seen.all()
    return folder, np.stack([flat, x])


def test_masks_are_where_the_vertices_are(bent):
    folder, vertices = bent
    for t, x in enumerate(vertices):
        mask = cv2.imread(str(folder / "masks" / f"{t:03d}.png"), cv2.IMREAD_GRAYSCALE) > 0
        pixel = pictures.FOCAL * x[:, :2] / x[:, 2:] + np.array(pictures.SIZE) / 2
        rows, columns = np.nonzero(mask)
        low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
        assert np.abs(low - pixel.min(0)).max() < 1.5 and np.abs(high - pixel.max(0)).max() < 1.5
        assert (
            mask[rows.min() + 3 : rows.max() - 3, columns.min() + 5 : columns.max() - 5].mean()
            > 0.97
        )


def test_frames_show_the_texture_on_the_true_surface(bent):
    """The solver's own misfit of the truth is small, and large where the texture is turned over or
    the surface is off by six pixels.
    """
    folder, vertices = bent
    experiment = scene.load(str(ROOT / "scenes" / "bend.xml"), {"data": str(folder)})
    problem = Problem(experiment, experiment.sequence())
    registration = data_of(problem)
    finest = problem.rules.blurs[-1]
    for t, x in enumerate(vertices):
        assert registration.misfit(x, t, finest) < 0.08
        assert registration.misfit(x + [0.007, 0, 0], t, finest) > 0.15
        assert registration.misfit((x - x.mean(0)) * [1, -1, 1] + x.mean(0), t, finest) > 0.3


def test_drag_pushes_along_the_normal_and_not_in_still_air():
    flat, _ = simulate.sheet(KIND)
    nx = KIND.cells[0]
    faces = np.array([[0, 1, nx + 2]])
    still = simulate.drag(flat, np.zeros_like(flat), faces, np.zeros((1, 3)))
    gust = simulate.drag(flat, np.zeros_like(flat), faces, np.array([[3.0, 0.0, 2.0]]))
    assert not still.any()
    area = 0.5 * KIND.size[0] / nx * KIND.size[1] / KIND.cells[1]
    assert gust.sum(0) == pytest.approx([0, 0, 0.5 * simulate.AIR * area * 2.0 * np.hypot(3, 2)])
    with_the_wind = simulate.drag(
        flat, np.tile([3.0, 0.0, 2.0], (len(flat), 1)), faces, np.array([[3.0, 0.0, 2.0]])
    )
    assert np.abs(with_the_wind).max() < 1e-12


@pytest.mark.parametrize("name", shapes.ROUNDED)
def test_rounded_shapes_are_sewn_and_their_hands_move_rigidly(name):
    shape, kind = shapes.ROUNDED[name](), simulate.KINDS[name]
    edges, faces = edges_of(shape.faces)
    boundary = (np.bincount(faces.ravel(), minlength=len(edges)) == 1).sum()
    euler = len(shape.vertices) - len(edges) + len(shape.faces)
    tube, closed, disc = (0, True), (2, False), (1, True)
    wanted = {"skirt": tube, "pillow": closed, "roll": disc, "tube": tube}[name]
    assert (euler, boundary > 0) == wanted
    normal = np.cross(
        *(shape.vertices[shape.faces[:, k]] - shape.vertices[shape.faces[:, 0]] for k in (1, 2))
    )
    outwards = (normal * (shape.vertices[shape.faces].mean(1) - [0, 0, shapes.DEPTH])).sum(1)
    assert (outwards > 0).all() or (outwards < 0).all()
    weather = simulate.Weather(name, kind, shape.vertices, shape.held, np.random.default_rng(0))
    start, end = (weather.points(t) for t in (0.0, 0.4))
    assert np.allclose(start, shape.vertices[shape.held]) and np.abs(end - start).max() > 0.005
    hands = [start[:, 0] < 0, start[:, 0] >= 0] if name in ("pillow", "tube") else [slice(None)]
    for hand in hands:
        apart = [np.linalg.norm(x[hand][:, None] - x[hand], axis=-1) for x in (start, end)]
        assert np.allclose(*apart, atol=1e-9)


def test_a_camera_sees_the_front_of_a_closed_shape(tmp_path):
    shape = shapes.pillow()
    rng = np.random.default_rng(0)
    seen = pictures.render(str(tmp_path), shape.vertices[None], shape, rng)[0]
    height, inner = shape.vertices[:, 2] - shapes.DEPTH, np.abs(shape.vertices[:, 0]) < 0.08
    # a ray may slip through between two triangles
    assert seen[inner & (height > 0.01)].mean() < 0.02 and seen[inner & (height < -0.01)].all()


def test_a_folder_that_exists_is_refused(tmp_path):
    (tmp_path / "flag").mkdir()
    with pytest.raises(InputError, match="exists already; another OUT is needed"):
        simulate.main([str(tmp_path), "--only", "flag"])


def test_a_drape_fills_the_image_and_has_its_front_on_the_left_of_the_texture(
    tmp_path, monkeypatch
):
    drapes = load("benchmarks/drape_sequence.py")
    monkeypatch.setattr(drapes, "FRAMES", 3)
    monkeypatch.setattr(drapes, "VERTICES", 300)
    with pytest.raises(InputError, match="shorts: GARMENT:MOTION is needed"):
        drapes.main([str(tmp_path), "--drapes", "shorts"])
    drapes.main([str(tmp_path), "--drapes", "shorts:squat"])
    truth = np.load(tmp_path / "shorts_squat" / "gt.npz")
    x, seen = truth["vertices"].astype(float), truth["seen"]
    pixel = pictures.FOCAL * x[..., :2] / x[..., 2:] + np.array(pictures.SIZE) / 2
    assert (pixel > 0).all() and (pixel < pictures.SIZE).all()
    assert np.ptp(pixel, axis=(0, 1))[1] > 0.6 * pictures.SIZE[1] and 0.2 < seen.mean() < 0.6
    settings = {"data": str(tmp_path / "shorts_squat")}
    template = scene.load(str(ROOT / "scenes" / "tube.xml"), settings).template
    assert len(template) >= 2  # patches
    centre = template.vertices[template.faces].mean(1)
    front = centre[:, 2] < np.median(centre[:, 2]) - 0.05
    u = template.texcoords.corners[..., 0]
    assert front.sum() > 50 and u[front].max() <= 0.5
