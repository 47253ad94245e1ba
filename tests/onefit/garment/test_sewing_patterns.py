"""Sewing patterns: read, sewn around the body, and draped."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import onefit
from onefit import drape
from onefit.garment import Garment, standard_body, standard_surface
from onefit.garment.sewing import seams, specification
from onefit.objective import crossings
from polyfit import mesh
from polyfit.errors import InputError

FOLDER = Path(__file__).parent / "patterns"
# Openings: hem, neck or hood, and two armholes or cuffs; the jumpsuit has two legs, no hem
LOOPS = {"dress_pencil": 4, "hoody_mean": 4, "js_mean_all": 5, "shirt_mean": 4}


def path_of(name):
    return FOLDER / f"{name}_specification.json"


@cache
def sewn(name):
    return Garment.read(path_of(name), count=900)


@pytest.fixture(
    params=[
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("hoody_mean", "js_mean_all")))
        for name in LOOPS
    ]
)
def garment(request):
    return sewn(request.param)


def perimeter(points):
    return np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum()


def tube(**changes):
    """A pattern of two panels, 50 cm wide and 40 cm high, sewn at the sides: a skirt around the
    standard body's hips, in centimetres.
    """
    panel = lambda z: {
        "translation": [0, 55, z],
        "rotation": [0, 0, 0],
        "vertices": [[-25, 0], [-25, 40], [25, 40], [25, 0]],
        "edges": [{"endpoints": [k, (k + 1) % 4]} for k in range(4)],
    }
    sides = [("front", 0, "back", 0), ("front", 2, "back", 2)]
    pair = lambda p, e, q, f: [{"panel": p, "edge": e}, {"panel": q, "edge": f}, "right_wrong"]
    pattern = {
        "panels": {"front": panel(25), "back": panel(-20)},
        "stitches": [pair(*s) for s in sides],
    }
    return {"pattern": pattern, "properties": {"units_in_meter": 100}} | changes


def written(folder, pattern, name="tube_specification.json"):
    (folder / name).write_text(json.dumps(pattern))
    return folder / name


def test_is_one_piece_whose_seams_are_closed(garment):
    V, F = garment.vertices.double().numpy(), garment.faces.numpy()
    found = mesh.loops(F)
    assert len(found) == LOOPS[garment.name]
    assert len(V) - len(mesh.edges_of(F)[0]) + len(F) == 2 - len(found)
    assert len(np.unique(mesh.components(len(V), mesh.edges_of(F)[0]))) == 1
    assert min(perimeter(V[loop]) for loop in found) > 0.15  # a cuff; a seam left open is a slit
    assert 700 < len(garment) < 1100


def test_lies_outside_the_body_and_not_in_itself(garment):
    V, F = garment.vertices.numpy(), garment.faces.numpy()
    assert standard_surface()(V).distance.min() > 0.003
    assert standard_surface()(V[F].mean(axis=1)).distance.min() > 0.001
    assert crossings(V, F) == 0


def test_is_as_long_as_its_panels(garment):
    """Graded back to the body that it is made for, the cloth's lengths at rest are the panels', and
    as it hangs it is about as long.
    """
    faces, made_for = garment.faces, garment.graded(seams.mean_body())
    flat = garment.render_mesh.texcoords
    panels = flat.coordinates[flat.faces]
    panels = np.linalg.norm(np.roll(panels, -1, axis=1) - panels, axis=2)
    ratio = garment.sides(made_for).numpy() / panels  # the panels are laid out in some scale
    ratio /= np.median(ratio)
    assert np.abs(ratio - 1).mean() < 0.02 and np.percentile(np.abs(ratio - 1), 95) < 0.05
    pattern = specification.read(path_of(garment.name))
    area = sum(_area(np.concatenate([e[:-1] for e in p.edges])) for p in pattern.panels)
    of_made_for = mesh.areas(made_for.double().numpy(), faces.numpy()).sum()
    assert of_made_for == pytest.approx(area, rel=0.03)
    x = garment.vertices
    strain = (x[faces.roll(-1, 1)] - x[faces]).norm(dim=-1) / garment.sides() - 1
    assert strain.abs().mean() < 0.025


def _area(polygon):
    x, y = polygon.T
    return abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2


def test_drapes_and_carries_its_panels_as_texture(tmp_path):
    draper, motion = onefit.load(), onefit.Motion.generate("walk", seconds=0.3)
    for make in (draper.drape, draper.simulate):
        made = make(sewn("dress_pencil"), motion)
        assert torch.isfinite(made.vertices).all() and made.measures().collision < 0.5
    assert np.allclose(made.render_vertices(), made.vertices.numpy(), atol=1e-6)
    uv = made.render_mesh.texcoords.coordinates
    assert uv.min() == 0 and uv.max() == 1 and len(uv) > len(sewn("dress_pencil"))


def test_the_command_takes_a_pattern(tmp_path):
    path, out = written(tmp_path, tube()), tmp_path / "out"
    drape.main([
        str(path), "walk", "-o", str(out), "--seconds", "0.1", "--vertices", "500",
        "--skip", "usd", "render",
    ])  # fmt: skip
    with np.load(out / "drape.npz") as file:
        assert 400 < file["vertices"].shape[1] < 600 and np.isfinite(file["vertices"]).all()
        assert file["uv_faces"].shape == file["faces"].shape


def test_made_for_the_standard_body_it_has_the_lengths_of_its_panels(tmp_path):
    garment = Garment.read(written(tmp_path, tube()), made_for=standard_body(), count=600)
    assert garment.name == "tube" and len(mesh.loops(garment.faces.numpy())) == 2
    for loop in mesh.loops(garment.faces.numpy()):
        pairs = torch.as_tensor(np.stack([loop, np.roll(loop, -1)], axis=1))
        assert garment.rest_lengths(pairs).sum() == pytest.approx(1.0, abs=1e-4)  # twice 50 cm
    assert mesh.areas(garment.vertices.double().numpy(), garment.faces.numpy()).sum() == (
        pytest.approx(0.4, rel=0.02)
    )
    larger = 1.1 * garment.vertices
    assert torch.allclose(garment.sides(larger), 1.1 * garment.sides())
    with pytest.raises(InputError, match="count=300"):
        garment.remeshed(300)


def test_curves_are_those_of_the_format(tmp_path):
    """A half circle to the right of the way, a parabola, and a cubic on its own chord."""
    pattern = tube()
    edges = pattern["pattern"]["panels"]["front"]["edges"]
    edges[0]["curvature"] = {"type": "circle", "params": [20, 0, 1]}
    edges[1]["curvature"] = [0.5, 0.2]
    edges[2]["curvature"] = {"type": "cubic", "params": [[1 / 3, 0], [2 / 3, 0]]}
    front = specification.read(written(tmp_path, pattern)).panels[0]
    half, parabola, line = front.edges[:3]
    assert perimeter(half) - 0.4 == pytest.approx(0.2 * np.pi, rel=1e-3)
    assert half[:, 0].max() == pytest.approx(-0.25 + 0.2)  # it goes up, so its right is +x
    assert parabola[len(parabola) // 2, 1] == pytest.approx(0.4 + 0.2 * 0.5 / 2)
    assert np.abs(line[:, 0] - 0.25).max() < 1e-12
    placed = front.placed(np.array([[0.0, 0.0]]))
    assert np.allclose(placed, [[0, -0.25, 0.55]])  # z up, the body faces -y


def _without(key):
    def change(pattern):
        del pattern["pattern"]["panels"]["front"][key]

    return change


def _edge(k, **values):
    return lambda p: p["pattern"]["panels"]["front"]["edges"][k].update(values)


def _stitch(k, **values):
    return lambda p: p["pattern"]["stitches"][k][0].update(values)


_FLAT = dict(
    vertices=[[0, 0], [10, 0], [20, 0]],
    edges=[{"endpoints": ends} for ends in ([0, 1], [1, 2], [2, 0])],
    translation=[0, 100, 20],
    rotation=[0, 0, 0],
)


def _more(value):
    return lambda p: p["pattern"]["stitches"][0].append(value)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda p: p.pop("pattern"), "no sewing pattern"),
        (lambda p: p["properties"].update(units_in_meter=0), "units_in_meter is 0; a number above"),
        (lambda p: p["properties"].update(units_in_meter=None), "units_in_meter is None; a number"),
        (lambda p: p["properties"].update(units_in_meter="cm"), "units_in_meter is 'cm'; a number"),
        (lambda p: p["properties"].update(units_in_meter=1e9), "shorter than 0.1 mm"),
        (lambda p: p["properties"].update(units_in_meter=1), "edge 1 spans 50 m, more than 20"),
        (_edge(1, curvature=[0.5, 1e6]), "edge 1 spans .* m, more than 20; .*its curvature"),
        (lambda p: p["pattern"]["panels"].update(flat=_FLAT), "panel flat: .* on each other"),
        (lambda p: p["pattern"]["panels"].clear(), "no panels"),
        (_without("vertices"), "panel front: needs 'vertices'"),
        (_without("rotation"), "panel front: needs"),
        (_edge(1, endpoints=[1, 3]), "panel front: its edges are no loop"),
        (_edge(1, endpoints=[1, 7]), "panel front: needs"),
        (_edge(1, endpoints=[1.4, 2.4]), "panel front: needs .* two whole numbers"),
        (_edge(1, curvature={"type": "spline", "params": []}), "edge 1: curvature .*'spline'"),
        (
            _edge(1, curvature={"type": "cubic", "params": [[0.5, 0.2]]}),
            "edge 1: curvature .*cubic",
        ),
        (_edge(1, curvature={"type": "circle", "params": [20]}), "edge 1: curvature .*circle"),
        (_edge(1, curvature=0.2), "front: edge 1: curvature 0.2; one of 'type' quadratic"),
        (_edge(1, curvature=[0.5, float("nan")]), "not finite"),
        (_edge(1, curvature=[0.5, -3.0]), "its edges cross each other"),
        (_stitch(0, panel="hood"), "stitch 0: needs two sides"),
        (_stitch(0, edge=1.7), "stitch 0: needs two sides"),
        (_more({"panel": "front", "edge": 1}), "stitch 0: needs two sides"),
        (_more("wrong_right"), "stitch 0: 'wrong_right' beside its sides; only 'right_wrong'"),
        (_stitch(0, edge=9), "panel front has no edge 9; it has 4"),
        (_stitch(1, edge=0), "edge 0 of panel front is sewn twice"),
        (lambda p: p["properties"].update(units_in_meter=300), "does not fit the body"),
    ],
)
def test_a_bad_pattern_is_refused_in_one_line(change, message, tmp_path):
    pattern = tube()
    change(pattern)
    path = written(tmp_path, pattern)
    with pytest.raises(InputError, match=message) as error:
        Garment.read(path, count=400)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_a_pattern_s_name_may_end_in_capitals(tmp_path):
    path = tmp_path / "TUBE.JSON"
    with pytest.raises(InputError, match="TUBE.JSON: cannot be read"):
        Garment.read(path)
    with pytest.raises(InputError, match="of type '.txt'; a mesh .* or a sewing pattern"):
        Garment.read(tmp_path / "tube.txt")
    path.write_text("{}")
    with pytest.raises(InputError, match="no sewing pattern"):
        Garment.read(path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_pattern_s_file_may_begin_with_a_byte_order_mark(encoding, tmp_path):
    path = tmp_path / "tube_specification.json"
    path.write_bytes(json.dumps(tube()).encode(encoding))
    assert [panel.name for panel in specification.read(path).panels] == ["front", "back"]


def test_what_is_no_pattern_or_is_for_meshes_is_refused(tmp_path):
    path = tmp_path / "broken.json"
    path.write_text("{")
    with pytest.raises(InputError, match="no JSON"):
        Garment.read(path)
    path.write_text("[" * 100_000)
    with pytest.raises(InputError, match="no JSON"):
        Garment.read(path)
    with pytest.raises(InputError, match="cannot be read"):
        Garment.read(tmp_path / "none.json")
    with pytest.raises(InputError, match="are for meshes"):
        Garment.read(path_of("shirt_mean"), scale=0.01)
    with pytest.raises(InputError, match="a Body is needed"):
        Garment.read(path_of("shirt_mean"), made_for="T-pose")
