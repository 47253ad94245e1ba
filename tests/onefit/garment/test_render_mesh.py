"""The mesh of a garment's file rides on the cloth: whole, at rest where it was, rigid with it."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from surfaces import joined, sphere
from synthetic import write_obj

from onefit.garment import Garment, RenderMesh
from polyfit.mesh import TexCoords


@pytest.fixture(scope="module")
def file_mesh(tank):
    """The tank top cut along its middle as a file with one coordinate a vertex has it, with a
    button and a vertex in no face.
    """
    V, F = tank
    left = V[F].mean(axis=1)[:, 0] < 0
    V, F = np.concatenate([V, V]), np.where(left[:, None], F, F + len(V))
    button, G = sphere(0.006, 1)
    V, F = joined((V, F), (button + [0, -0.16, 0.3], G))
    return np.concatenate([V, [[0.1, -0.2, 0.3]]]), F


@pytest.fixture(scope="module")
def garment(file_mesh):
    V, F = file_mesh
    return Garment.of_mesh("top", V, F, TexCoords(V[:, ::2], F))


def arrays(garment):
    return garment.vertices.double().numpy(), garment.faces.numpy()


def test_at_rest_it_is_the_file(garment, file_mesh, tank):
    V, F = file_mesh
    assert len(garment) == len(tank[0]) < len(V)
    mesh = garment.render_mesh
    used = np.unique(F)
    assert np.abs(mesh.carried(*arrays(garment)) - V)[used].max() < 1e-6
    assert np.array_equal(mesh.faces, F) and np.array_equal(mesh.texcoords.faces, F)


@pytest.mark.parametrize("kind", [torch.as_tensor, np.ndarray.tolist])
def test_a_mesh_may_be_anything_like_arrays(tank, kind):
    garment = Garment.of_mesh("top", kind(tank[0]), kind(tank[1]))
    assert np.array_equal(garment.faces, tank[1])
    assert np.abs(garment.render_mesh.carried(*arrays(garment)) - tank[0]).max() < 1e-6


def test_a_garment_wound_inwards_carries_its_file(tank):
    V, F = tank
    garment = Garment.of_mesh("top", V, F[:, ::-1])
    assert np.abs(garment.render_mesh.carried(*arrays(garment)) - V).max() < 1e-6


def test_it_turns_with_the_cloth(garment, file_mesh):
    V, _ = file_mesh
    cloth, faces = arrays(garment)
    turn = Rotation.from_rotvec([0.4, -1, 2]).as_matrix()
    moved = garment.render_mesh.carried(cloth @ turn.T + [1, 2, 3], faces)
    assert moved == pytest.approx(V @ turn.T + [1, 2, 3], abs=1e-5)


def test_a_button_keeps_its_size_on_cloth_that_bends(garment, file_mesh, tank):
    V, _ = file_mesh
    cloth, faces = arrays(garment)
    bent = cloth + np.stack([0 * cloth[:, 0], 0.3 * cloth[:, 0] ** 2, 0 * cloth[:, 0]], 1)
    moved = garment.render_mesh.carried(bent, faces)
    button = slice(2 * len(tank[0]), len(V) - 1)
    size = lambda x: np.linalg.norm(x[button] - x[button].mean(axis=0), axis=1)
    assert size(moved) == pytest.approx(size(V), rel=0.1)


def test_a_seam_stays_closed_and_can_be_welded(garment, tank):
    cloth, faces = arrays(garment)
    moved = garment.render_mesh.carried(cloth * [1, 1.2, 0.9], faces)
    n = len(tank[0])
    assert np.abs(moved[:n] - moved[n : 2 * n]).max() < 1e-6
    kept, welded = garment.render_mesh.welded(moved)
    assert len(kept) == len(moved) - n and welded.max() < len(kept)


def test_a_fine_mesh_stays_round_on_coarse_cloth():
    """A ball on a coarse ball, both stretched: the fine one is five times as round."""
    fine, coarse = sphere(0.1, 4), sphere(0.1, 2)
    held = RenderMesh.bound(*fine, None, *coarse)
    radius = lambda x: np.linalg.norm(x / [1, 1, 2], axis=1)
    seen = held.carried(coarse[0] * [1, 1, 2], coarse[1])
    flat = (coarse[0] * [1, 1, 2])[coarse[1]].mean(axis=1)
    assert 0.1 - radius(seen).min() < 0.2 * (0.1 - radius(flat).min())
    assert held.carried(*coarse) == pytest.approx(fine[0], abs=1e-6)


def test_another_resolution_carries_the_same_mesh(garment, file_mesh):
    V, F = file_mesh
    other = garment.remeshed(0.6 * len(garment))
    assert np.abs(other.render_mesh.carried(*arrays(other)) - V)[np.unique(F)].max() < 1e-3


def test_a_drape_hands_the_file_back(garment, file_mesh, tmp_path):
    import onefit
    from onefit.draping import output
    from polyfit.mesh import read_textured

    V, F = file_mesh
    write_obj(tmp_path / "top.obj", V, TexCoords(V[:, ::2], F), F)
    drape = onefit.load().drape(tmp_path / "top.obj", onefit.Motion.generate("walk", seconds=0.1))
    assert drape.render_vertices().shape == (3, *V.shape)
    output.write([drape], ["top"], tmp_path, skip=("usd", "render"), meshes="obj")
    W, G, texcoords = read_textured(tmp_path / "meshes" / "002.obj")
    assert np.array_equal(G, F) and np.abs(W - drape.render_vertices()[2]).max() < 1e-6
    assert texcoords.corners == pytest.approx(V[F][..., ::2], abs=1e-6)
    template = onefit.load().drape("tank", onefit.Motion.generate("walk", seconds=0.1))
    assert template.render_vertices() is not None and template.render_mesh is None
