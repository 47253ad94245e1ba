"""benchmarks/onefit_swing.py: what networks are held against."""

import pytest
import torch
from scripts import load

import onefit
from onefit.body import ClosestSurface
from onefit.garment import Garment
from onefit.objective import measures

swing = load("benchmarks/onefit_swing.py")


def test_what_is_compared():
    g = torch.Generator().manual_seed(0)
    T, N = 25, 7
    turned = torch.linalg.qr(torch.randn(T, 3, 3, generator=g)).Q
    skinned = torch.randn(T, N, 3, generator=g)
    phase = torch.arange(T - 5) * (2 * torch.pi / (T - 5))
    local = torch.zeros(T, N, 3)
    local[:, :, 0], local[5:, :, 2] = 0.03, 0.01 * phase.sin()[:, None]
    reference = skinned + torch.einsum(
        "tij,tnj->tni", turned, local
    )  # hangs by 3 cm and swings by 1 cm, as seen from the root
    lowest = torch.arange(N) < 4
    half = skinned + (reference - skinned) / 2
    hang, rms, of_it = swing.compared(reference, skinned, reference, turned, lowest)
    assert (float(hang), float(rms), float(of_it)) == pytest.approx((30, 10 / 2**0.5, 1), rel=1e-4)
    assert [
        float(x) for x in swing.compared(half, skinned, reference, turned, lowest)
    ] == pytest.approx([15, 5 / 2**0.5, 0.75], rel=1e-4)
    assert float(swing.compared(skinned, skinned, reference, turned, lowest)[2]) == pytest.approx(
        0, abs=1e-5
    )
    reference[:, 4:] += 1  # the rest of the garment is not looked at
    assert float(swing.compared(half, skinned, reference, turned, lowest)[2]) == pytest.approx(
        0.75, rel=1e-4
    )


def test_what_has_slipped():
    shorts = Garment.template("shorts")
    skinned = torch.zeros(7, len(shorts), 3)
    moved = skinned.clone()
    moved[
        5:, shorts.vertices[:, 2] > shorts.vertices[:, 2].max() - 1e-3, 2
    ] = -0.02  # the waist is level
    moved[:5] = 1.0
    assert float(swing.slipped(moved, skinned, shorts)) == pytest.approx(20)


def test_the_least_is_less_than_skinning_and_keeps_out_of_the_body(monkeypatch):
    monkeypatch.setattr(swing, "STEPS", 5)
    draper, garment = onefit.load(), Garment.template("dress")
    motion = onefit.Motion.generate("dance", seconds=0.2, seed=1)
    told = []
    least = swing.least(draper, garment, motion, lambda: told.append(1))
    skinned = draper.drape(garment, motion, skinning_only=True)
    assert len(told) == len(least) == len(motion.poses)
    collider = ClosestSurface(skinned.body[0], skinned.body_faces)
    found = [
        measures.measure(
            v, garment.faces, garment.vertices, skinned.body, collider, skinned.root, 30.0
        )
        for v in (least, skinned.vertices)
    ]
    assert found[0].energy < found[1].energy - 0.01 and found[0].collision < 0.5
