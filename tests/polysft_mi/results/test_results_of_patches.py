"""What a run on a template of several patches and with a seam leaves, and what is made of it."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import surfaces
import torch
import trimesh
from problems import at_rest, grid_template, some_state, tube_template
from scipy.spatial.transform import Rotation

from polyfit import jets
from polyfit.mesh import TexCoords
from polysft_mi import evaluate, export, report
from polysft_mi.errors import InputError
from polysft_mi.pictures.exr import read_exr
from polysft_mi.results.run import Run
from polysft_mi.results.truth import read_surface, texcoords_of, uv_arrays
from polysft_mi.surface.atlas import Atlas
from polysft_mi.surface.template import Template


def params_of(template, states):
    """As params.npz has them, in the world's axes."""
    arrays = [Atlas(template).arrays(s) for s in states]
    for a in arrays:
        a["rotation"] = a["rotation"].reshape(len(template), 4)
    names = ("alpha", "patch", "weight", "chart", "rest", "scale", "radius", "axes")
    return {
        **{name: np.asarray(getattr(template, name)) for name in names},
        "frame_rotation": template.rotation,
        "frame_origin": template.origin,
        **{name: np.stack([a[name] for a in arrays]) for name in arrays[0]},
    }


@pytest.mark.parametrize("make", [grid_template, tube_template])
def test_curvature_is_the_mean_of_polyfits_principal_ones(make):
    template, rng = make(), np.random.default_rng(0)
    states = [some_state(Atlas(template), rng) for _ in range(3)]
    p = params_of(template, states)
    found = Run.mean_curvature(SimpleNamespace(params=p))
    nearest = template.origin[:, 2].argmin()
    up = template.rotation[nearest] @ states[0].rotation[nearest].as_matrix()[:, 2]
    for t, state in enumerate(states):
        for k in range(len(template)):
            own = template.patch[:, 0] == k
            along = template.rotation[k].T @ template.axes[own] @ state.offset[own][..., None]
            uv = template.chart[own, 0] + template.scale / template.radius[k] * along[:, :2, 0]
            alpha = torch.as_tensor(p["alpha"][k] + p["delta_alpha"][t, k])
            wanted = jets.principal_curvatures(alpha, torch.as_tensor(uv)).mean(-1).numpy()
            wanted *= np.sign(up[2]) / template.radius[k]
            np.testing.assert_allclose(found[t, own], wanted, rtol=1e-8, atol=1e-9)


def test_curvature_of_a_ball_bulges_all_around():
    vertices, faces = surfaces.sphere(radius=0.2, subdivisions=3)
    ball = Template.fit(vertices + (0, 0, 1), faces, vertices[:, :2], 8)
    found = Run.mean_curvature(SimpleNamespace(params=params_of(ball, [at_rest(Atlas(ball))])))
    assert np.median(found) == pytest.approx(5, rel=0.02) and (found > 3).mean() > 0.98


def test_params_of_an_older_version_are_read(finished_run, tmp_path):
    """Of one patch: arrays without the patches' axis, and no residual."""
    folder = tmp_path / "older"
    shutil.copytree(finished_run[1], folder)
    new = Run.open(folder)
    p, wanted = dict(new.params), new.mean_curvature()
    old = {name: p[name] for name in ("frames", "scale", "delta_u", "delta_v", "delta_w")}
    old |= {name: p[name][0] for name in ("alpha", "frame_rotation", "frame_origin")}
    old |= {name: p[name][:, 0] for name in ("chart", "delta_alpha", "rotation", "translation")}
    np.savez(folder / "params.npz", **old)
    np.testing.assert_allclose(Run.open(folder).mean_curvature(), wanted, rtol=1e-6, atol=1e-9)
    del old["alpha"]
    np.savez(folder / "params.npz", **old)
    with pytest.raises(InputError, match="params.npz: holds no alpha"):
        Run.open(folder).mean_curvature()


def test_surface_file_keeps_seams(finished_tube, tmp_path):
    truth, out = finished_tube
    run = Run.open(out)
    assert run.uv is None and run.vertices.shape == truth.vertices.shape
    np.testing.assert_array_equal(run.faces, truth.faces)
    np.testing.assert_allclose(run.texcoords.corners, truth.uv.corners, atol=1e-6)
    arrays = read_surface(out)
    assert arrays["uv_faces"].shape == truth.faces.shape
    with pytest.raises(InputError, match="holds no uv of"):
        texcoords_of({**arrays, "uv": arrays["uv"][:5]}, "surface.npz")
    plain = TexCoords(arrays["uv"][: len(truth.vertices[0])], truth.faces)
    assert set(uv_arrays(plain, truth.faces)) == {"uv"}


def test_params_make_the_surface(finished_tube):
    """By the formulas of docs/conventions.md, from the arrays of the file alone."""
    run = Run.open(finished_tube[1])
    p = run.params
    patches, s = len(p["alpha"]), float(p["scale"])
    assert patches >= 3 and p["rotation"].shape == (3, patches, 4)
    assert np.linalg.det(p["axes"]) == pytest.approx(1)

    def points(t, k, vertex, slot, d):
        """Where patch k has the vertices, displaced by d (P, 3) in its chart."""
        alpha = torch.as_tensor(p["alpha"][k] + p["delta_alpha"][t, k])
        uv = torch.as_tensor(p["chart"][vertex, slot] + d[:, :2])
        x = jets.point(alpha, uv).numpy()
        x[:, 2] += p["rest"][vertex, slot] + d[:, 2]
        turned = x @ Rotation.from_quat(p["rotation"][t, k]).as_matrix().T
        local = p["radius"][k] * turned + s * p["translation"][t, k]
        return local @ p["frame_rotation"][k].T + p["frame_origin"][k]

    for t in range(3):
        x = np.zeros_like(run.vertices[t], dtype=np.float64)
        offset = np.stack([p[f"delta_{name}"][t] for name in "uvw"], 1).astype(np.float64)
        for k in range(patches):
            vertex, slot = np.nonzero((p["patch"] == k) & (p["weight"] > 0))
            still = points(t, k, vertex, slot, np.zeros((len(vertex), 3)))
            x[vertex] += p["weight"][vertex, slot, None] * still
            own, unit = np.flatnonzero(p["patch"][:, 0] == k), s / p["radius"][k]
            axes = p["frame_rotation"][k].T @ p["axes"][own]
            d = unit * np.einsum("nij,nj->ni", axes, offset[own])
            normal = jets.normal(
                torch.as_tensor(p["alpha"][k]), torch.as_tensor(p["chart"][own, 0])
            ).numpy()
            normal /= normal[:, 2:]  # (-z_u, -z_v, 1) of the undeformed jet
            d[:, 2] = unit * (normal * axes[:, :, 2]).sum(1) * offset[own, 2]
            first = np.zeros(len(own), dtype=int)
            x[own] += points(t, k, own, first, d) - points(t, k, own, first, 0 * d)
        np.testing.assert_allclose(x, run.vertices[t], atol=2e-5)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply", "usd", "npz"])
def test_exports_keep_the_seam(finished_tube, tmp_path, kind):
    truth, out = finished_tube
    path = tmp_path / {"glb": "a.glb", "usd": "a.usda", "npz": "a.npz"}.get(kind, kind)
    assert export.main([str(out), "--format", kind, "-o", str(path), "-q"]) == 0
    wanted = Run.open(out).texcoords.corners
    if kind == "npz":
        arrays = np.load(path)
        found = arrays["uv"][arrays["uv_faces"]]
    elif kind == "usd":
        usd = pytest.importorskip("pxr.UsdGeom")
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(path))
        mesh = usd.Mesh(stage.GetPrimAtPath("/surface/mesh"))
        st = usd.PrimvarsAPI(mesh).GetPrimvar("st")
        assert st.GetInterpolation() == usd.Tokens.faceVarying
        assert len(mesh.GetPointsAttr().Get(0)) == len(truth.vertices[0])
        found = np.array(st.ComputeFlattened()).reshape(-1, 3, 2)
    else:
        file = path / "001.obj" if kind == "obj" else path / "001.ply" if kind == "ply" else path
        if kind == "obj":
            lines = file.read_text().splitlines()
            vt = np.array([line.split()[1:] for line in lines if line.startswith("vt ")], float)
            faces = [line.split()[1:] for line in lines if line.startswith("f ")]
            corners = np.array([[c.split("/") for c in face] for face in faces], int) - 1
            np.testing.assert_array_equal(corners[..., 0], truth.faces)
            found = vt[corners[..., 1]]
        else:
            mesh = trimesh.load(file, process=False, force="mesh")
            assert len(mesh.vertices) == len(truth.vertices[0]) + 9  # the seam's row once more
            found = mesh.visual.uv[mesh.faces]
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_report_shows_the_patches(finished_tube, tmp_path):
    path = tmp_path / "report.html"
    assert report.main([str(finished_tube[1]), "-o", str(path)]) == 0
    text = path.read_text(encoding="utf-8")
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert data["mesh"]["patches"] and data["mesh"]["colours"]


def test_exr_has_the_patch_of_each_pixel(finished_tube):
    truth, out = finished_tube
    layers, _ = read_exr(out / "comparison" / "000.exr")
    patch, run = layers["patch"][..., 0], Run.open(out)
    assert set(np.unique(patch)) <= {0.0, *range(1, 1 + len(run.params["alpha"]))}
    assert len(np.unique(patch)) >= 3  # nothing, and patches side by side
    np.testing.assert_array_equal(patch > 0, layers["depth"][..., 0] > 0)
    own = run.params["patch"][:, 0] + 1
    x = np.floor(run.camera.project(run.vertices[0].astype(float))).astype(int)
    seen = np.load(truth.folder / "gt.npz")["seen"][0]
    inner = [
        k
        for k in np.flatnonzero(seen)
        if len(set(own[truth.faces][(truth.faces == k).any(1)].ravel())) == 1
    ]
    shown = np.array([patch[x[k, 1], x[k, 0]] == own[k] for k in inner])
    assert len(inner) > 10 and shown.mean() > 0.8


def test_figures_of_what_is_in_view(finished_tube, tmp_path, capsys):
    truth, out = finished_tube
    assert evaluate.main([str(out), str(truth.folder), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    run, gt = Run.open(out), np.load(truth.folder / "gt.npz")
    rmse = [
        1e3 * np.sqrt(((V - G)[m] ** 2).sum(1).mean())
        for V, G, m in zip(run.vertices.astype(float), gt["vertices"], gt["seen"])
    ]
    assert figures["rmse_mm_seen"] == pytest.approx(np.mean(rmse), rel=1e-6)
    assert figures["e3d_proc_seen"] < 0.01 and figures["en_deg_seen"] < 15
    bad = tmp_path / "gt.npz"
    np.savez(bad, vertices=gt["vertices"], faces=gt["faces"], seen=gt["seen"][:1])
    with pytest.raises(InputError, match=r"gt.npz: seen \(1, 162\)"):
        evaluate.main([str(out), str(bad)])
