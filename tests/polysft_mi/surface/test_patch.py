"""The deforming patch: Dr.Jit against plain NumPy and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polyfit import jets
from polysft_mi.surface.patch import JetAtlas, Unknowns
from polysft_mi.surface.template import Template

RNG = np.random.default_rng(7)


@pytest.fixture
def patch():
    """A bent sheet as a patch, and unknowns away from rest."""
    y, x = np.meshgrid(np.linspace(-0.1, 0.1, 7), np.linspace(-0.15, 0.15, 9), indexing="ij")
    vertices = np.stack([x, y, 0.6 + 1.5 * x**2 + x * y], -1).reshape(-1, 3)
    i = np.arange(63).reshape(7, 9)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    template = Template.fit(vertices, faces, vertices[:, :2], 4)
    arrays = {
        "delta_alpha": 0.1 * RNG.normal(size=(1, 15)),
        "delta_u": 0.02 * RNG.normal(size=63),
        "delta_v": 0.02 * RNG.normal(size=63),
        "delta_w": 0.02 * RNG.normal(size=63),
        "rotation": np.array([0.1, -0.2, 0.3, 0.9]),
        "translation": 0.1 * RNG.normal(size=3),
    }
    return JetAtlas(template), Unknowns.from_numpy(arrays), arrays


def test_patch_against_plain_numpy(patch):
    patch, unknowns, x = patch
    t = patch.template
    uv = t.chart[:, 0] + np.stack([x["delta_u"], x["delta_v"]], 1)
    alpha = (t.alpha + x["delta_alpha"])[0]
    canonical = jets.point(alpha, uv)
    canonical[:, 2] += t.rest[:, 0] + x["delta_w"]
    R = Rotation.from_quat(x["rotation"]).as_matrix()
    out = t.rotation[0]
    expected = t.scale * (canonical @ R.T + x["translation"]) @ out.T + t.origin
    assert np.abs(np.array(patch.vertices(unknowns)).T - expected).max() < 1e-6
    normal = jets.normal(alpha, uv) @ R.T @ out.T
    assert np.abs(np.array(patch.normals(unknowns)).T - normal).max() < 1e-5
    g = t.scale**2 * jets.metric(alpha, uv)
    for value, expected in zip(patch.metric(unknowns), (g[:, 0, 0], g[:, 0, 1], g[:, 1, 1])):
        assert np.abs(np.array(value) - expected).max() < 1e-5 * g.max()


def test_patch_tangents_against_finite_differences(patch):
    patch, unknowns, x = patch
    tangents = [np.array(t).T for t in patch.tangents(unknowns)]
    h = 1e-2
    for k, name in enumerate(("delta_u", "delta_v")):
        ends = []
        for sign in (1, -1):
            moved = dict(x)
            moved[name] = x[name] + sign * h
            ends.append(np.array(patch.vertices(type(unknowns).from_numpy(moved))).T)
        assert (
            np.abs((ends[0] - ends[1]) / (2 * h) - tangents[k]).max()
            < 1e-3 * np.abs(tangents[k]).max()
        )
