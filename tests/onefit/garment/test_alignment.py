"""``python -m onefit.align``: garments of CLOTH3D on the standard body."""

import re

import numpy as np
import pytest
import torch

from onefit import align
from onefit.body import skinning
from onefit.garment import Garment, alignment, standard_body
from polyfit import read_mesh, write_ply
from polyfit.errors import InputError


@pytest.mark.parametrize("name, loose", [("trousers", False), ("tshirt", False), ("dress", True)])
def test_a_garment_of_cloth3d_is_aligned_by_the_nearest_vertices(
    name, loose, templates, anny, tmp_path
):
    """By the command: from another body in CLOTH3D's pose to the standard body in the T-pose."""
    g, shape = templates[name], anny.standard_shape.clone()
    shape[anny.shape_names.index("weight")] = 0.7
    body, pose = anny.body(shape), alignment.pose_of("cloth3d")
    place = lambda b, V, to: skinning.skin(
        V, g.blend_weights, skinning.transforms(b, to[None], torch.zeros(1, 3))
    )[0].double()
    made = place(body, g.graded(body), pose)
    write_ply(tmp_path / "made.ply", made.numpy(), g.faces.numpy())
    words = [str(tmp_path / "made.ply"), "-o", str(tmp_path / "out.ply"), "--shape", "weight=0.7"]
    align.main([*words, *(["--loose"] if loose else [])])
    V, F, _ = read_mesh(tmp_path / "out.ply")
    assert np.array_equal(F, g.faces.numpy())
    wanted = place(standard_body(), g.vertices, pose if loose else torch.zeros(24, 3)).numpy()
    error = np.linalg.norm(V - wanted, axis=1).mean()
    assert error < 0.006 and error < 0.5 * np.linalg.norm(made.numpy() - wanted, axis=1).mean()
    back = Garment.read(tmp_path / "out.ply", made_for="T-pose", loose=loose)
    assert (back.vertices - g.vertices).norm(dim=1).mean() < (0.02 if loose else 0.008)


def test_cloth3d_s_legs_stand_apart():
    apart = alignment.wearer(standard_body(), alignment.pose_of("cloth3d"))
    straight = alignment.wearer(standard_body(), alignment.pose_of("T-pose"))
    feet = apart.joints[[7, 8]], straight.joints[[7, 8]]  # ankles, the left one at +x
    width = [float(x[0, 0] - x[1, 0]) for x in feet]
    leg = float((straight.joints[1] - straight.joints[7]).norm())
    assert width[0] - width[1] == pytest.approx(2 * leg * np.sin(0.15), rel=0.05)
    assert torch.allclose(apart.joints[[16, 20]], straight.joints[[16, 20]], atol=1e-5)


def test_alignment_refuses_what_is_not_on_the_body(tank, tmp_path):
    V, F = tank
    write_ply(tmp_path / "far.ply", V + [0.5, 0, 0], F)
    with pytest.raises(InputError, match="far.ply: does not lie on the body"):
        align.main([str(tmp_path / "far.ply"), "-o", str(tmp_path / "out.ply")])
    write_ply(tmp_path / "nan.ply", np.where(np.arange(len(V))[:, None] == 3, np.nan, V), F)
    with pytest.raises(
        InputError, match="nan.ply: 1 vertices have coordinates that are not finite"
    ):
        align.main([str(tmp_path / "nan.ply"), "-o", str(tmp_path / "out.ply")])
    with pytest.raises(InputError, match="is the garment itself"):
        align.main([str(tmp_path / "far.ply"), "-o", str(tmp_path / "far.ply")])
    with pytest.raises(InputError, match="pose 'sitting': choose cloth3d or T-pose"):
        alignment.pose_of("sitting")
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize(
    "name", ["tshirt", "long_sleeve_top", "shirt", "trousers", "jumpsuit", "boxy_tshirt"]
)
def test_a_garment_is_refused_in_a_stand_that_is_not_its_own(name, tmp_path):
    """In the standard stand it is not read as one in the T-pose, nor aligned; in that one it is."""
    g = Garment.template(name)
    V, F = g.vertices.double().numpy(), g.faces.numpy()
    looks = "^garment: looks made for the stand with lowered arms .*: "
    with pytest.raises(InputError, match=looks + re.escape("give made_for=None (no --made-for)")):
        Garment.of_mesh(name, V, F, made_for="T-pose")
    write_ply(tmp_path / "made.ply", V, F)
    with pytest.raises(
        InputError, match="lowered arms .*: give the garment itself to onefit.drape"
    ):
        align.main([str(tmp_path / "made.ply"), "-o", str(tmp_path / "out.ply")])
    assert not (tmp_path / "out.ply").exists()
    body, t_pose = standard_body(), torch.zeros(1, 24, 3)
    maps = skinning.transforms(body, t_pose, torch.zeros(1, 3))
    posed = skinning.skin(g.vertices, g.blend_weights, maps)[0].double().numpy()
    back = Garment.of_mesh(name, posed, F, made_for="T-pose")
    assert (back.vertices - g.vertices).norm(dim=1).mean() < 0.01
