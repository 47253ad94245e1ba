"""Texture coordinates with and without seams."""

import numpy as np
import surfaces
import synthetic

from polyfit.mesh import TexCoords, read_textured


def test_one_a_vertex_without_seams():
    faces = synthetic.grid_faces(3, 4)
    uv = np.random.default_rng(0).uniform(size=(12, 2))
    order = np.random.default_rng(1).permutation(12)  # numbers of their own, as OBJ files have
    texcoords = TexCoords(uv[order], np.argsort(order)[faces])
    np.testing.assert_array_equal(texcoords.of_vertices(faces), uv)
    np.testing.assert_array_equal(texcoords.corners, uv[faces])
    source, split, cut = texcoords.split(faces)
    np.testing.assert_array_equal(source, np.arange(12))
    np.testing.assert_array_equal(split, uv)
    assert cut is faces


def test_a_vertex_without_a_face_has_none():
    uv = TexCoords(np.zeros((3, 2)), np.array([[0, 1, 2]])).of_vertices(np.array([[0, 1, 3]]), 5)
    np.testing.assert_array_equal(np.isnan(uv[:, 0]), [False, False, True, False, True])


def test_a_seam_splits_its_vertices():
    faces, texcoords = synthetic.tube_faces(5, 8)
    assert texcoords.of_vertices(faces) is None
    source, uv, cut = texcoords.split(faces)
    assert len(source) == 5 * 9  # the seam's five vertices twice
    np.testing.assert_array_equal(source[cut], faces)
    np.testing.assert_array_equal(uv[cut], texcoords.corners)
    assert len(np.unique(np.column_stack([source, uv]), axis=0)) == len(source)


def test_a_file_keeps_its_seam(tmp_path):
    V = surfaces.tube(around=8, along=5)[0]
    faces, texcoords = synthetic.tube_faces(5, 8)
    synthetic.write_obj(tmp_path / "tube.obj", V, texcoords, faces)
    vertices, read, found = read_textured(tmp_path / "tube.obj")
    np.testing.assert_allclose(vertices, V, atol=1e-8)
    np.testing.assert_array_equal(read, faces)
    np.testing.assert_allclose(found.corners, texcoords.corners, atol=1e-8)
