from dataclasses import replace

import numpy as np
import pytest
import torch

from onefit import train, training
from onefit.garment import Garment, standard_surface
from onefit.garment.sewing import cuts, patterns
from polyfit import mesh
from polyfit.errors import InputError
from polyfit.mesh import loops

NAMES = list(cuts.CUTS)


@pytest.fixture(scope="module")
def sewn(block):
    """Two cuts of shorts, and one of a skirt."""
    shorts, skirt = NAMES.index("shorts"), NAMES.index("skirt")
    return {n: cuts.cut(block, n) for n in (shorts, skirt, shorts + len(NAMES))}


def test_a_cut_is_the_pattern_where_its_measures_are(block):
    field, inside = patterns.shorts(block)
    shorter = patterns.shorts(block, hem=-0.2, ease=0.007)
    assert np.abs(field - shorter[0] - 0.002).max() < 1e-6  # 2 mm looser everywhere
    p = [np.array([0.1]), np.array([0.0]), np.array([-0.25])]
    assert inside(*p) > 0 > shorter[1](*p)
    snug = patterns.shorts(block, snug=1)[0]
    near = (np.abs(field) < 0.02) & (block.z > -0.27) & (block.z < 0.1)
    assert (snug - field)[near].min() > 0 and (snug - field)[
        near
    ].max() > 0.01  # hollows are no longer spanned
    long = patterns.dress(block, hem=-0.5, top=0.1)[1]
    assert long(p[0], p[1], np.array([0.2])) < 0 < long(p[0], p[1], np.array([-0.45]))


def test_cuts_are_clean_and_off_the_body(sewn):
    for n, (name, V, F) in sewn.items():
        assert name == NAMES[n % len(NAMES)]
        edges, side = mesh.edges_of(F)
        assert np.bincount(side.ravel()).max() == 2  # manifold
        assert np.linalg.norm(V[edges[:, 0]] - V[edges[:, 1]], axis=1).min() > cuts.SHORTEST_EDGE
        assert len(loops(F)) == cuts.CUTS[name][1] and np.isfinite(V).all()
        assert len(np.unique(F)) == len(V) >= 0.8 * cuts.VERTEX_COUNTS[0]
        assert standard_surface()(V).distance.min() > 0


def test_cuts_differ_and_are_the_same_each_time(block, sewn):
    n = NAMES.index("shorts")
    (_, V, F), (_, W, G) = sewn[n], sewn[n + len(NAMES)]
    assert abs(V[:, 2].min() - W[:, 2].min()) > 0.01 or abs(V[:, 2].max() - W[:, 2].max()) > 0.01
    assert abs(mesh.areas(V, F).sum() / mesh.areas(W, G).sum() - 1) > 0.005
    again = cuts.cut(block, n)
    assert np.array_equal(again[1], sewn[n][1]) and np.array_equal(again[2], sewn[n][2])
    rngs = [np.random.default_rng(seed) for seed in (0, 0, 1)]
    a, b, c = (cuts.drawn("dress", rng) for rng in rngs)
    assert (
        a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a) and a["hem"] != c["hem"]
    )


def test_measures_are_within_their_ranges():
    rng = np.random.default_rng(0)
    for name, (_, _, ranges) in cuts.CUTS.items():
        many = [cuts.drawn(name, rng) for _ in range(200)]
        for key, ends in ranges.items():
            low, high = sorted(ends)
            values = [m[key][0] if isinstance(m[key], tuple) else m[key] for m in many]
            assert (
                low <= min(values) < low + 0.1 * (high - low)
                and high - 0.1 * (high - low) < max(values) <= high
            )
        ease = np.array([m["ease"] for m in many])
        assert (
            cuts.EASE[0] <= ease.min()
            and ease.max() <= cuts.EASE[1]
            and 0.3 < (ease < 0.0045).mean() < 0.7
        )


def test_wrinkles_are_as_high_as_they_say(block):
    heights = [
        np.abs(cuts.wrinkles(block, np.random.default_rng(seed))).max() for seed in range(20)
    ]
    assert max(heights) <= 2 * cuts.WRINKLE_HEIGHT and 4 < sum(h > 0 for h in heights) < 16


def test_what_was_sewn_is_read_again_and_trained_on(block, sewn, tmp_path, monkeypatch):
    n, told = min(sewn), []
    folder = tmp_path / "out" / "cuts"
    monkeypatch.setattr(cuts, "Block", lambda *_: block)
    monkeypatch.setattr(cuts, "cut", lambda b, number, seed: sewn[n])
    first = cuts.cuts(1, folder, advance=lambda: told.append(1))
    assert told == [1] and isinstance(first[0], Garment) and first[0].name == "shorts, cut 0"

    def refuse(*_):
        raise AssertionError("sewn again")

    monkeypatch.setattr(cuts, "cut", refuse)
    again = cuts.cuts(1, folder)
    assert torch.equal(first[0].vertices, again[0].vertices) and torch.equal(
        first[0].faces, again[0].faces
    )
    settings = training.Settings(
        garments=("tank",), batch=300, epochs=1, epoch_steps=2, shapes=1, seeds=1, cuts=1
    )
    assert training.train(settings, tmp_path / "out").exists()


def test_a_negative_number_of_cuts_is_refused(tmp_path):
    with pytest.raises(InputError, match="cuts = -1; at least 0 is needed"):
        replace(training.Settings(), cuts=-1)
    with pytest.raises(InputError, match="cuts = -1; at least 0 is needed"):
        train.main(["--cuts", "-1", "-o", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
