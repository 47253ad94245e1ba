"""The objective by the material's energies, of a garment in patches."""

import pytest
import torch
from charted import T, assert_gradient, deformation, scene, scene_and_past

from onefit.garment.charts import Deformation
from onefit.objective import losses, material
from onefit.physics import MATERIALS, sheet


@pytest.fixture(scope="module")
def cloth(garment):
    rest, faces = garment.vertices.double().numpy(), garment.faces.numpy()
    return sheet.Sheet(rest, faces, MATERIALS["cotton"])


def whole(cloth):
    return [(cloth, torch.arange(T))]


def test_terms_are_the_energies_of_the_sheet(patched, body, cloth):
    s = scene(body, patched)
    weights = losses.Weights(k_c=0.0, k_m=2.0)
    terms, x = material.evaluate(patched, deformation(patched, 0.2), s, whole(cloth), weights)
    assert set(terms) == {"stretching", "bending", "gravity"}
    for name in ("stretching", "bending"):
        energy = getattr(sheet, name)(x.double(), cloth).mean()
        assert float(terms[name]) == pytest.approx(2 * float(energy), rel=1e-3)
    lifted = [t.clone() for t in (s.transforms, s.body)]
    lifted[0][..., 2, 3] += 1.0
    lifted[1][..., 2] += 1.0
    high = type(s)(*lifted, s.collider, s.rest, s.field)
    again, _ = material.evaluate(patched, deformation(patched, 0.2), high, whole(cloth), weights)
    assert float(again["gravity"]) == pytest.approx(float(terms["gravity"]), rel=1e-3)


def test_each_body_has_its_own_sheet(patched, body, cloth, garment):
    s, d = scene(body, patched), deformation(patched, 0.2)
    larger = sheet.Sheet(1.02 * cloth.rest, cloth.faces, MATERIALS["cotton"])
    both = [(larger, torch.tensor([1])), (cloth, torch.tensor([k for k in range(T) if k != 1]))]
    weights = losses.Weights(k_c=0.0)
    terms, x = material.evaluate(patched, d, s, both, weights)
    expected = [sheet.stretching(x[:, [k]].double(), larger if k == 1 else cloth) for k in range(T)]
    assert float(terms["stretching"]) == pytest.approx(float(sum(expected)) / T, rel=1e-3)


@pytest.mark.parametrize("name", ["collision", "stretching", "bending", "gravity", "inertia"])
def test_gradient_of_each_term(patched, body, cloth, name):
    s, d, past = scene_and_past(body, patched, name)

    def value(*parts):
        generator = torch.Generator().manual_seed(5)
        terms, _ = material.evaluate(
            patched, Deformation(*parts), s, whole(cloth), losses.Weights(),
            past=past, generator=generator,
        )  # fmt: skip
        return terms[name]

    assert_gradient(value, d, name)
