"""Several garments at once: each stays over those before it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import onefit
from onefit import drape, simulate
from onefit.draping.outfit import Under, joined, let_out
from onefit.garment import Garment
from onefit.objective import crossings, depths_beneath
from onefit.physics import MATERIALS, Settings
from polyfit.errors import InputError


@pytest.fixture(scope="module")
def draper():
    return onefit.load()


@pytest.fixture(scope="module")
def shorts():
    return Garment.template("shorts").remeshed(500)


@pytest.fixture(scope="module")
def worn():
    """Trousers, and a T-shirt that lies partly beneath them when both drape for themselves."""
    return [Garment.template(name).remeshed(800) for name in ("trousers", "tshirt")]


MOTION = onefit.Motion.generate("dance", seconds=0.3, seed=1_000_003)


def beneath(inner, outer):
    """The share of the vertices of a drape that lie beneath another."""
    return (depths_beneath(outer.vertices, inner.vertices, inner.faces) > 0).mean()


def passed(drapes):
    """Pairs of faces of two garments, or of one, that pass through each other at the end."""
    first = np.cumsum([0, *(d.vertices.shape[1] for d in drapes)])
    faces = np.concatenate([d.faces.numpy() + n for d, n in zip(drapes, first)])
    return crossings(np.concatenate([d.vertices[-1].numpy() for d in drapes]), faces)


def test_outer_garments_stay_over_inner_ones_in_drapes(draper, worn):
    apart = [draper.drape(one, MOTION, eased=False) for one in worn]
    made = draper.drape(worn, MOTION, eased=False)
    assert beneath(*apart) > 0.02 and beneath(*made) < 0.005
    assert torch.equal(made[0].vertices, apart[0].vertices)  # the inner one does not know
    assert all(one.measures().collision < 0.3 for one in made)
    assert passed(made) < 0.2 * passed(apart)


def test_outer_garments_stay_over_inner_ones_in_simulations(draper, worn):
    how = dict(settings=Settings(settling=0.1, lead=0.3))
    made = draper.simulate(worn, MOTION, **how)
    # rounding has a say in a vertex of 800; without contact it is every tenth
    assert beneath(*made) < 0.005 and passed(made) < 0.005 * sum(len(d.faces) for d in made)
    assert [len(one.rest) for one in made] == [len(one) for one in worn]
    alone = draper.simulate(worn[0], MOTION, **how)
    felt = (made[0].vertices - alone.vertices).norm(dim=-1)
    assert felt.max() > 1e-3  # both ways


@pytest.mark.parametrize("verb", ["drape", "simulate"])
def test_a_list_of_one_is_that_one(draper, shorts, verb):
    how = dict(eased=False) if verb == "drape" else dict(settings=Settings(settling=0, lead=0))
    short = onefit.Motion.generate("walk", seconds=0.1)
    one, [same] = (getattr(draper, verb)(what, short, **how) for what in (shorts, [shorts]))
    assert torch.equal(one.vertices, same.vertices) and torch.equal(one.rest, same.rest)


def test_a_garment_goes_over_itself(shorts):
    rests = let_out([shorts] * 2, [shorts.vertices] * 2)
    sheet = joined([shorts] * 2, rests)
    assert torch.equal(rests[0], shorts.vertices)
    both = torch.cat(rests).numpy()
    assert crossings(both, sheet["faces"].numpy()) == 0
    gap = Under(rests[0].numpy(), shorts.faces.numpy()).surface(rests[1].numpy()).distance
    assert gap.min() > 0.002 and gap.max() < 0.02
    apart = sheet["cut"][: len(shorts)] - sheet["cut"][len(shorts) :]
    assert np.linalg.norm(apart, axis=1).min() > 1  # no neighbours where they are cut


def test_what_is_worn_under_is_closed_beyond_its_rims():
    """A tube along z: beyond its rim a place is inside below a slope of 45 degrees."""
    turn, high = np.meshgrid(np.arange(40) * np.pi / 20, np.linspace(0, 0.4, 15))
    tube = np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), high], -1).reshape(-1, 3)
    at = np.arange(len(tube)).reshape(high.shape)
    a, b, c, d = at[:-1], np.roll(at, -1, 1)[:-1], np.roll(at, -1, 1)[1:], at[1:]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((a, b, c), (a, c, d))])
    under = Under(tube, faces)
    places = np.array([[0.105, 0, 0.2], [0.09, 0, 0.2], [0.095, 0, 0.42], [0.07, 0, 0.42]])
    assert (np.sign(under.surface(places).distance) == [1, -1, 1, -1]).all()
    moved = under.follow(tube + [0, 0, 1])
    assert (np.sign(moved(places + [0, 0, 1]).distance) == [1, -1, 1, -1]).all()


def test_folds_that_are_let_out_do_not_pass_through_each_other(draper):
    garments = [Garment.template(name) for name in ("shorts", "circle_skirt")]
    rests = [garment.graded(draper.standard) for garment in garments]
    _, skirt = let_out(garments, rests)
    assert (skirt - rests[1]).norm(dim=-1).max() > 0.004
    assert crossings(skirt.numpy(), garments[1].faces.numpy()) == 0


def test_each_garment_has_its_material(draper, shorts):
    tank, motion = Garment.template("tank").remeshed(500), MOTION[:4]
    elastic = replace(MATERIALS["denim"], name="elastic", stretch=30.0)  # as heavy, much softer
    stiff, soft = (
        draper.simulate([shorts, tank], motion, material=[of, "silk"]) for of in ("denim", elastic)
    )
    assert [d.material.name for d in stiff] == ["denim", "silk"]
    lengths = lambda d, x: (x[..., d.faces.roll(1, 1), :] - x[..., d.faces, :]).norm(dim=-1)
    strain = lambda d: (lengths(d, d.vertices) / lengths(d, d.rest) - 1).mean()
    assert strain(soft[0]) > 1.5 * strain(stiff[0]) and strain(soft[1]) < strain(stiff[0])
    # meshes this coarse pass through each other in a fold or none
    assert beneath(*stiff) < 0.005 and passed(stiff) < 0.005 * sum(len(d.faces) for d in stiff)
    with pytest.raises(InputError, match="^1 materials for 2 garments; give one for each"):
        draper.simulate([shorts, tank], motion, material=["denim"])


def test_refused_in_one_line(draper, shorts):
    with pytest.raises(InputError, match="^0 garments; 1 to 4 at once$"):
        draper.drape([], MOTION)
    with pytest.raises(InputError, match="^5 garments; 1 to 4 at once$"):
        draper.simulate([shorts] * 5, MOTION)
    with pytest.raises(InputError, match="^post=False: of several garments"):
        draper.drape([shorts] * 2, MOTION, post=False)
    dress = Garment.template("dress").remeshed(800)
    with pytest.raises(InputError, match="shorts does not go over dress: .* in which they are put"):
        draper.drape([dress, shorts], MOTION)


@pytest.mark.parametrize(
    "order", ["shirt tshirt", "shirt tank", "boxy_tshirt tank", "waisted_dress tank"]
)
def test_a_wrong_order_is_refused(order):
    names = order.split()
    garments = [Garment.template(name) for name in names]
    rests = [garment.vertices for garment in garments]
    with pytest.raises(
        InputError, match=f"^{names[1]} does not go over {names[0]}: .* pass through"
    ):
        let_out(garments, rests)
    let_out(garments[::-1], rests[::-1])


@pytest.mark.parametrize("command", [drape, simulate])
def test_a_wrong_order_is_refused_before_the_long_work(command, tmp_path, monkeypatch):
    monkeypatch.setattr(onefit.Draper, "ease", None)  # which tries a garment on, for seconds
    monkeypatch.setattr("onefit.draping.outfit.untangled", None)  # which smooths it, for seconds
    words = ["dress", "trousers", "walk", "--skip", "usd", "render", "-o", str(tmp_path / "out")]
    with pytest.raises(InputError, match="^trousers does not go over dress: 11 % of it stays in"):
        command.main(words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "order", ["trousers tshirt", "tank tshirt shirt", "trousers dress", "trousers waisted_dress"]
)
def test_a_right_order_is_not_refused(order):
    garments = [Garment.template(name) for name in order.split()]
    let_out(garments, [garment.vertices for garment in garments])


def test_an_outfit_is_let_out_once_for_all_its_motions(draper, shorts, monkeypatch):
    told, outfit = [], [shorts, Garment.template("tank").remeshed(300)]
    monkeypatch.setattr(
        "onefit.draping.outfit.let_out", lambda *given: (told.append(1), let_out(*given))[1]
    )
    shapes = [None, None, draper.model.random_shape(np.random.default_rng(0))]
    [first, again, other] = [draper.drape(outfit, MOTION[:2], shape)[1] for shape in shapes]
    assert len(told) == 2
    assert torch.equal(first.vertices, again.vertices) and not torch.equal(first.rest, other.rest)


@pytest.mark.parametrize("flag", ["--no-post", "--preset=paper"])
def test_the_network_alone_takes_one_garment(flag, tmp_path):
    with pytest.raises(
        InputError, match="^--no-post, --preset paper: for one garment; .*: --post$"
    ):
        drape.main(["shorts", "tank", "walk", flag, "-o", str(tmp_path / "out")])


def test_the_command_takes_several_garments(tmp_path, capsys):
    words = ["shorts", "tank", "walk", "--seconds", "0.1", "--vertices", "300"]
    words += ["--skip", "usd", "render", "-o", str(tmp_path / "out")]
    drape.main(words)
    names = {"1_shorts", "2_tank"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == names | {"figures.json"}
    sizes = {}
    for name in names:
        with np.load(tmp_path / "out" / name / "drape.npz") as file:
            sizes[name] = file["vertices"].shape[1]
    figures = json.loads((tmp_path / "out" / "figures.json").read_text())
    assert figures["garment"] == ["shorts", "tank"]
    assert {name: found["vertices"] for name, found in figures["garments"].items()} == sizes
    assert figures["vertices"] == sum(sizes.values())
    assert "beneath" not in figures["garments"]["1_shorts"]
    said = f"2_tank beneath those under it: {figures['garments']['2_tank']['beneath']:.2f} % of the"
    assert said in capsys.readouterr().err
    with pytest.raises(InputError, match="not empty; give another -o, or --overwrite"):
        drape.main(words)
