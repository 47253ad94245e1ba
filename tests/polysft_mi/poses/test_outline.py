"""A template's outline on the edges of an image: against known poses, of prints with a drawn frame
and of sheets before a background.
"""

import cv2
import numpy as np
import pytest
from scipy.optimize import check_grad
from scipy.spatial.transform import Rotation
from synthetic import grid_faces

from polyfit.mesh import loops
from polysft_mi.camera import Intrinsics
from polysft_mi.poses import OutlineSettings, fitted, outline

CAMERA = Intrinsics(500.0, 500.0, 315.0, 242.0, 640, 480)
WIDTH, HEIGHT = 0.3, 0.24
PIXELS_A_METRE = 3000
FEW = OutlineSettings(starts=3)  # where the outline lies well already, or nowhere


def grid(rows=7, columns=9, width=WIDTH, height=HEIGHT):
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, columns) * width, np.linspace(-0.5, 0.5, rows) * height
    )
    return np.stack([x, y, 0 * x], -1).reshape(-1, 3), grid_faces(rows, columns)


def pose(turn=(0.25, -0.3, 0.08), at=(0.01, -0.015, 0.6)):
    return lambda x: Rotation.from_rotvec(turn).apply(x) + at


def shifted(points, seed, pixels=3.0):
    """The points after a small rigid motion, which moves their projections by so many pixels."""
    rng = np.random.default_rng(seed)
    step, centre = rng.normal(size=6) * (0.03, 0.03, 0.015, 0.003, 0.003, 0.008), points.mean(0)
    for _ in range(3):
        moved = Rotation.from_rotvec(step[:3]).apply(points - centre) + centre + step[3:]
        step = step * (pixels / missed(moved, points))
    return moved


def missed(a, b):
    return np.sqrt(((CAMERA.project(a) - CAMERA.project(b)) ** 2).sum(1).mean())


def picture(place, frame=None, paper=230, second=0.0, seed=0):
    """(480, 640, 3) uint8: a sheet of paper with a print full of strokes, of WIDTH x HEIGHT, where
    ``place`` puts it, before a dim background. ``frame``: grey of a line of 1.2 mm around the
    print, around which there is paper; ``second`` [m]: at what distance outside another line runs
    along its left side.
    """
    rng = np.random.default_rng(seed)
    margin = 0.05 if frame is not None else 0.0
    size = [round(PIXELS_A_METRE * (s + 2 * margin)) for s in (WIDTH, HEIGHT)]
    flat = np.full((size[1], size[0], 3), paper, np.uint8)
    at = lambda p: tuple(
        round(PIXELS_A_METRE * (v + s / 2 + margin) - 0.5) for v, s in zip(p, (WIDTH, HEIGHT))
    )
    for _ in range(250):
        a = rng.uniform(-0.47, 0.47, 2) * (WIDTH, HEIGHT)
        b = np.clip(a + rng.normal(size=2) * 0.02, *np.outer((-0.47, 0.47), (WIDTH, HEIGHT)))
        cv2.line(flat, at(a), at(b), tuple(int(v) for v in rng.integers(0, 150, 3)), 4, cv2.LINE_AA)
    if frame is not None:
        thick = round(PIXELS_A_METRE * 0.0012)
        cv2.rectangle(
            flat, at((-WIDTH / 2, -HEIGHT / 2)), at((WIDTH / 2, HEIGHT / 2)), (frame,) * 3, thick
        )
        if second:
            cv2.line(
                flat,
                at((-WIDTH / 2 - second, -HEIGHT / 2)),
                at((-WIDTH / 2 - second, HEIGHT / 2)),
                (frame,) * 3,
                thick,
            )
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * (
        WIDTH / 2 + margin,
        HEIGHT / 2 + margin,
        0,
    )
    s = 4
    to = s * CAMERA.project(place(corners)) - 0.5
    of = np.array([(0, 0), (size[0], 0), (size[0], size[1]), (0, size[1])]) - 0.5
    large = cv2.resize(
        rng.integers(20, 90, (60, 80, 3)).astype(np.uint8),
        (640 * s, 480 * s),
        interpolation=cv2.INTER_CUBIC,
    )
    cv2.warpPerspective(
        flat,
        cv2.getPerspectiveTransform(np.float32(of), np.float32(to)),
        (640 * s, 480 * s),
        large,
        cv2.INTER_AREA,
        cv2.BORDER_TRANSPARENT,
    )
    small = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA).astype(np.float64)
    return np.clip(small + rng.normal(size=small.shape) * 3, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("frame, paper, seed", [(30, 230, 0), (None, 230, 1), (240, 120, 2)])
def test_pose_is_recovered(frame, paper, seed):
    """A dark or a bright line around the print, or the sheet's own edge: its middle, or the edge,
    within a fraction of a pixel.
    """
    vertices, faces = grid()
    truth, image = pose()(vertices), picture(pose(), frame, paper)
    (loop,) = loops(faces)
    start = shifted(truth, seed)
    fit = fitted(start, faces, CAMERA, image)
    found = fit(start)
    assert fit.sure and fit.clear > 2
    assert missed(start, truth) == pytest.approx(3, rel=0.05) and missed(found, truth) < 0.25
    assert np.abs(found - truth).max() < 3e-3  # 0.5 % of the distance
    np.testing.assert_allclose(fit.rotation @ fit.rotation.T, np.eye(3), atol=1e-9)
    assert fit.moved == pytest.approx(missed(found[loop], start[loop]), rel=0.1)
    again = fitted(found, faces, CAMERA, image, FEW)
    assert again.moved < 0.25  # it stays there


def test_gap_between_two_lines_is_no_line():
    vertices, faces = grid()
    truth, image = pose()(vertices), picture(pose(), 30, second=0.006)
    fit = fitted(shifted(truth, 1, 2.0), faces, CAMERA, image)
    assert fit.sure and missed(fit(shifted(truth, 1, 2.0)), truth) < 0.2


def test_digitised_outline_is_straightened():
    """Corners are where they should be, and what lies between is a pixel off: the polygon fits
    better, and is taken.
    """
    vertices, faces = grid()
    image = picture(pose(), 30)
    uneven = vertices.copy()
    inner = np.setdiff1d(np.arange(len(vertices)), [0, 8, 54, 62])
    uneven[inner, :2] += np.random.default_rng(0).normal(size=(len(inner), 2)) * 0.0006 + (
        0,
        0.0008,
    )
    start = shifted(pose()(uneven), 2)
    assert (
        missed(
            fitted(start, faces, CAMERA, image)(start)[[0, 8, 54, 62]],
            pose()(vertices)[[0, 8, 54, 62]],
        )
        < 0.45
    )


def test_what_edges_do_not_tell_is_left():
    vertices, faces = grid()
    framed = picture(pose(), 30)
    smaller = pose()(0.7 * vertices)  # amid the strokes
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    for points, image in (
        (smaller, framed),
        (pose()(vertices), noise),
        (pose()(vertices), np.full_like(noise, 128)),
    ):
        fit = fitted(points, faces, CAMERA, image, FEW)
        assert not fit.sure and np.isfinite(fit.clear) and np.isfinite(fit(points)).all()
    three = framed.copy()
    right = CAMERA.project(pose()(vertices))[8::9, 0].min()
    three[:, int(right) - 25 :] = 128  # one side cannot be seen, the others can
    fit = fitted(pose()(vertices), faces, CAMERA, three, FEW)
    assert not fit.sure and fit.clear > 2
    assert fitted(pose(at=(0, 0, -0.6))(vertices), faces, CAMERA, framed) is None
    closed = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    assert fitted(np.random.default_rng(0).random((4, 3)) + 1, closed, CAMERA, framed) is None


def test_gradient_against_finite_differences():
    vertices, faces = grid()
    image = picture(pose(), 30)
    start = shifted(pose()(vertices), 0)
    loop = loops(faces)[0]
    ends = np.stack([start[loop], start[np.roll(loop, -1)]], 1)
    grey = cv2.GaussianBlur(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255, (0, 0), 1.0
    )
    search = outline.OutlineSearch(ends, CAMERA, grey, 1.2, "dark")
    turn, shift = Rotation.from_rotvec((0.01, -0.02, 0.005)), np.array([1e-3, -2e-3, 4e-3])
    cost, _ = search.costs(turn, shift, 2.5)
    for seed in range(5):
        q = np.random.default_rng(seed).normal(size=6)
        assert check_grad(
            lambda q: cost(q)[0], lambda q: cost(q)[1], q, epsilon=1e-6
        ) < 2e-3 * np.linalg.norm(cost(q)[1])


def test_loops():
    vertices, faces = grid(4, 5)
    (loop,) = loops(faces)
    assert sorted(loop.tolist()) == sorted(set(range(20)) - {6, 7, 8, 11, 12, 13})
    steps = np.linalg.norm(vertices[loop] - vertices[np.roll(loop, -1)], axis=1)
    assert steps.max() < 0.09  # neighbours follow each other
    _, faces = grid(6, 7)
    assert sorted(len(x) for x in loops(faces[~(faces == 24).any(axis=1)])) == [6, 22]  # a hole
    assert loops(np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])) == []
