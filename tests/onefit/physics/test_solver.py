import numpy as np
import pytest
from test_sheet import COTTON, lattice

from onefit.contact import Contacts
from onefit.physics.cloth import Cloth
from onefit.physics.settings import Settings
from onefit.physics.sheet import Sheet

COLUMNS, ROWS = 12, 40


def system(patches, seed=0):
    """Of a stretched strip that is tied to itself in 30 places, cut into ``patches`` (N,): the
    solver, the dense matrix and a right-hand side.
    """
    rng = np.random.default_rng(seed)
    sheet = Sheet(*lattice(COLUMNS, ROWS), COTTON)
    N = len(sheet)
    corners = np.stack([rng.choice(N, 4, replace=False) for _ in range(30)])
    weights = np.tile([1.0, -0.2, -0.3, -0.5], (30, 1))
    normal = rng.normal(size=(30, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tied = Contacts(
        np.arange(30),
        corners,
        weights,
        normal,
        np.full(30, 1.0),
        np.zeros((30, 3)),
        np.full(30, 200.0),
    )
    cloth = Cloth(sheet, sheet.rest, Settings(), 30, patches)
    x = sheet.rest * 1.01 + 2e-4 * rng.normal(size=(N, 3))
    cloth.assemble(x, 1 / 60, cloth.touches([tied], 1 / 60))
    unit = np.eye(3 * N).reshape(3 * N, N, 3)
    dense = np.stack([cloth.product(column).ravel() for column in unit], 1)
    return cloth._solver, dense, rng.normal(size=(N, 3))


def blocks(size):
    """Patches (N,) of the strip's lattice, so many vertices wide and long, in no order."""
    row, column = np.mgrid[:ROWS, :COLUMNS] // size
    label = row * (COLUMNS // size + 1) + column
    return np.random.default_rng(3).permutation(label.max() + 1)[label].ravel()


@pytest.mark.parametrize("size", [None, 4, 7, 1], ids=["one patch", "4", "7", "a vertex a patch"])
def test_the_solution_is_that_of_a_dense_system(size):
    solver, dense, b = system(None if size is None else blocks(size))
    assert np.abs(dense - dense.T).max() < 1e-10 * np.abs(dense).max()
    start = np.random.default_rng(1).normal(size=b.shape)
    expected = np.linalg.solve(dense, b.ravel()).reshape(b.shape)
    found, _ = solver.solve(b, start, 2000, 1e-12)
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


def test_where_each_vertex_is_a_patch_nothing_is_left_to_iterate():
    solver, dense, b = system(blocks(1))
    found, iterations = solver.solve(b, 0 * b, 100, 1e-10)
    expected = np.linalg.solve(dense, b.ravel()).reshape(b.shape)
    assert iterations == 0 and np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


def test_patches_carry_a_pull_through_the_strip():
    # a force at one end: after ten iterations the error, in energy, is a tenth of that without
    errors = []
    for size in (None, 4):
        solver, dense, b = system(None if size is None else blocks(size))
        b = 0 * b
        b[:COLUMNS] = [0, -1, 0]
        error = solver.solve(b, 0 * b, 10, 0.0)[0].ravel() - np.linalg.solve(dense, b.ravel())
        errors.append(error @ dense @ error)
    assert errors[1] < errors[0] / 10
