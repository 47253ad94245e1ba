"""From triangles and vertices to the unknowns of an atlas, against dense Jacobians."""

import itertools
import math
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from problems import dense, grid_template, some_state, tube_template
from scipy.spatial.transform import Rotation

from polyfit.device import on_device
from polysft_mi.images import pixels
from polysft_mi.images.gather import Gather
from polysft_mi.objective.quadratic import Assembly, EdgeRows, TriangleForms
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.bending import hinges
from polysft_mi.surface.pattern import Pattern


class Sums:
    """Random sums over triangles and silhouettes, and the quadratic model that they stand for:
    ``second`` (2N, 2N) in the vertices' projections [pixels of the video], ``slope`` (N, 3) in
    space."""

    weight, mask_weight, stride = 0.7, 0.4, 2

    def __init__(self, template, camera, rng, area, silhouette):
        faces, count = template.faces, len(template.vertices)
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

    def images(self, gather, vertices):
        table, figures = (on_device(x, mi.Float) for x in (self.table, self.figures))
        return gather.images(
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


@pytest.mark.parametrize("make", [grid_template, lambda: tube_template(6, 12, order=2)])
def test_all_terms_are_those_of_their_dense_jacobians(make):
    """Pixels, silhouette, edges and triangles, in the unknowns of an atlas of one patch and of
    several: with and without each, by one assembly.
    """
    rng = np.random.default_rng(7)
    template = make()
    chart, faces, count = Atlas(template), template.faces, len(template.vertices)
    state = some_state(chart, rng)
    vertices = chart.surface(state).vertices
    camera, pattern = pinhole(rng, vertices), Pattern(faces, template.edges, count)
    further = hinges(template.vertices / template.scale, faces)[0]
    wider = Pattern(faces, template.edges, count, further)
    gather = Gather(pattern, camera)
    assembly = Assembly(pattern, gather, chart)
    images = np.zeros((2 * count, 3 * count))
    for k in range(count):
        images[2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = camera.by_position[k]
    lengths, stiffness = rng.uniform(0.05, 0.1, len(template.edges)), 3.0
    for d, area, silhouette, shaded in (
        (3, 50.0, True, True),
        (2, None, False, False),
        (2, None, True, False),
        (3, 50.0, False, True),
    ):
        sums = Sums(template, camera, rng, area, silhouette)
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
                chart.surface(state.after_step(parts, 1e-5)).vertices
                - chart.surface(state.after_step(parts, -1e-5)).vertices
            ).ravel() / 2e-5

        by = np.stack(
            [moved(row) for row in np.eye(d * count + template.alpha.size + 6 * len(chart))], 1
        )
        surface, wide = chart.surface(state), wider if d == 3 else pattern
        edges = EdgeRows(lengths, stiffness)
        forms = TriangleForms.of_residuals(*triangles) if shaded else None
        images_of = [(sums.images(gather, vertices), gather.camera)]
        normal, found = assembly.normal(surface, images_of, edges, forms, wide, d)
        matrix, gradient = dense(wide, normal)
        expected = by.T @ (in_space + images.T @ sums.second @ images) @ by
        case = f"d = {d}, area {area}, silhouette {silhouette}, shading {shaded}"
        assert found == pytest.approx(energy, rel=1e-9), case
        assert np.abs(matrix - expected).max() < 1e-6 * np.abs(expected).max(), case
        assert np.abs(gradient - by.T @ slope.ravel()).max() < 1e-6 * np.abs(gradient).max(), case


def test_from_a_strain_on_edges_hardly_pull_harder():
    """Of stretched and of compressed ones, by the formula; the slope by finite differences."""
    template, rng = grid_template(), np.random.default_rng(0)
    chart, faces, count = Atlas(template), template.faces, len(template.vertices)
    camera, pattern = pinhole(rng, template.vertices), Pattern(faces, template.edges, count)
    gather, state = Gather(pattern, camera), some_state(chart, rng)
    assembly = Assembly(pattern, gather, chart)
    images = Sums(template, camera, rng, None, False).images(gather, chart.surface(state).vertices)
    a, b = chart.surface(state).vertices[template.edges.T]
    lengths = np.linalg.norm(a - b, axis=1) / rng.uniform(0.9, 1.1, len(a))

    def at(state, stiffness=3.0):
        edges = EdgeRows(lengths, stiffness, 0.01, 0.03)
        seen = [(images, gather.camera)]
        return assembly.normal(chart.surface(state), seen, edges, None, pattern, 2)

    (normal, found), (without, _) = at(state), at(state, 0.0)
    excess = np.linalg.norm(a - b, axis=1) - lengths
    c = np.where(excess > 0, 0.01, 0.03) * lengths
    each = 2 * c**2 * (np.sqrt(1 + (excess / c) ** 2) - 1)
    assert (excess > 3 * c).any() and (excess < -2 * c).any()
    assert found == pytest.approx(3.0 * each.sum(), rel=1e-9)
    step = rng.normal(size=len(normal.gradient)), rng.normal(size=normal.local_gradient.shape)
    ends = [at(state.after_step(step, h))[1] for h in (1e-6, -1e-6)]
    along = (normal.gradient - without.gradient) @ step[0]
    along += ((normal.local_gradient - without.local_gradient) * step[1]).sum()
    assert along == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)
