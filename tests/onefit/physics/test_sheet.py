import numpy as np
import pytest
import torch

from onefit.physics import MATERIALS, Material, Settings
from onefit.physics.cloth import Cloth
from onefit.physics.material import GRAVITY
from onefit.physics.sheet import Sheet, bending, potential, stretching
from polyfit.errors import InputError

COTTON = MATERIALS["cotton"]


def lattice(columns, rows, side=0.01):
    """Even triangles in the plane z = 0: vertices (N, 3) [m] and faces (F, 3)."""
    j, i = np.mgrid[:rows, :columns]
    x = side * (i + 0.5 * (j % 2))
    V = np.stack([x, side * np.sqrt(0.75) * j, 0.0 * x], -1).reshape(-1, 3)
    F = []
    for r in range(rows - 1):
        for c in range(columns - 1):
            a, b, e, f = (k * columns + m for k in (r, r + 1) for m in (c, c + 1))
            F += [(a, b, e), (b, f, e)] if r % 2 == 0 else [(a, b, f), (a, f, e)]
    return V, np.array(F)


@pytest.fixture(scope="module")
def sheet():
    return Sheet(*lattice(9, 8), COTTON)


def test_a_stretched_strip_bears_the_materials_tension(sheet):
    x = torch.as_tensor(sheet.rest)[:, None].repeat(1, 2, 1)
    x[:, 1, 0] *= 1.02
    area = sheet.area.sum()
    energy = stretching(x, sheet)
    assert energy[0] < 1e-15
    assert float(energy[1]) == pytest.approx(COTTON.stretch / 2 * 0.02**2 * area, rel=1e-6)


def test_of_two_materials_each_part_has_its_own():
    (V, F), denim = lattice(9, 8), MATERIALS["denim"]
    parts = [Sheet(V, F, material) for material in (COTTON, denim)]
    both, faces = np.concatenate([V, V + [9, 0, 0]]), np.concatenate([F, F + len(V)])
    of = np.repeat([0, 1], len(F))
    sheet = Sheet(both, faces, [COTTON, denim], of=of)
    for name in ("mass", "friction", "firmness", "drag", "stretch"):
        alone = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_allclose(getattr(sheet, name), alone, rtol=1e-12, err_msg=name)
    rng = np.random.default_rng(0)
    bent = V * [1.01, 1, 1] + 2e-3 * rng.normal(size=V.shape)
    x = torch.as_tensor(np.concatenate([bent, bent + [9, 0, 0]]))[:, None]
    for energy in (stretching, bending):
        expected = sum(energy(torch.as_tensor(bent)[:, None], part) for part in parts)
        assert float(energy(x, sheet)) == pytest.approx(float(expected), rel=1e-9)
    free = [np.concatenate([_pull(part, bent) for part in parts]), _pull(sheet, x[:, 0].numpy())]
    assert np.abs(free[1] - free[0]).max() < 1e-9 * np.abs(free[0]).max()


def _pull(sheet, x):
    """The gradient of all energies of a cloth at ``x``."""
    return Cloth(sheet, sheet.rest).assemble(x, 1 / 60).copy()


def test_a_cylinder_costs_half_the_bending_stiffness_by_curvature_squared():
    sheet = Sheet(*lattice(40, 40, 0.005), COTTON)
    for turn in (0.0, 0.3, 0.5):
        c, s = np.cos(turn), np.sin(turn)
        u, v = (
            sheet.rest[:, 0] * c + sheet.rest[:, 1] * s,
            sheet.rest[:, 1] * c - sheet.rest[:, 0] * s,
        )
        radius = 0.1
        x = np.stack([radius * np.sin(u / radius), v, radius * np.cos(u / radius)], 1)
        energy = float(bending(torch.as_tensor(x)[:, None], sheet)[0])
        expected = COTTON.bending / 2 / radius**2 * sheet.area.sum()
        assert energy == pytest.approx(expected, rel=0.06)  # hinges at the rim are missing


def test_angles_at_rest_cost_nothing():
    V, F = lattice(6, 5)
    V[:, 2] = 0.3 * V[:, 0] ** 2 + 0.01 * np.sin(300 * V[:, 1])
    sheet = Sheet(V, F, COTTON)
    assert np.abs(sheet.angles).max() > 0.1
    assert float(bending(torch.as_tensor(V)[:, None], sheet)) == pytest.approx(0, abs=1e-20)


def test_gradients_of_the_kernels_are_those_of_the_energies(sheet):
    rng = np.random.default_rng(0)
    x = sheet.rest + 2e-3 * rng.normal(size=sheet.rest.shape)
    at = torch.tensor(x[:, None], requires_grad=True)
    (expected,) = torch.autograd.grad(stretching(at, sheet).sum() + bending(at, sheet).sum(), at)
    cloth = Cloth(sheet, x)
    gradient = cloth.assemble(x, 1 / 60)
    assert np.abs(gradient - expected[:, 0].numpy()).max() < 1e-10 * expected.abs().max()


@pytest.mark.parametrize("energy", [stretching, bending, potential])
def test_energies_against_finite_differences(sheet, energy):
    rng = np.random.default_rng(1)
    x = torch.tensor(sheet.rest + 1e-3 * rng.normal(size=sheet.rest.shape))[:, None]
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(energy(x, sheet).sum(), x)
    step = 1e-6 * torch.tensor(rng.normal(size=x.shape))
    with torch.no_grad():
        difference = float(energy(x + step, sheet) - energy(x - step, sheet))
    assert difference == pytest.approx(2 * float((gradient * step).sum()), rel=1e-5)


def test_the_matrix_is_the_gradients_derivative_where_cloth_is_taut(sheet):
    # what is left out is negative, or a product of a hinge's turn: none of it here
    cloth = Cloth(sheet, sheet.rest)
    rng = np.random.default_rng(2)
    taut = sheet.rest * 1.05
    step = rng.normal(size=taut.shape) * [1, 1, 0]
    size = 1e-6
    after = cloth.assemble(taut + size * step, 1 / 60)
    after = after.copy()
    before = cloth.assemble(taut - size * step, 1 / 60)
    expected = (after - before) / (2 * size)
    cloth.assemble(taut, 1 / 60)
    found = cloth.product(step) - sheet.mass[:, None] * 60**2 * step
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


def test_free_fall_keeps_momentum_and_shape(sheet):
    cloth = Cloth(
        Sheet(sheet.rest, sheet.faces, Material("m", 600.0, 1e-5, 0.15, 0.4, 4e-4, 0.0)), sheet.rest
    )
    cloth.v[:] = [1.0, 0.5, 2.0]
    for _ in range(10):
        cloth.step(1 / 60)
    mass = cloth.sheet.mass
    momentum = (mass[:, None] * cloth.v).sum(0) / mass.sum()
    assert momentum == pytest.approx([1.0, 0.5, 2.0 - GRAVITY * 10 / 60], rel=1e-6)
    apart = cloth.x - cloth.x.mean(0) - (sheet.rest - sheet.rest.mean(0))
    assert np.abs(apart).max() < 1e-9


def test_hanging_cloth_strains_as_its_weight_says():
    # a strip hung at its top row: the mean strain along it is g density length / (2 stretch)
    sheet = Sheet(*lattice(6, 60), COTTON)
    V = sheet.rest[:, [0, 2, 1]]
    hung = np.where(V[:, 2] > V[:, 2].max() - 1e-6, 1e4, 0.0)
    settings = Settings(iterations=300, tolerance=1e-6)
    cloth = Cloth(Sheet(V, sheet.faces, COTTON), V, settings)
    for _ in range(60):
        cloth.step(1 / 30, target=V, pull=hung)
        cloth.v *= 0.9
    length = np.ptp(V[:, 2])
    strain = np.ptp(cloth.x[:, 2]) / length - 1
    assert strain == pytest.approx(
        GRAVITY * COTTON.density * length / (2 * COTTON.stretch), rel=0.1
    )


@pytest.mark.parametrize("field", ["stretch", "density", "friction"])
def test_no_cloth_has_a_negative_number(field):
    with pytest.raises(InputError, match=f"material: {field} = -1"):
        Material(**(vars(COTTON) | {field: -1.0}))
