"""Bodies: Anny reduced to 24 joints, models of the SMPL family, plain files, and skinning."""

import numpy as np
import pytest
import torch
from standing import random_poses

from onefit.body import skeleton, skinning
from onefit.body.skeleton import INDEX
from polyfit.errors import InputError
from polyfit.mesh import edges_of, read_mesh

HEAD, FRONT = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)


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
    for wrong in ({"weight": 0.7}, "tall", [0.5, "tall"]):
        with pytest.raises(InputError, match=r"a shape of type .*; \(6,\) is needed: gender"):
            model.body(wrong)
    with pytest.raises(InputError, match="not finite"):
        model.body((0.5, 0.5, float("nan"), 0.4, 0.5, 0.5))


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
