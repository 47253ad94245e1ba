"""Sums on the device: pixels to triangles, triangles to vertices, vertices to unknowns, each
against a slow sum on the host.
"""

import dataclasses
import gc
import itertools
import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import synthetic
from problems import dense, grid_template, problem_of
from scipy.spatial.transform import Rotation

from polysft_mi import solvers
from polysft_mi.images import pixels
from polysft_mi.images.pyramid import FARTHEST, Level
from polysft_mi.images.registration import Registration
from polysft_mi.objective.assembly import Assembly
from polysft_mi.render.device import frozen, interruptible, on_device
from polysft_mi.render.raster import RasterIntegrator
from polysft_mi.solvers.normal_equations import Chart, Pattern, State, hinges
from polysft_mi.tracker import Track, track

LEVEL = Level(1.0, 1, 8.0)


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return problem_of(
        synthetic.cloth(
            tmp_path_factory.mktemp("assembly") / "cloth",
            frames=3,
            size=(160, 120),
            rows=9,
            columns=12,
        ).folder
    )


def surfaces(problem):
    """Vertices (N, 3) [m] of the template: nearer and farther, turned, creased and folded over
    itself.
    """
    rest = problem.template.vertices
    middle = rest.mean(0)
    near = middle + (rest - middle) * [1.15, 1.05, 1.0] - [0, 0, 0.04]
    turned = Rotation.from_rotvec([0.4, 1.0, 0.2]).apply(rest - middle) + middle
    folded = rest.copy()
    right = rest[:, 0] > middle[0]
    folded[right, 0] = 2 * middle[0] - rest[right, 0] + 0.004
    folded[right, 2] -= 0.01
    return near, turned, folded, rest + [0, 0, 0.2]


# -- from pixels to triangles ------------------------------------------------


def test_sums_over_each_triangles_pixels(problem):
    known, rng = Registration(problem), np.random.default_rng(2)
    for vertices in surfaces(problem):
        view = known._look(vertices, LEVEL)
        triangle = np.array(view.triangle)
        found = rng.random((3, len(triangle), 4)).astype(np.float32)
        arrays = [mi.Vector4f(*(on_device(x[:, k], mi.Float) for k in range(4))) for x in found]
        table, figures = (
            np.array(x).reshape(len(known.faces), -1)
            for x in pixels.by_triangle(view.seen(), known._sheet, arrays)
        )
        expected = np.zeros((len(known.faces), 31))
        for t, second, slope, figure in zip(triangle, *found.astype(np.float64)):
            if t >= 0:
                corner = 1 - second[3] - slope[3], second[3], slope[3]
                expected[t, :18] += np.concatenate(
                    [corner[a] * corner[b] * second[:3] for a, b in pixels.CORNERS]
                )
                expected[t, 18:] += np.concatenate([*(b * slope[:3] for b in corner), figure])
        assert (triangle >= 0).sum() > 300
        assert (
            np.abs(np.column_stack([table, figures]) - expected).max()
            < 1e-5 * np.abs(expected).max()
        )


def test_a_triangle_behind_the_camera_misses_no_pixel_of_the_others(problem):
    known = Registration(problem)
    vertices = problem.template.vertices.copy()
    vertices[0, 2] = -0.5
    view = known._look(vertices, LEVEL)
    ones = [
        mi.Vector4f(*(dr.select(view.hit, mi.Float(x), 0) for x in (0.0, 0.0, 0.0, 1.0)))
    ] * 2 + [mi.Vector4f(dr.select(view.hit, mi.Float(1), 0))]
    _, figures = pixels.by_triangle(view.seen(), known._sheet, ones)
    seen = np.bincount(np.array(view.triangle) + 1, minlength=len(known.faces) + 1)[1:]
    assert seen.any() and np.array_equal(np.array(figures).reshape(-1, 4)[:, 0], seen)


def test_what_is_recorded_is_what_is_traced(problem):
    """Of regions, frames and outlines of any size, by the same record."""
    known = Registration(problem)
    levels = LEVEL, Level(2.0, 2, 8.0)
    sizes = set()
    for (k, vertices), level in itertools.product(enumerate(surfaces(problem)), levels):
        appearance = known.appearance(vertices + [0.003, 0, 0], level) if k else None
        with dr.suspend_grad():
            view = known._look(vertices, level)
            sizes.add(view.size)
            at, crossings = known._frame_level(1, level), known.raster.crossings(view, outline=True)
            given = *known._compared(view, 1, level, appearance), dr.opaque(mi.Float, 0.3)
            outline = view.seen(), crossings, at.mask, at.distance, known._corner_of
            table, figures = known._sums(*given)
            _, pairs = known._outline(*outline)
            numbers = on_device([1.0, 0.3, at.area, 1 / level.stride], mi.Float64)
            at_vertices = (
                known.assembly.tables,
                table,
                figures,
                on_device(vertices, mi.Float64),
                known.assembly._camera,
                numbers,
                pairs,
            )
            for recorded, arguments in (
                (known._sums, given),
                (known._outline, outline),
                (known.assembly._at_vertices, at_vertices),
            ):
                for a, b in zip(
                    flat(recorded(*arguments)), flat(recorded.__wrapped__(*arguments)), strict=True
                ):
                    assert np.array_equal(a, b, equal_nan=True), (recorded, level)
    assert len(sizes) == 2 * len(surfaces(problem))
    # with and without excess, or where sizes of other arrays agree: never once a call
    assert all(
        1 <= f.recorded.n_recordings <= 3
        for f in (known._sums, known._outline, known.assembly._at_vertices)
    )


def flat(found):
    """The arrays of a tree, as NumPy's."""
    if found is None:
        return []
    if dataclasses.is_dataclass(found):
        found = tuple(getattr(found, field.name) for field in dataclasses.fields(found))
    return (
        [x for part in found for x in flat(part)] if isinstance(found, tuple) else [np.array(found)]
    )


def test_pixels_of_a_silhouette_pull_alike_in_every_run(problem):
    """Threads add to vertices in any order."""
    known = Registration(problem)
    vertices = surfaces(problem)[2]
    runs = [known.evaluate(vertices, 1, LEVEL, 0.3).images for _ in range(20)]
    for name in ("gradient", "second"):
        first, *others = (np.array(getattr(x, name)) for x in runs)
        assert np.abs(first).max() > 0 and all(np.array_equal(first, x) for x in others)


@pytest.mark.parametrize("shift", [3.0, 8.0, 16.0])
def test_a_silhouettes_step_goes_far(problem, shift):
    """Beside its mask, a sheet is moved back by half of what it is off, or more; plain Gauss-Newton
    would go one pixel.
    """
    known = Registration(problem)
    pixel = (
        problem.template.vertices[:, 2:].mean()
        / known.camera.intrinsics().fx
        * np.array([1.0, 0, 0])
    )  # one to the right
    vertices = problem.template.vertices + shift * pixel
    images = known.evaluate(vertices, 0, Level(1.0), 1e-6).images  # at this scale no texture pulls
    slope = (np.array(images.gradient).reshape(-1, 3) @ pixel).sum()
    second, (i, j) = (
        np.array(images.second).reshape(-1, 2, 2)[:, 0, 0],
        (np.array(x) for x in (known.assembly.tables.i, known.assembly.tables.j)),
    )
    curvature = second[i == j].sum() + 2 * second[i != j].sum()
    assert 0.4 * shift < slope / curvature < 1.1 * shift


def test_beyond_the_surroundings_of_the_mask_a_silhouette_is_as_far_as_counts(problem):
    known, mask = (
        Registration(problem),
        pixels.Image.of(on_device(np.zeros(400), mi.Float), (20, 20), (2, 3)),
    )
    with dr.suspend_grad():
        view = known._look(problem.template.vertices, LEVEL)
        crossings, distance = (
            known.raster.crossings(view, outline=True),
            on_device(np.full(400, 2.0), mi.Float),
        )
        _, (*_, ci, cj, _excess, share) = pixels.outline(
            view.seen(), crossings, mask, distance, known._corner_of
        )
    assert int(view.region[0][0]) > 2 + 20
    slope = np.linalg.norm(np.array(ci + cj), axis=0)
    assert (
        np.allclose(np.array(share), 1 / np.maximum(1, FARTHEST * slope), rtol=1e-5)
        and (np.array(share) < 0.1).any()
    )


# -- from triangles to unknowns ----------------------------------------------


class Sums:
    """Random sums over triangles and silhouettes, and the quadratic model that they stand for:
    ``second`` (2N, 2N) in the vertices' projections [pixels of the video], ``slope`` (N, 3) in
    space."""

    weight, mask_weight, stride = 0.7, 0.4, 2

    def __init__(self, template, camera, rng, area, silhouette):
        faces, count = template.faces, len(template.chart)
        self.area = area
        self.figures = rng.uniform(0, 5, (len(faces), 4)).astype(np.float32)
        weight = self.weight / (area or self.figures[:, 1].sum())
        pixel = rng.normal(size=(len(faces), 4, 3, 2))
        blocks = np.einsum("frad,frbe->fabde", pixel, pixel)
        blocks = (
            blocks + blocks.transpose(0, 1, 2, 4, 3)
        ) / 2  # a pixel's derivatives by its three corners have one direction
        slopes = rng.normal(size=(len(faces), 3, 3))
        curvatures = np.stack(
            [blocks[:, a, b].reshape(-1, 4)[:, [0, 1, 3]] for a, b in pixels.CORNERS], 1
        )
        self.table = np.column_stack([curvatures.reshape(-1, 18), slopes.reshape(-1, 9)]).astype(
            np.float32
        )
        self.second, self.slope = np.zeros((count, 2, count, 2)), np.zeros((count, 3))
        for face, block, slope in zip(faces, blocks, slopes):
            self.slope[face] += weight * slope
            for a, b in itertools.product(range(3), repeat=2):
                self.second[face[a], :, face[b]] += weight / self.stride**2 * block[a, b]
        self.pairs = None
        if silhouette:
            i, j = np.concatenate(
                [template.edges[:9], template.edges[5:20, ::-1]]
            ).T  # both ways round, some twice
            ci, cj = rng.normal(size=(2, len(i), 2))
            excess, share = rng.uniform(-1, 1, len(i)), rng.uniform(0, 1, len(i))
            for p, q, cp, cq, e, s in zip(i, j, ci, cj, excess, share):
                for (x, cx), (y, cy) in itertools.product(((p, cp), (q, cq)), repeat=2):
                    self.second[x, :, y] += (
                        2 * self.mask_weight * s * np.outer(cx, cy) / self.stride**2
                    )
                for x, c in ((p, cp), (q, cq)):
                    self.slope[x] += (
                        2 * self.mask_weight * e / self.stride * c @ camera.by_position[x]
                    )
            vectors = [
                mi.Vector2f(*(on_device(c[:, k], mi.Float) for k in range(2))) for c in (ci, cj)
            ]
            self.pairs = (
                *(on_device(x, mi.UInt32) for x in (i, j)),
                *vectors,
                *(on_device(x, mi.Float) for x in (excess, share)),
            )
        self.second = self.second.reshape(2 * count, 2 * count)

    def images(self, assembly, vertices):
        table, figures = (on_device(x, mi.Float) for x in (self.table, self.figures))
        return assembly.images(
            table,
            figures,
            vertices,
            self.weight,
            self.mask_weight,
            self.area,
            self.stride,
            self.pairs,
        )


def pinhole(rng, vertices):
    """A camera before the vertices, and the derivatives (N, 2, 3) of their projections by
    differences.
    """
    basis = np.diag([1 / 300, 1 / 310, 1]) + np.array([[0, 0, -0.4], [0, 0, -0.3], [0, 0, 0]])
    inverse = np.linalg.inv(Rotation.from_rotvec(0.2 * rng.normal(size=3)).as_matrix() @ basis)
    origin = vertices.mean(0) - [0.05, -0.02, 0.8]

    def project(points):
        x = (points - origin) @ inverse.T
        return x[:, :2] / x[:, 2:]

    by = np.stack(
        [(project(vertices + d) - project(vertices - d)) / 2e-6 for d in 1e-6 * np.eye(3)], 2
    )
    return SimpleNamespace(inverse=inverse, origin=origin, by_position=by)


def test_all_terms_are_those_of_their_dense_jacobians():
    """Pixels, silhouette, edges and triangles, in the unknowns of a jet patch: with and without
    each, of either order, by one assembly.
    """
    rng = np.random.default_rng(7)
    template = grid_template(capacity=6)
    chart, faces, count = Chart(template), template.faces, len(template.chart)
    turn = Rotation.from_rotvec(rng.normal(size=3) * 0.05)
    state = State(
        rng.normal(size=len(chart.degree)) * 0.05,
        rng.normal(size=(count, 3)) * 0.05,
        turn,
        rng.normal(size=3) * 0.05,
    )
    vertices = chart.surface(state).vertices
    camera, pattern = pinhole(rng, vertices), Pattern(faces, template.edges, count)
    wider, assembly = (
        Pattern(faces, template.edges, count, hinges(template.chart, faces)[0]),
        Assembly(pattern, camera),
    )
    images = np.zeros((2 * count, 3 * count))
    for k in range(count):
        images[2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = camera.by_position[k]
    lengths, stiffness = rng.uniform(0.05, 0.1, len(template.edges)), 3.0
    for order, d, area, silhouette, shaded in (
        (6, 3, 50.0, True, True),
        (4, 2, None, False, False),
        (6, 2, None, True, False),
        (4, 3, 50.0, False, True),
    ):
        sums, size = Sums(template, camera, rng, area, silhouette), chart.size(order)
        in_space, slope, energy = np.zeros((3 * count, 3 * count)), sums.slope.copy(), 0.0

        def add(at, rows):  # rows^T rows, where the rows (R, K, 3) see the vertices at (K,)
            columns = (3 * np.asarray(at)[:, None] + np.arange(3)).ravel()
            rows = rows.reshape(len(rows), -1)
            in_space[np.ix_(columns, columns)] += rows.T @ rows

        for (a, b), length in zip(template.edges, lengths):
            edge = vertices[a] - vertices[b]
            unit, excess = edge / np.linalg.norm(edge), np.linalg.norm(edge) - length
            add((a, b), math.sqrt(2 * stiffness) * np.stack([unit, -unit])[None])
            slope[a] += 2 * stiffness * excess * unit
            slope[b] -= 2 * stiffness * excess * unit
            energy += stiffness * excess**2
        triangles = (
            (
                rng.normal(size=len(faces)),
                rng.uniform(0, 2, len(faces)),
                rng.normal(size=(len(faces), 3, 3)),
            )
            if shaded
            else None
        )
        for face, r, f, by in zip(faces, *triangles) if shaded else ():
            add(face, math.sqrt(f) * by[None])
            slope[face] += f * r * by

        def moved(step):  # the vertices along a step of all unknowns, by differences of the surface
            parts = step[d * count :], step[: d * count].reshape(-1, d)
            return (
                chart.surface(state.moved(parts, 1e-5)).vertices
                - chart.surface(state.moved(parts, -1e-5)).vertices
            ).ravel() / 2e-5

        by = np.stack([moved(row) for row in np.eye(d * count + size + 6)], 1)
        wide = wider if d == 3 else None
        surface = chart.surface(state, order)
        normal, found = assembly.normal(
            surface, sums.images(assembly, vertices), lengths, stiffness, wide, triangles=triangles
        )
        matrix, gradient = dense(wide or pattern, normal)
        expected = by.T @ (in_space + images.T @ sums.second @ images) @ by
        case = f"order {order}, d = {d}, area {area}, silhouette {silhouette}, shading {shaded}"
        assert found == pytest.approx(energy, rel=1e-9), case
        assert np.abs(matrix - expected).max() < 1e-6 * np.abs(expected).max(), case
        assert np.abs(gradient - by.T @ slope.ravel()).max() < 1e-6 * np.abs(gradient).max(), case
    assert (
        assembly._in_unknowns.recorded.n_recordings == 2
    )  # with triangles and without; orders and the relief are numbers


@pytest.mark.parametrize("kind", ["Float", "Float64", "UInt32", "Int32"])
def test_arrays_reach_the_device_as_copies(kind):
    for start in range(5):  # at any place in memory
        values = np.arange(40)[start:].reshape(-1, 1) * 3
        found = on_device(values[:, 0], getattr(mi, kind))
        values[:] = -1
        assert np.array_equal(np.array(found), np.arange(40)[start:] * 3) and isinstance(
            found, getattr(mi, kind)
        )


@pytest.mark.parametrize("where", ["loop", "record"])
@pytest.mark.parametrize("kind", [KeyboardInterrupt, ZeroDivisionError])
def test_ctrl_c_in_the_middle_of_a_loop_or_a_recording(where, kind):
    """Dr.Jit makes a RuntimeError of whatever is raised there."""

    def stop(*_):
        raise kind

    def work():
        if where == "loop":
            dr.while_loop((mi.Float([1.0, 2.0]),), lambda x: x < 3, stop)
        else:
            frozen(stop)(mi.Float([1.0, 2.0]))

    with (
        pytest.raises(KeyboardInterrupt if kind is KeyboardInterrupt else RuntimeError),
        interruptible(),
    ):
        work()
    assert np.array_equal(
        np.array(frozen(lambda x: x + 1)(mi.Float([1.0, 2.0]))), [2, 3]
    )  # what comes after works


def test_ctrl_c_in_the_middle_of_an_evaluation_ends_the_track_as_anywhere(
    problem, tmp_path, monkeypatch
):
    solver, solved, original = solvers.create(problem.settings), [], RasterIntegrator.crossings

    def crossings(self, view, outline=False):
        if len(solved) == 2:
            return dr.while_loop((mi.Float([1.0]),), lambda x: x < 3, stop)
        return original(self, view, outline)

    def stop(x):
        raise KeyboardInterrupt

    monkeypatch.setattr(RasterIntegrator, "crossings", crossings)
    with pytest.raises(KeyboardInterrupt):
        track(
            problem, solver, 3, str(tmp_path), solved=lambda frame, vertices: solved.append(frame)
        )
    assert len(Track.load(str(tmp_path / "checkpoint.npz")).states) == 2


def test_nothing_is_collected_while_a_function_is_recorded():
    state = SimpleNamespace(collecting=None)

    def work(x):
        state.collecting = gc.isenabled()
        return x + 1

    frozen(work)(mi.Float([1.0, 2.0]))
    assert state.collecting is False and gc.isenabled()
