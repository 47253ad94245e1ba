import numpy as np
import pytest
import trimesh

from onefit.body import ClosestSurface
from onefit.contact import Contacts, ContactSettings, SkinContact
from onefit.contact.points import samples
from onefit.physics import MATERIALS, Settings, Sheet, WornCloth
from onefit.physics.cloth import Cloth

COTTON = MATERIALS["cotton"]


def grid(columns, rows, side):
    """A square sheet in the plane z = 0 around the origin, its triangles facing up."""
    V = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), -1).reshape(-1, 2)
    a = (np.arange(columns - 1)[:, None] * rows + np.arange(rows - 1)).ravel()
    F = np.concatenate(
        [np.stack([a, a + rows, a + 1], 1), np.stack([a + 1, a + rows, a + rows + 1], 1)]
    )
    V = side * (V - V.mean(0))
    return np.concatenate([V, np.zeros((len(V), 1))], 1), F


def on_body(sheet, x, body, faces, steps, moving=lambda t: 0.0):
    """The cloth after steps of 1 / 60 s on a body that is moved by ``moving(t)`` (3,) [m], and how
    far its vertices and points of its faces are from the body [m].
    """
    worn = WornCloth(sheet, x, body, faces, Settings())
    for k in range(steps):
        worn.step(1 / 60, body + moving((k + 1) / 60), x, 0.0)
    corners, weights = samples(sheet.rest, sheet.faces, ContactSettings().spacing)
    x = worn.cloth.x
    points = np.concatenate([x, np.einsum("sk,ski->si", weights, x[corners])])
    surface = ClosestSurface(body + moving(steps / 60), faces)
    return worn.cloth, surface(points, 1.0).distance


def test_no_point_of_a_face_is_in_a_ball_that_cloth_falls_on():
    V, F = grid(15, 15, 0.03)  # coarser than the ball's curvature: chords of 42 mm
    sheet = Sheet(V, F, COTTON)
    ball = trimesh.creation.icosphere(4, 0.1)
    cloth, distance = on_body(sheet, V + [0, 0, 0.11], ball.vertices, ball.faces, 60)
    assert distance.min() > 0
    fine = np.random.default_rng(0).dirichlet((1, 1, 1), 40)
    points = np.einsum("sk,fkd->fsd", fine, cloth.x[F]).reshape(-1, 3)
    assert np.linalg.norm(points, axis=1).min() > 0.1 - 5e-4
    assert cloth.x[:, 2].min() < 0.05  # and it did fall around it


@pytest.mark.parametrize("friction, held", [(0.6, True), (0.05, False)])
def test_friction_holds_cloth_on_a_slope_or_does_not(friction, held):
    V, F = grid(6, 6, 0.02)
    slope = np.arctan(0.3)
    c, s = np.cos(slope), np.sin(slope)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    box = trimesh.creation.box((2, 2, 0.2)).subdivide().subdivide()
    material = type(COTTON)(**(vars(COTTON) | {"friction": friction, "drag": 0.0}))
    x = (V + [0, 0, 0.1 + ContactSettings().clearance]) @ turn.T
    cloth, _ = on_body(Sheet(V, F, material), x, box.vertices @ turn.T, box.faces, 60)
    slid = np.linalg.norm((cloth.x - x).mean(0))
    expected = 9.81 * (s - friction * c) / 2
    assert slid < 0.01 if held else slid == pytest.approx(expected, rel=0.25)


def test_a_fast_body_takes_cloth_along():
    V, F = grid(8, 8, 0.015)
    ball = trimesh.creation.icosphere(4, 0.1)
    fast = lambda t: np.array([0.0, 0.0, 4.0 * t])  # 67 mm a step, two thirds of the radius
    cloth, distance = on_body(
        Sheet(V, F, COTTON), V + [0, 0, 0.105], ball.vertices, ball.faces, 15, moving=fast
    )
    assert distance.min() > 0
    assert (cloth.x[:, 2] - 1.0).min() > 0  # on the side on which it was


@pytest.mark.parametrize("gap", [0.0003, 0.0015, 0.004])
def test_cloth_in_a_crease_of_the_skin_lies_in_neither_side(gap):
    """Wherever between the two it was pressed to, though both cannot have their clearance."""
    box = trimesh.creation.box((0.2, 0.2, 0.1)).subdivide().subdivide()
    high = 0.05 + gap / 2
    body = np.concatenate([box.vertices + [0, 0, high], box.vertices - [0, 0, high]])
    surface = ClosestSurface(body, np.concatenate([box.faces, box.faces + len(box.vertices)]))
    V, F = grid(4, 4, 0.01)
    limits = dict.fromkeys(("least", "point_near", "point_least"), 0.001)
    skin = SkinContact(V, F, ContactSettings(), reach=0.03, deepest=0.03, **limits)
    for share in (-2.0, -0.6, -0.4, 0.0, 0.3, 0.6, 3.0):
        at = skin.vertices(V + [0, 0, share * gap])
        skin.look(at, surface)
        pushed = V + [0, 0, share * gap] + skin.push_out(at, surface)
        assert surface(pushed, 1.0).distance.min() > 0


def test_points_of_faces_lie_no_farther_apart_than_the_spacing():
    V, F = grid(3, 3, 0.1)
    sheet = Sheet(V, F, COTTON)
    corners, weights = samples(sheet.rest, sheet.faces, 0.02)
    assert np.allclose(weights.sum(1), 1) and (weights >= 0).all()
    points = np.concatenate([V, (V[corners] * weights[..., None]).sum(1)])
    drawn = np.random.default_rng(0).dirichlet((1, 1, 1), 200) @ V[F[0]]
    nearest = np.linalg.norm(drawn[:, None] - points, axis=-1).min(1)
    assert nearest.max() < 0.02
    assert len(samples(sheet.rest, sheet.faces, 0.2)[0]) == 0


def test_the_matrix_of_contacts_between_cloth_and_cloth_is_their_gradients_derivative():
    V, F = grid(6, 6, 0.02)
    sheet, rng = Sheet(V, F, COTTON), np.random.default_rng(0)
    cloth = Cloth(sheet, V, keys=4)
    cloth.load[:], cloth.slip[:] = rng.random(4), 0.01
    corners = np.array([[0, 7, 20, 30], [3, 9, 10, 15], [35, 1, 2, 8], [12, 13, 20, 21]])
    weights = np.array([[0.4, 0.6, -0.2, -0.8], [1, -0.2, -0.3, -0.5]] * 2)
    normal = rng.normal(size=(4, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    between = weights @ np.ones(4)
    assert np.allclose(between, 0)
    offset, moved = np.array([1.0, 1.0, 1.0, -1.0]), rng.normal(size=(4, 3))  # the last is open
    contacts = Contacts(np.arange(4), corners, weights, normal, offset, moved, np.full(4, 30.0))
    touches, step, size = cloth.touches([contacts], 1 / 60), rng.normal(size=V.shape), 1e-6
    of = lambda y: cloth.assemble(y, 1 / 60, touches).copy() - cloth.assemble(y, 1 / 60)
    expected = (of(V + size * step) - of(V - size * step)) / (2 * size)
    cloth.assemble(V, 1 / 60)
    alone = cloth.product(step)
    cloth.assemble(V, 1 / 60, touches)
    assert np.abs(expected).max() > 1
    assert np.abs(cloth.product(step) - alone - expected).max() < 1e-6 * np.abs(expected).max()


def test_a_point_of_an_edge_moves_the_edge_and_not_the_corner_beside_it():
    ball = trimesh.creation.icosphere(3, 0.01)
    x = np.array([[-0.02, 0, 0.008], [0.02, 0, 0.008], [0, 0.06, 0.008]])
    limits = dict.fromkeys(("least", "point_near", "point_least"), 0.001)
    skin = SkinContact(
        x, np.array([[0, 1, 2]]), ContactSettings(), reach=0.03, deepest=0.03, **limits
    )
    surface, at = ClosestSurface(ball.vertices, ball.faces), skin.vertices(x)
    skin.look(at, surface)
    push = skin.push_out(at, surface)
    assert push[:2, 2] == pytest.approx(0.003, abs=2e-4) and not push[2].any()
