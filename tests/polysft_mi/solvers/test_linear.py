"""The algebra of a step, against dense matrices."""

import numpy as np
import pytest
from problems import dense, grid_template
from scipy.linalg import LinAlgError

from polysft_mi.objective.quadratic import NormalEquations
from polysft_mi.solvers.linear import Blocks, Reduced, tridiagonal
from polysft_mi.surface.bending import hinges
from polysft_mi.surface.pattern import Pattern

RNG = np.random.default_rng(4)


def random_normal(pattern, size=9, d=2):
    """Positive normal equations of the pattern: J^T J of residuals that each see one triangle and
    the global unknowns.
    """
    n, blocks = d * pattern.count, np.zeros((len(pattern.row), d, d))
    cross, glob = np.zeros((n, size)), np.eye(size) * 0.1
    for a, b in np.stack([pattern.row, pattern.column], 1)[pattern.row < pattern.column]:
        for _ in range(d + 1):
            ja, jb, g = RNG.normal(size=d), RNG.normal(size=d), RNG.normal(size=size)
            for i, j, x in (
                (a, a, np.outer(ja, ja)),
                (b, b, np.outer(jb, jb)),
                (a, b, np.outer(ja, jb)),
                (b, a, np.outer(jb, ja)),
            ):
                blocks[pattern.find(i, j)] += x
            cross[d * a : d * a + d] += np.outer(ja, g)
            cross[d * b : d * b + d] += np.outer(jb, g)
            glob += np.outer(g, g)
    return NormalEquations(
        blocks, cross, glob, RNG.normal(size=(pattern.count, d)), RNG.normal(size=size)
    )


@pytest.mark.parametrize("alone", [0, 1000])  # rows a block below which one thread does it all
@pytest.mark.parametrize(
    "rows, columns, d", [(2, 2, 2), (3, 9, 2), (8, 7, 2), (2, 2, 3), (8, 7, 3)]
)
def test_step_and_variance_are_those_of_the_dense_system(monkeypatch, rows, columns, d, alone):
    monkeypatch.setattr(tridiagonal, "_WORTH_A_THREAD", alone)
    template = grid_template(rows, columns, order=1)
    further = hinges(template.vertices, template.faces)[0] if d == 3 else None
    pattern = Pattern(template.faces, template.edges, rows * columns, further)
    normal = random_normal(pattern, d=d)
    h, g = dense(pattern, normal)
    n, damping = d * pattern.count, 1e-3
    h += np.diag(np.diag(h)) * damping
    reduced = Reduced(Blocks(pattern, d), normal, damping)
    (glob, uv), decrease = reduced.step()
    expected = -np.linalg.solve(h, g)
    assert np.allclose(np.concatenate([uv.ravel(), glob]), expected, rtol=1e-5, atol=1e-7)
    assert decrease == pytest.approx(-0.5 * expected @ g, rel=1e-5)
    (glob, uv), decrease = Reduced(Blocks(pattern, d), normal, damping, np.float32).step()
    assert uv.dtype == np.float32 and np.allclose(
        np.concatenate([uv.ravel(), glob]), expected, atol=2e-4 * np.abs(expected).max()
    )
    assert decrease == pytest.approx(-0.5 * expected @ g, rel=1e-4)
    by_local, by_global = RNG.normal(size=(pattern.count, d)), RNG.normal(size=(pattern.count, 9))
    j = np.zeros((pattern.count, len(h)))
    j[:, n:] = by_global
    for k in range(pattern.count):
        j[k, d * k : d * k + d] = by_local[k]
    assert np.allclose(
        reduced.variance(by_local, by_global),
        np.einsum("ij,ji->i", j, np.linalg.solve(h, j.T)),
        rtol=1e-5,
    )
    assert np.allclose(
        reduced.slide().ravel(), -np.linalg.solve(h[:n, :n], g[:n]), rtol=1e-5, atol=1e-7
    )


@pytest.mark.parametrize("vertex", [0, 30, 55])  # in either half, and in the middle
def test_a_block_that_is_not_positive_is_refused_in_either_thread(monkeypatch, vertex):
    monkeypatch.setattr(tridiagonal, "_WORTH_A_THREAD", 0)
    template = grid_template(8, 7, order=1)
    pattern = Pattern(template.faces, template.edges, 56)
    normal = random_normal(pattern)
    normal.local[pattern.diagonal[pattern.order[vertex]]] -= 1e3 * np.eye(2)
    blocks = Blocks(pattern)
    assert len({blocks.middle, *(k for chain in blocks.chains for k in chain[:1])}) == 3
    with pytest.raises(LinAlgError, match="not positive definite"):
        Reduced(blocks, normal, 0)


def test_bends_are_bounded_within_the_pattern():
    """Hinges reach beyond the neighbours; the blocks that stand for them are those of the matrix
    where the pattern has any, and bound it from above.
    """
    template = grid_template(6, 7)
    pattern = Pattern(template.faces, template.edges, 42)
    bends = hinges(template.vertices / template.scale, template.faces)[1]
    matrix = bends.T @ bends
    bound = np.zeros((42, 42))
    bound[pattern.row, pattern.column] = pattern.bound_of(matrix)
    beside = pattern.row != pattern.column
    inside = pattern.row[beside], pattern.column[beside]
    np.testing.assert_allclose(bound[inside], matrix.toarray()[inside], atol=1e-12)
    least, most = np.linalg.eigvalsh(bound - matrix.toarray())[[0, -1]]
    assert -1e-9 * most < least and most > 0


def test_pairs_that_lie_across_two_edges_are_one_block():
    """Around a vertex of four triangles, two hinges join the same pair: its block must neither be
    lost nor counted twice.
    """
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    edges = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [1, 4]])
    across, bends = hinges(x, faces)
    assert len(across) == 4 and len(np.unique(np.sort(across, 1), axis=0)) == 2
    pattern = Pattern(faces, edges, 5, across)
    blocks = Blocks(pattern, 3)
    values = pattern.laplacian + pattern.blocks_of(bends.T @ bends)
    local = values[:, None, None] * np.eye(3)
    local[pattern.diagonal] += np.eye(3)
    difference = np.zeros((8, 5))
    difference[np.arange(8)[:, None], edges] = [1.0, -1.0]
    dense = np.kron(difference.T @ difference + (bends.T @ bends).toarray() + np.eye(5), np.eye(3))
    right = RNG.normal(size=(15, 2))
    found = blocks.eliminate(local, right, np.float64)
    np.testing.assert_allclose(found.back(found.columns), np.linalg.solve(dense, right), atol=1e-10)


def test_a_disconnected_and_irregular_mesh_is_factorised():
    faces = np.array(
        [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 6, 7], [8, 9, 10], [9, 10, 0]]
    )
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )
    pattern = Pattern(faces, edges, 11)
    normal = random_normal(pattern, 6 + 3)
    h, g = dense(pattern, normal)
    (glob, uv), _ = Reduced(Blocks(pattern), normal, 0).step()
    assert np.allclose(
        np.concatenate([uv.ravel(), glob]), -np.linalg.solve(h, g), rtol=1e-4, atol=1e-6
    )
