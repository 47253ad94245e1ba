"""Bodies from SMPL's files and from plain files."""

import pickle
import sys
import types

import numpy as np
import pytest
import torch
from standing import random_poses, smpl_contents

from onefit.body import PlainBody, SmplBody, skeleton, skinning
from onefit.draping import shape_of
from polyfit.errors import InputError

# --- bodies from files ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def smpl(standard):
    return smpl_contents(standard)


def test_smpl_body_stands_in_the_standard_pose(smpl, standard, tmp_path):
    np.savez(tmp_path / "model.npz", **smpl)
    model = SmplBody(tmp_path / "model.npz")
    body = model.body()
    assert model.shape_names == ("beta0", "beta1") and body.kind == "smpl"
    assert torch.allclose(body.joints, standard.joints, atol=2e-4) and torch.equal(
        body.rest_pose, skeleton.standard_rest_pose()
    )
    rigid = (
        standard.blend_weights.amax(1) > 0.999
    )  # elsewhere skinning there and back is not quite the way it came
    assert rigid.sum() > 3000
    assert (body.vertices - standard.vertices)[rigid].norm(dim=1).max() < 3e-4
    assert (body.vertices - standard.vertices).norm(dim=1).max() < 0.05
    pose = random_poses(2, seed=7)
    posed = [
        skinning.skin(
            b.vertices[rigid],
            b.blend_weights[rigid],
            skinning.transforms(b, pose, torch.zeros(2, 3)),
        )
        for b in (body, standard)
    ]
    assert (posed[0] - posed[1]).norm(dim=-1).max() < 1e-3
    assert torch.allclose(body.joints[0], model.body((2.0, 0.0)).joints[0], atol=1e-5)
    assert (
        abs(
            np.ptp(model.body((2.0, 0.0)).vertices[:, 2].numpy())
            / np.ptp(body.vertices[:, 2].numpy())
            - 1.1
        )
        < 2e-3
    )
    drawn = model.random_shape(np.random.default_rng(0))
    assert drawn.shape == (2,) and drawn.abs().max() <= 2


def test_smpl_pickles_hold_sparse_and_chumpy_arrays(smpl, tmp_path, monkeypatch):
    from scipy import sparse

    chumpy = types.ModuleType("chumpy")
    chumpy.ch = types.ModuleType("chumpy.ch")
    chumpy.ch.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    held = chumpy.ch.Ch()
    held.x = smpl["shapedirs"]
    for name, module in (("chumpy", chumpy), ("chumpy.ch", chumpy.ch)):
        monkeypatch.setitem(sys.modules, name, module)
    for protocol in (0, 2, 4):
        path = tmp_path / f"model{protocol}.pkl"
        data = smpl | {
            "J_regressor": sparse.csc_matrix(smpl["J_regressor"]),
            "shapedirs": held,
            "bs_type": "lrotmin",
        }
        path.write_bytes(pickle.dumps(data, protocol))
        np.savez(tmp_path / "model.npz", **smpl)
        assert torch.allclose(
            SmplBody(path).body().vertices, SmplBody(tmp_path / "model.npz").body().vertices
        )


class Call:
    """Pickles as a call of ``touch FILE``."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        import os

        return os.system, (f"touch {self.path}",)


def test_pickles_cannot_run_code(smpl, tmp_path):
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(smpl | {"f": Call(tmp_path / "touched")}))
    with pytest.raises(InputError, match="(posix|nt).system, which could run code") as error:
        SmplBody(tmp_path / "model.pkl")
    assert "\n" not in str(error.value) and not (tmp_path / "touched").exists()


def test_fingers_and_face_of_larger_skeletons_are_folded_into_24_joints(smpl, tmp_path):
    parents = [
        *skeleton.PARENTS[:22],
        *(20 if k % 3 == 0 else 21 + k for k in range(15)),
        *(21 if k % 3 == 0 else 36 + k for k in range(15)),
    ]
    W, R = smpl["weights"], smpl["J_regressor"]
    weights, regressor = np.zeros((len(W), 52)), np.zeros((52, R.shape[1]))
    weights[:, :22], regressor[:22] = W[:, :22], R[:22]
    for joint, hand in ((22, 22), (23, 37)):
        weights[:, [hand, hand + 4, hand + 11]] = (
            W[:, [joint]] / 3
        )  # on first, second and third bones of fingers
        regressor[hand : hand + 15] = R[joint]
    large = smpl | {
        "weights": weights,
        "J_regressor": regressor,
        "kintree_table": np.array([parents, range(52)]),
    }
    np.savez(tmp_path / "smplh.npz", **large)
    np.savez(tmp_path / "smpl.npz", **smpl)
    one, other = SmplBody(tmp_path / "smplh.npz").body(), SmplBody(tmp_path / "smpl.npz").body()
    assert torch.allclose(one.blend_weights, other.blend_weights, atol=1e-6) and torch.allclose(
        one.joints, other.joints, atol=1e-5
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": None}, "misses weights; a body file has"),
        (
            {"shapedirs": np.zeros((10, 3, 2))},
            r"shapedirs of shape \(10, 3\) does not fit; \(13348, 3\) is needed",
        ),
        ({"f": np.zeros((0, 3), dtype=int)}, "no faces"),
        (
            {"kintree_table": np.zeros((2, 24), dtype=int)},
            "parents are not those of SMPL's skeleton",
        ),
        (
            {"v_template": np.full((13348, 3), np.nan)},
            "v_template holds values that are not finite numbers",
        ),
        ({"J_regressor": np.zeros((24, 13348))}, "its joints are not all over the body"),
        ({"v_template": slice(None)}, "deep; one that stands upright is needed"),
    ],
)
def test_smpl_files_that_cannot_be_used(smpl, tmp_path, change, message):
    if isinstance(change.get("v_template"), slice):  # z is up
        change = {"v_template": smpl["v_template"][:, [0, 2, 1]] * [1, -1, 1]}
    np.savez(tmp_path / "model.npz", **{k: v for k, v in (smpl | change).items() if v is not None})
    with pytest.raises(InputError, match=message) as error:
        SmplBody(tmp_path / "model.npz").body()
    assert str(tmp_path / "model.npz") in str(error.value) and "\n" not in str(error.value)


def plain(standard, **changes):
    """A body.npz's contents of the standard body at rest, in OneFit's axes."""
    data = {
        "vertices": standard.vertices.numpy(), "faces": standard.faces.numpy(),
        "blend_weights": standard.blend_weights.numpy(), "joints": standard.joints.numpy(),
        "rest_pose": standard.rest_pose.numpy(), "parents": np.array(skeleton.PARENTS),
    }  # fmt: skip
    return data | changes


def test_plain_body_comes_out_as_it_went_in(standard, tmp_path):
    np.savez(tmp_path / "body.npz", **plain(standard))
    body = PlainBody(tmp_path / "body.npz").body()
    assert torch.allclose(body.vertices, standard.vertices, atol=5e-5) and torch.equal(
        body.faces, standard.faces
    )
    assert torch.allclose(body.joints, standard.joints, atol=5e-5) and body.shape.shape == (0,)


def test_a_plain_body_has_no_shapes(standard, tmp_path):
    np.savez(tmp_path / "body.npz", **plain(standard))
    with pytest.raises(InputError, match="^--shape x=1: this body has one shape only"):
        shape_of(PlainBody(tmp_path / "body.npz"), ["x=1"])


def test_plain_body_with_y_up_in_the_t_pose(standard, smpl, tmp_path):
    J = smpl["J_regressor"] @ smpl["v_template"]
    np.savez(
        tmp_path / "body.npz",
        **plain(standard, vertices=smpl["v_template"], joints=J, rest_pose=np.zeros((24, 3))),
    )
    np.savez(tmp_path / "model.npz", **smpl)
    one, other = PlainBody(tmp_path / "body.npz").body(), SmplBody(tmp_path / "model.npz").body()
    assert torch.allclose(one.vertices, other.vertices, atol=1e-5) and torch.allclose(
        one.joints, other.joints, atol=1e-5
    )


def test_plain_files_that_cannot_be_used(standard, tmp_path):
    cases = [
        (
            {"vertices": standard.vertices.numpy() * 100, "joints": standard.joints.numpy() * 100},
            "a body 162.6 units tall; metres are needed; in cm",
        ),
        ({"joints": np.zeros((65, 3)), "rest_pose": np.zeros((65, 4))}, "65 joints; 24"),
        ({"rest_pose": np.zeros((24, 4))}, "axis-angle vectors"),
        (
            {
                "vertices": standard.vertices.numpy() * [-1, 1, 1],
                "joints": standard.joints.numpy() * [-1, 1, 1],
            },
            "its left is at -x",
        ),
        ({"joints": standard.joints.numpy()[:, [2, 1, 0]]}, "a body that stands along y or z"),
        ({"blend_weights": standard.blend_weights.numpy()[:100]}, "blend weights for 100 vertices"),
        ({"blend_weights": 0 * standard.blend_weights.numpy()}, "zero for a whole vertex"),
    ]
    for changes, message in cases:
        np.savez(tmp_path / "body.npz", **plain(standard, **changes))
        with pytest.raises(InputError, match=message) as error:
            PlainBody(tmp_path / "body.npz")
        assert "\n" not in str(error.value)
    (tmp_path / "body.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"cannot be read as a body \(no .npz file\)"):
        PlainBody(tmp_path / "body.npz")
    with pytest.raises(InputError, match="no such file"):
        PlainBody(tmp_path / "none.npz")
    with pytest.raises(InputError, match="read from .npz or .pkl"):
        PlainBody(tmp_path / "body.obj")
