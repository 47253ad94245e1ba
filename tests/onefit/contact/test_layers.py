from dataclasses import replace

import numpy as np
import pytest
import trimesh
from test_contact import COTTON, grid

from onefit.contact import SelfContact
from onefit.objective import crossings
from onefit.physics import Settings, WornCloth
from onefit.physics.cloth import Cloth
from onefit.physics.sheet import Sheet

SETTINGS = Settings()
CONTACT = SETTINGS.contact


def of(sheet):
    """The contact of a sheet with itself."""
    stiffness = CONTACT.layer_stiffness * sheet.firmness
    return SelfContact(sheet.cut, sheet.faces, CONTACT, stiffness, 0)


def two(one, other):
    """Vertices and faces of two meshes as one."""
    (V, F), (W, G) = one, other
    return np.concatenate([V, W]), np.concatenate([F, G + len(V)])


def test_a_layer_that_falls_on_another_stays_on_it():
    V, F = grid(10, 10, 0.012)
    V2 = V * [0.6, 0.6, 1] + [0, 0, 0.015]
    sheet = Sheet(np.concatenate([V, V2]), np.concatenate([F, F + len(V)]), COTTON)
    itself = of(sheet)
    x = sheet.rest - [0, 0, 0.009] * (np.arange(len(sheet)) >= len(V))[:, None]  # 6 mm above it
    cloth = Cloth(sheet, x, SETTINGS, len(sheet))
    fixed = np.where(np.arange(len(sheet)) < len(V), 1e3, 0.0)
    for _ in range(40):
        contacts = itself.find(cloth.x, cloth.v / 60)
        cloth.step(1 / 60, [contacts], sheet.rest, fixed)
    above = cloth.x[len(V) :, 2] - cloth.x[: len(V), 2].mean()
    assert above.min() > 0 and above.max() < 2 * CONTACT.apart


def test_a_narrow_strip_that_falls_across_another_is_held_by_its_edges():
    # neither has a vertex above or below a face of the other
    one = np.array([[x, y, 0.0] for x in (-0.08, 0.08) for y in (-0.004, 0.004)])
    other = np.array([[x, y, 0.2] for y in (-0.08, 0.08) for x in (0.004, -0.004)])
    faces = np.array([[0, 2, 1], [1, 2, 3]])
    V, F = two((one, faces), (other, faces))
    sheet = Sheet(V, F, COTTON)
    itself, x = of(sheet), V - [0, 0, 0.195] * (V[:, 2:] > 0.1)
    cloth = Cloth(sheet, x, SETTINGS, len(sheet))
    fixed = np.where(np.arange(8) < 4, 1e4, 0.0)
    for _ in range(30):
        contacts = itself.find(cloth.x, cloth.v / 60)
        assert (np.sign(contacts.weights) == [1, 1, -1, -1]).all() and len(contacts.key) >= 4
        cloth.step(1 / 60, [contacts], x, fixed)
    assert cloth.x[4:, 2].min() > 0 and cloth.x[4:, 2].max() < 2 * CONTACT.apart
    assert crossings(cloth.x, F) == 0


@pytest.mark.parametrize("speed", [0.05, 0.5])  # [m/s], 8 mm a step the faster
def test_strips_whose_edges_alone_meet_do_not_pass_through_each_other(speed):
    V, F = grid(2, 4, 1.0)
    across = V[:, [1, 0, 2]] * [0.03, 0.01, 0]  # along x
    edge_on = V[:, [2, 1, 0]] * [0, 0.03, 0.02] + [0, 0, 0.04]  # upright, along y, 3 cm up
    sheet = Sheet(*two((across, F), (edge_on, F)), COTTON)
    itself = of(sheet)
    falls = np.arange(len(sheet)) >= len(V)
    x = sheet.rest - [0, 0, 0.024] * falls[:, None]  # 6 mm
    cloth = Cloth(sheet, x, SETTINGS, len(sheet))
    cloth.v[falls, 2] = -speed
    for _ in range(20):
        contacts = itself.find(cloth.x, cloth.v / 60)
        cloth.step(1 / 60, [contacts], sheet.rest, np.where(falls, 0.0, 1e3))
        assert crossings(cloth.x, sheet.faces) == 0
    assert (cloth.x - x)[falls, 2].mean() > -0.02  # it did not fall past


def test_what_flies_farther_in_a_step_than_its_edges_are_long_does_not_pass_through():
    V, F = grid(9, 9, 0.014)
    two_sheets, faces = two((V, F), (V + [0.004, 0.003, 0.03], F))
    upper = np.arange(len(two_sheets)) >= len(V)
    cut = two_sheets + [0, 0, 1.0] * upper[:, None]  # they are not neighbours
    sheet = Sheet(two_sheets, faces, COTTON, cut=cut)
    far = np.array([[0.0, 0, -9], [1, 0, -9], [0, 1, -9], [0, 0, -10]])
    body = far, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])

    def after(settings):
        worn = WornCloth(sheet, sheet.rest, *body, settings)
        worn.cloth.v[:, 2] = np.where(upper, -2.0, 0.0)  # 33 mm in a step
        for _ in range(4):
            worn.step(1 / 60, body[0], sheet.rest, 1.0 * ~upper)
        return crossings(worn.cloth.x, faces)

    assert after(replace(SETTINGS, parts=1)) > 0
    assert after(SETTINGS) == 0


def test_what_is_near_at_rest_but_far_along_the_sheet_is_a_layer():
    """Two legs, 8 mm from each other where they are made, as trousers between the thighs."""
    V, F = grid(60, 6, 0.01)
    s, x = V[:, 0], V.copy()
    x[:, 0], x[:, 2] = np.abs(s), np.clip(s, -0.004, 0.004)
    sheet = Sheet(x, F, COTTON)
    assert len(of(sheet).find(1.25 * x).key) == 0  # 10 mm from each other
    contacts = of(sheet).find(x * [1, 1, 0.625])  # 5 mm
    far = np.flatnonzero((np.abs(s) > 0.03) & (np.abs(s) < 0.28))
    assert np.isin(far, contacts.corners).all()


def closest(p, *corners):
    """Barycentric coordinates of the point of a triangle nearest to p."""
    triangle = np.stack(corners)[None]
    nearest = trimesh.triangles.closest_point(triangle, p[None])
    return trimesh.triangles.points_to_barycentric(triangle, nearest)[0]


def pairs_of(sheet, x, way):
    """What :meth:`SelfContact.find` finds, all against all: {corners: vector}, a vertex and the
    corners of what is nearest to it, or two sorted edges.
    """
    rest, F, found = sheet.cut, sheet.faces, {}
    beside, near = np.zeros(len(x), bool), 2 * CONTACT.apart

    def is_layer(away, at_rest, against):
        distance = np.linalg.norm(away)
        comes_to = distance + min(against @ away / distance, 0)
        return comes_to < near and np.linalg.norm(at_rest) > max(2 * distance, near)

    for i in range(len(x)):
        best, inner = (np.inf, None, None), False
        for corners in F:
            if i in corners:
                continue
            on = closest(x[i], *x[corners])
            away, at_rest, against = (y[i] - on @ y[corners] for y in (x, rest, way))
            if is_layer(away, at_rest, against):
                beside[i], key = True, (i, *sorted(corners[on > 1e-4]))
                if on.min() > 1e-4:
                    found[key] = away
                if np.linalg.norm(away) < best[0]:
                    best, inner = (np.linalg.norm(away), key, away), on.min() > 1e-4
        if best[1] and not inner:
            found[best[1]] = best[2]
    goes = np.linalg.norm(way - way.mean(0), axis=1)
    is_long = lambda ends: (
        np.linalg.norm(np.diff(rest[ends], axis=0)) > 2 * (near + goes[ends].max())
    )
    E = sheet.edges
    for e, (i, j) in enumerate(E):
        for m, n in E[:e]:
            A = np.stack([x[j] - x[i], x[m] - x[n]], 1)
            (s, t), *_ = np.linalg.lstsq(A, x[m] - x[i], rcond=None)
            weights = np.array([1 - s, s, t - 1, -t])
            away, at_rest, against = (weights @ y[[i, j, m, n]] for y in (x, rest, way))
            between = min(s, t) > 0 and max(s, t) < 1 and not {i, j} & {m, n}
            looks = any(beside[ends].any() or is_long(ends) for ends in ([i, j], [m, n]))
            if between and looks and is_layer(away, at_rest, against):
                found[tuple(sorted([(i, j), (m, n)]))] = away
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_are_those_that_a_search_of_all_against_all_finds(seed):
    rng = np.random.default_rng(seed)
    V, F = two(grid(7, 7, 0.015), grid(6, 6, 0.015))
    V[49:] += [0, 0, 1.0]
    sheet = Sheet(V, F, COTTON)
    x = V - [0, 0, 0.992] * (np.arange(len(V)) >= 49)[:, None]
    x += rng.normal(size=x.shape) * [0.002, 0.002, 0.002]
    way = rng.normal(size=x.shape) * 0.003 * rng.uniform(0, 3, (len(x), 1))
    way[49:, 2] -= 0.004
    contacts = of(sheet).find(x, way)
    found = {}
    for corners, weights, normal in zip(contacts.corners, contacts.weights, contacts.normal):
        vector = weights @ x[corners]
        assert normal @ vector == pytest.approx(np.linalg.norm(vector), rel=1e-3)
        i, j, m, n = (int(v) for v in corners)
        edges = weights[1] > 0
        key = (i, *sorted(corners[1:][weights[1:] < -1e-4]))
        key = tuple(sorted([(i, j), (m, n)])) if edges else key
        assert key not in found
        found[key] = vector
    expected = pairs_of(sheet, x, way)
    assert len(expected) > 50 and sum(isinstance(k[0], tuple) for k in expected) > 20
    assert set(found) <= set(expected)
    assert all(apart(key, x, way - way.mean(0)) for key in set(expected) - set(found))
    for key, vector in found.items():
        assert np.allclose(np.abs(expected[key]), np.abs(vector), atol=2e-6)


def apart(key, x, way):
    """Whether the boxes in which the two of a pair move are farther from each other than a search
    looks: they come nearer, but past each other.
    """
    one, other = key if len(key) == 2 and isinstance(key[0], tuple) else (key[:1], key[1:])
    places = [np.concatenate([x[list(k)], (x + way)[list(k)]]) for k in (one, other)]
    low, high = (np.stack([f(p, axis=0) for p in places]) for f in (np.min, np.max))
    return (low.max(0) - high.min(0)).max() > 2 * CONTACT.apart


def test_what_has_slipped_through_is_drawn_back():
    V, F = two(grid(7, 7, 0.015), grid(6, 6, 0.015))
    V[49:] += [0.001, 0.002, 1.0]
    sheet = Sheet(V, F, COTTON)
    at = lambda height: V - [0, 0, 1.0 - height] * (np.arange(len(V)) >= 49)[:, None]
    slipped = of(sheet).find(at(-0.001))
    itself = of(sheet)
    itself.find(at(0.002))
    again = itself.find(at(-0.001))
    upwards = lambda c: np.sign((c.weights * (c.corners >= 49)).sum(1) * c.normal[:, 2])
    assert (upwards(slipped) == -1).all()  # without a past it is below
    sided = (again.weights[:, 1] > 0) | (again.weights[:, 1:].max(1) < 0)
    assert sided.sum() > 50 and (upwards(again)[sided] == 1).all()
    vectors = np.einsum("ck,ckd->cd", again.weights, at(-0.001)[again.corners])
    gap = np.einsum("cd,cd->c", vectors, again.normal) - again.offset
    assert gap[sided] == pytest.approx(-0.001 - CONTACT.apart, abs=1e-6)


def test_neighbours_do_not_touch_and_a_tight_fold_does():
    V, F = grid(40, 6, 0.01)
    sheet = Sheet(V, F, COTTON)
    itself, radius = of(sheet), 0.0025
    assert len(itself.find(sheet.rest).key) == 0
    s, x = V[:, 0], V.copy()  # around half a circle
    turn = np.clip(s / radius, -np.pi / 2, np.pi / 2)
    over = np.abs(s) - radius * np.pi / 2
    x[:, 0] = np.where(over > 0, -over, radius * np.cos(turn))
    x[:, 2] = radius * np.sin(turn)
    contacts = itself.find(x)
    assert len(np.unique(contacts.corners[:, 0])) > 0.6 * len(V)
    assert np.abs(contacts.normal[:, 2]).min() > 0.5


def test_a_cut_in_folds_rests_on_its_folds():
    # the rest shape of what hangs in folds says nothing of who is whose neighbour; its cut does
    V, F = grid(24, 4, 0.01)
    hung = V.copy()
    hung[:, 0], hung[:, 2] = np.abs(V[:, 0]), 0.0012 * np.sign(V[:, 0])
    folded = np.abs(V[:, 0]) > 0.05
    corners = V[F]
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    of_rest = of(Sheet(hung, F, COTTON)).find(hung)
    of_cut = of(Sheet(hung, F, COTTON, sides, V)).find(hung)
    assert len(of_rest.key) == 0
    assert set(np.flatnonzero(folded)) <= set(of_cut.corners[:, 0])
