"""Bodies: Anny reduced to 24 joints, models of the SMPL family, plain files, and skinning."""

import pickle
import subprocess
import sys
import types

import numpy as np
import pytest
import torch

from onefit.body import AnnyBody, PlainBody, SmplBody, skeleton, skinning
from onefit.body.skeleton import INDEX
from onefit.body.smpl import FROM_SMPL
from polyfit.errors import InputError
from polyfit.mesh import edges_of, read_mesh

HEAD, FRONT = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)


@pytest.fixture(scope="module")
def model():
    return AnnyBody()


@pytest.fixture(scope="module")
def standard(model):
    return model.body()


def places(body, **turns):
    """Joints by name, of a pose with the joints in ``turns`` turned [rad], the others as in the
    T-pose.
    """
    pose = torch.zeros(1, 24, 3)
    for name, turn in turns.items():
        pose[0, INDEX[name]] = torch.tensor(turn)
    J = (
        skinning.posed_joints(body, skinning.transforms(body, pose, torch.zeros(1, 3)))[0]
        .double()
        .numpy()
    )
    return {name: J[j] for name, j in INDEX.items()}


def angle(a, b):
    """Angle [°] between two directions."""
    a, b = np.asarray(a), np.asarray(b)
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def random_poses(count, seed=0, size=0.5):
    return torch.randn(count, 24, 3, generator=torch.Generator().manual_seed(seed)) * size


# --- Anny -----------------------------------------------------------------------------------------


def test_standard_body_is_that_of_the_garments(standard, shared_data):
    vertices = read_mesh(str(shared_data / "garments_makehuman" / "body_rest.obj"))[0]
    offset = torch.cdist(
        standard.vertices[::50].double(), torch.as_tensor(np.asarray(vertices))
    ).amin(1)
    assert offset.max() < 2e-6


def test_surface_is_closed_wound_outwards_and_in_metres(standard):
    assert (
        standard.vertices.shape == (13348, 3)
        and standard.vertices.dtype == torch.float32
        and standard.faces.dtype == torch.int64
    )
    F = standard.faces.numpy()
    _, edge = edges_of(F)
    assert (np.bincount(edge.ravel()) == 2).all()  # every edge has two faces
    a, b, c = standard.vertices.double()[standard.faces].unbind(1)
    assert (
        0.045 < float((a * torch.linalg.cross(b, c)).sum() / 6) < 0.06
    )  # m³, positive: wound outwards
    assert 1.6 < float(np.ptp(standard.vertices[:, 2].numpy())) < 1.65
    assert (
        torch.allclose(standard.blend_weights.sum(1), torch.ones(13348), atol=1e-6)
        and (standard.blend_weights >= 0).all()
    )


def test_standard_poses_and_joints_written_down_are_the_bodys(standard):
    assert torch.allclose(standard.rest_pose, skeleton.standard_rest_pose(), atol=2e-6)
    J = places(standard)
    assert (
        np.abs(np.stack([J[n] for n in skeleton.JOINTS]) - skeleton.standard_joints().numpy()).max()
        < 1e-4
    )


def test_rest_pose_moves_nothing(standard):
    A = skinning.transforms(standard, standard.rest_pose[None], torch.tensor([[0.1, 0.2, 0.3]]))
    moved = skinning.skin(standard.vertices, standard.blend_weights, A)[0]
    assert torch.allclose(moved - torch.tensor([0.1, 0.2, 0.3]), standard.vertices, atol=1e-5)


@pytest.mark.parametrize(
    "shape", [None, (0.1, 0.7, 0.6, 0.3, 0.5, 0.6), (0.9, 0.6, 0.35, 0.7, 0.35, 0.3)]
)
def test_t_pose(model, shape):
    J = places(model.body(shape))
    for side, x in (("left", 1.0), ("right", -1.0)):
        for joint, end in (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand")):
            assert (
                angle(J[f"{side}_{end}"] - J[f"{side}_{joint}"], (x, 0, 0)) < 0.1
            )  # arms level and straight
        for joint, end in (("hip", "knee"), ("knee", "ankle")):
            bone = J[f"{side}_{end}"] - J[f"{side}_{joint}"]
            assert (
                abs(bone[0]) < 1e-4 and angle(bone, (0, 0, -1)) < 8
            )  # upright from the front, as soft at the knee as at rest
    assert (
        J["left_foot"][1] < J["left_ankle"][1] - 0.1
        and J["head"][2] > J["neck"][2] > J["pelvis"][2]
    )


def test_t_pose_has_palms_down_and_soles_flat(model, standard):
    anny = model._anny
    heads = anny.template_bone_heads + torch.tensordot(
        anny.get_phenotype_blendshape_coefficients()[0], anny.bone_heads_blendshapes, 1
    )
    A = skinning.transforms(standard, torch.zeros(1, 24, 3), torch.zeros(1, 3))[0].double()
    moved = lambda bone, joint: (
        A[INDEX[joint], :, :3] @ heads[anny.bone_labels.index(bone)] + A[INDEX[joint], :, 3]
    )
    across = moved("finger2-1.L", "left_hand") - moved("finger5-1.L", "left_hand")
    across[0] = 0.0  # along the arm
    assert angle(across.numpy(), FRONT) < 5  # the index finger in front of the little one
    assert abs(moved("toe1-1.L", "left_foot")[2] - moved("toe5-1.L", "left_foot")[2]) < 0.02


def test_known_poses(standard):
    up = {"left_shoulder": (0.0, -np.pi / 2, 0.0), "right_shoulder": (0.0, np.pi / 2, 0.0)}
    J = places(standard, **up)
    for side in ("left", "right"):
        assert angle(J[f"{side}_wrist"] - J[f"{side}_shoulder"], HEAD) < 0.1
    J = places(standard, left_elbow=(0.0, 0.0, -np.pi / 2), right_elbow=(0.0, 0.0, np.pi / 2))
    for side in ("left", "right"):
        assert angle(J[f"{side}_wrist"] - J[f"{side}_elbow"], FRONT) < 0.1
        assert (
            abs(
                angle(
                    J[f"{side}_wrist"] - J[f"{side}_elbow"],
                    J[f"{side}_elbow"] - J[f"{side}_shoulder"],
                )
                - 90
            )
            < 0.1
        )
    straight, bent = places(standard), places(standard, left_knee=(np.pi / 2, 0.0, 0.0))
    shin = lambda J: J["left_ankle"] - J["left_knee"]
    assert (
        abs(angle(shin(straight), shin(bent)) - 90) < 0.1 and shin(bent)[1] > 0.35
    )  # the heel goes back, not the knee
    J = places(standard, pelvis=(0.0, 0.0, np.pi / 2))
    assert (
        angle(J["left_foot"] - J["left_ankle"], (1.0, 0.0, -0.3)) < 15
    )  # turned left, it faces its former left, +x


def test_moves_as_anny_does_with_its_bones_turned_in_groups(model, standard):
    """Against Anny's own forward pass. Exact where a joint's bones share one pivot: everywhere but
    at toes and fingers, which stay straight."""
    anny = model._anny
    pose = random_poses(3, size=0.4).double()
    for name in ("left_foot", "right_foot", "left_hand", "right_hand"):
        pose[:, INDEX[name]] = 0
    shift = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [0.0, 1.0, 0.0]], dtype=torch.float64)
    rest = anny(pose_parameters=None)
    G = (
        skeleton.chained_rotations(pose)
        @ skeleton.chained_rotations(standard.rest_pose.double()).mT
    )
    R = rest["rest_bone_poses"][0]
    turned = torch.eye(4, dtype=torch.float64).repeat(3, len(R), 1, 1)
    turned[..., :3, :3] = G[:, model.joint_of_bone()] @ R[:, :3, :3]
    turned[:, 0, :3, 3] = R[0, :3, 3] + shift
    theirs = anny(pose_parameters=turned, pose_parameterization="world-orient")["vertices"]
    A = skinning.transforms(standard, pose.float(), shift.float())
    ours = skinning.skin(standard.vertices, standard.blend_weights, A)
    kept = (torch.cdist(standard.vertices[::7].double(), rest["rest_vertices"][0])).argmin(1)
    assert (ours[:, ::7].double() - theirs[:, kept]).norm(dim=-1).max() < 1e-4


def test_shapes(model):
    rng = np.random.default_rng(3)
    shapes = [model.random_shape(rng) for _ in range(20)]
    tall = [float(np.ptp(model.body(shape).vertices[:, 2].numpy())) for shape in shapes]
    assert 1.35 < min(tall) < 1.6 < 1.75 < max(tall) < 2.0
    assert torch.equal(model.random_shape(np.random.default_rng(3)), shapes[0])
    heavy, light = (model.body((0.5, 0.5, 0.5, w, 0.5, 0.5)) for w in (0.8, 0.2))
    inside = lambda b: torch.linalg.det(b.vertices.double()[b.faces]).sum() / 6
    assert inside(heavy) > 1.1 * inside(light)
    with pytest.raises(InputError, match="weight = 1.4; phenotypes go from 0 to 1"):
        model.body((0.5, 0.5, 0.5, 1.4, 0.5, 0.5))
    with pytest.raises(InputError, match=r"\(6,\) is needed: gender"):
        model.body((0.5, 0.5))
    with pytest.raises(InputError, match="not finite"):
        model.body((0.5, 0.5, float("nan"), 0.4, 0.5, 0.5))


def test_making_a_body_says_nothing_and_compiles_nothing():
    code = (
        "import sys; from onefit.body import AnnyBody; AnnyBody().body(); print([m for m in"
        " ('warp', 'mitsuba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("[]\n", "")


# --- skinning -------------------------------------------------------------------------------------


def test_skinning_against_one_point_after_the_other(standard):
    pose, shift = random_poses(2, seed=1), torch.randn(2, 3)
    A = skinning.transforms(standard, pose, shift)
    some = torch.arange(0, 13348, 1500)
    P, W = standard.vertices[some], standard.blend_weights[some]
    moving = torch.stack([P, P + 0.01])
    for points, each in ((P, torch.stack([P, P])), (moving, moving)):
        skinned = skinning.skin(points, W, A)
        for t in range(2):
            for n in range(len(some)):
                slow = sum(
                    W[n, j] * (A[t, j, :, :3] @ each[t, n] + A[t, j, :, 3]) for j in range(24)
                )
                assert torch.allclose(skinned[t, n], slow, atol=1e-5)


def test_joints_turn_about_their_own_places_and_keep_bone_lengths(standard):
    pose, shift = random_poses(4, seed=2, size=1.0), torch.randn(4, 3)
    A = skinning.transforms(standard, pose, shift)
    J = skinning.posed_joints(standard, A)
    assert torch.allclose(J[:, 0], standard.joints[0] + shift, atol=1e-5)
    for j, p in enumerate(skeleton.PARENTS):
        if p >= 0:
            assert torch.allclose(
                (J[:, j] - J[:, p]).norm(dim=-1),
                (standard.joints[j] - standard.joints[p]).norm().expand(4),
                atol=1e-5,
            )
            by_parent = (A[:, p, :, :3] @ standard.joints[j]) + A[:, p, :, 3]
            assert torch.allclose(
                by_parent, J[:, j], atol=1e-5
            )  # parent and child agree where the joint is
    R = A[..., :3]
    assert torch.allclose(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-5)
    at_t = places(standard)
    direct = skinning.joint_places(
        torch.as_tensor(np.stack([at_t[n] for n in skeleton.JOINTS])), pose.double(), shift.double()
    )
    assert torch.allclose(direct.float(), J, atol=1e-5)


def test_gradients_of_skinning(standard):
    some = torch.arange(0, 13348, 4000)
    body = standard
    P, W = body.vertices[some].double(), body.blend_weights[some].double()

    def moved(pose, shift, points):
        return skinning.skin(points, W, skinning.transforms(body, pose, shift))

    pose = random_poses(1, seed=5).double().requires_grad_()
    assert torch.autograd.gradcheck(
        moved,
        (pose, torch.randn(1, 3, dtype=torch.float64).requires_grad_(), P.requires_grad_()),
        atol=1e-6,
    )
    still = torch.zeros(
        1, 24, 3, dtype=torch.float64, requires_grad=True
    )  # no singularity at the T-pose
    assert torch.isfinite(
        torch.autograd.grad(moved(still, torch.zeros(1, 3, dtype=torch.float64), P).sum(), still)[0]
    ).all()


# --- bodies from files ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def smpl(standard):
    """A model file's contents in SMPL's keys and axes, made of the standard body in the T-pose;
    beta 0 scales it, beta 1 widens it.
    """
    A = skinning.transforms(standard, torch.zeros(1, 24, 3), torch.zeros(1, 3))
    turn = FROM_SMPL.double().numpy()
    V = skinning.skin(standard.vertices, standard.blend_weights, A)[0].double().numpy() @ turn
    J = skinning.posed_joints(standard, A)[0].double().numpy() @ turn
    regressor = np.linalg.lstsq(
        np.concatenate([V, np.ones((len(V), 1))], 1).T,
        np.concatenate([J, np.ones((24, 1))], 1).T,
        rcond=None,
    )[0].T
    parents = np.array(skeleton.PARENTS, dtype=np.int64)
    parents[0] = 2**32 - 1
    shapedirs = np.stack([0.05 * V, 0.05 * V * [1, 0, 0]], -1)
    return {
        "v_template": V, "f": standard.faces.numpy().astype(np.uint32),
        "weights": standard.blend_weights.double().numpy(), "J_regressor": regressor,
        "kintree_table": np.stack([parents.astype(np.uint32), np.arange(24, dtype=np.uint32)]),
        "shapedirs": shapedirs,
    }  # fmt: skip


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
    ],
)
def test_smpl_files_that_cannot_be_used(smpl, tmp_path, change, message):
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
    with pytest.raises(InputError, match="cannot be read"):
        PlainBody(tmp_path / "body.npz")
    with pytest.raises(InputError, match="no such file"):
        PlainBody(tmp_path / "none.npz")
    with pytest.raises(InputError, match="read from .npz or .pkl"):
        PlainBody(tmp_path / "body.obj")
