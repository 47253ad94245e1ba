"""A garment is put on a body: SMPL's, whose motion is in SMPL's form and in a world with y up, and
one that is known as a mesh alone, as on the same body in OneFit's.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from standing import smpl_contents

from polyfit.mesh import edges_of
from polysft_mi.body import BodyMotion, put_on, read_motion
from polysft_mi.errors import InputError

onefit = pytest.importorskip("onefit")
torch = pytest.importorskip("torch")
skinning = pytest.importorskip("onefit.body.skinning")
C = Rotation.from_euler("x", 90, degrees=True)
FRAMES = 3


@pytest.fixture(scope="module")
def garment():
    return onefit.Garment.template("tank").remeshed(500)


@pytest.fixture(scope="module")
def motion():
    made = onefit.Motion.generate("walk", seconds=FRAMES / 30, seed=2)
    return made.poses.double().numpy(), made.translation.double().numpy()


@pytest.fixture(scope="module")
def smpl(tmp_path_factory):
    path = tmp_path_factory.mktemp("smpl") / "model.npz"
    np.savez(path, **smpl_contents(onefit.AnnyBody().body()))
    return str(path)


def as_smpl(motion, model):
    """The motion in SMPL's form, y up."""
    poses, translation = motion
    root = onefit.AnnyBody().body().joints[0].double().numpy()
    theirs = C.inv().apply(poses.reshape(-1, 3)).reshape(poses.shape)
    theirs[:, 0] = (C.inv() * Rotation.from_rotvec(poses[:, 0]) * C).as_rotvec()
    trans = C.inv().apply(translation + root) - onefit.SmplBody(model).root()
    return theirs, trans


def carrier_of(garment, path, *model, **arrays):
    np.savez(path, **arrays)
    motion = read_motion(path, FRAMES, list(range(FRAMES)), *model)
    return put_on(garment.vertices.double().numpy(), garment.faces.numpy(), motion)


def put(garment, path, *model, **arrays):
    carrier = carrier_of(garment, path, *model, **arrays)
    vertices = garment.vertices.double().numpy()
    return np.stack([carrier.maps(carrier.at(k))(vertices) for k in range(FRAMES)])


def test_a_motion_in_smpl_s_form_is_the_same_motion(garment, motion, smpl, tmp_path):
    ours = put(garment, tmp_path / "ours.npz", poses=motion[0], translation=motion[1])
    poses, trans = as_smpl(motion, smpl)
    given = dict(poses=poses.reshape(FRAMES, 72), trans=trans, betas=np.zeros((FRAMES, 10)))
    theirs = put(garment, tmp_path / "theirs.npz", smpl, "y", **given)
    away = np.linalg.norm(C.apply(theirs.reshape(-1, 3)).reshape(theirs.shape) - ours, axis=2)
    # up to what skinning there and back makes of the body, and the cloth of that
    assert np.median(away) < 4e-3 and away.max() < 0.03


def test_lengths_are_those_of_cloth_whatever_skinning_does(garment, motion, tmp_path):
    """Its weight stretches it by little; what carries it smooths its folds away."""
    poses, translation = motion
    carrier = carrier_of(garment, tmp_path / "motion.npz", poses=poses, translation=translation)
    vertices, (a, b) = garment.vertices.double().numpy(), edges_of(garment.faces.numpy())[0].T
    strain = carrier.lengths / np.linalg.norm(vertices[a] - vertices[b], axis=1) - 1
    assert carrier.lengths.shape == (FRAMES, len(a))
    assert np.abs(np.median(strain, axis=1)).max() < 0.001
    assert np.abs(strain).mean() < 0.005
    assert (carrier.length_errors >= 0).all() and carrier.length_errors.max() < 0.05


def test_on_the_moving_mesh_alone_it_lies_alike(garment, motion, tmp_path):
    """In a world with y up. Without network, joints, and yielding flesh the cloth is another."""
    ours = put(garment, tmp_path / "ours.npz", poses=motion[0], translation=motion[1])
    body = onefit.AnnyBody().body()
    known = [torch.as_tensor(x).float() for x in motion]
    transforms = skinning.transforms(body, *known)
    frames = skinning.skin(body.vertices, body.blend_weights, transforms).double().numpy()
    turned = lambda x: C.inv().apply(x.reshape(-1, 3)).reshape(x.shape)
    given = {"vertices": turned(frames), "rest": turned(body.vertices.double().numpy())}
    np.savez(tmp_path / "mesh.npz", **given, faces=body.faces.numpy(), fps=30)
    mesh = read_motion(tmp_path / "mesh.npz", FRAMES, list(range(FRAMES)), up="y")
    vertices, faces = turned(garment.vertices.double().numpy()), garment.faces.numpy()
    carrier = put_on(vertices, faces, mesh)
    for k in range(FRAMES):
        there = C.apply(carrier.maps(carrier.at(k))(vertices))
        away = np.linalg.norm(there - ours[k], axis=1)
        assert np.median(away) < 0.01 and away.max() < 0.05
        assert np.abs(carrier.body(carrier.at(k)) - mesh.frames[k]).max() < 1e-6
    with pytest.raises(InputError, match="from this body at rest in the mean"):
        put_on(vertices + (0, 0, 1.0), faces, mesh)


def test_a_template_that_is_not_on_the_body_is_told(garment, motion, tmp_path):
    """In words for who runs a scene."""
    np.savez(tmp_path / "body.npz", poses=motion[0], translation=motion[1])
    away = garment.vertices.double().numpy() - (0, 0, 1.2)
    known = read_motion(tmp_path / "body.npz", FRAMES, list(range(FRAMES)))
    with pytest.raises(InputError, match="body.npz: the template does not lie on the body") as told:
        put_on(away, garment.faces.numpy(), known)
    assert "onefit.align" in str(told.value)
    assert not any(word in str(told.value) for word in ("made_for", "offset"))


def test_a_translation_in_centimetres_is_told(garment, motion, tmp_path):
    with pytest.raises(InputError, match="body.npz: its (feet slide|root moves) at .*centimetres"):
        put(garment, tmp_path / "body.npz", poses=motion[0], translation=100 * motion[1])


def test_smpl_s_forms_say_the_same(motion, smpl, tmp_path):
    poses, trans = as_smpl(motion, smpl)
    read = lambda name: BodyMotion.read(tmp_path / name, FRAMES, [0, 1, 2], smpl, "y")
    np.savez(tmp_path / "a.npz", poses=poses, trans=trans, mocap_framerate=60.0)
    parts = dict(global_orient=poses[:, 0], body_pose=poses[:, 1:22].reshape(FRAMES, -1))
    np.savez(tmp_path / "b.npz", **parts, transl=trans, fps=60, betas=np.ones(4))
    hands = np.zeros((FRAMES, 33, 3))
    more = np.concatenate([poses[:, :22], hands], 1).reshape(FRAMES, 165)
    np.savez(tmp_path / "c.npz", poses=more, trans=trans, mocap_framerate=60.0)
    whole, in_parts, of_smplx = (read(name) for name in ("a.npz", "b.npz", "c.npz"))
    assert whole.fps == in_parts.fps == 60 and whole.shape is None
    assert in_parts.shape.tolist() == [1, 1, 1, 1] and whole.model == smpl
    assert in_parts.note == ""
    np.savez(tmp_path / "d.npz", poses=poses, trans=trans, betas=np.zeros(16))
    assert read("d.npz").note == ""
    np.savez(tmp_path / "e.npz", poses=poses, trans=trans, betas=np.ones((FRAMES, 16)))
    assert "e.npz: 16 betas; the first 10 of them count" in read("e.npz").note
    for other in (in_parts, of_smplx):
        assert np.allclose(other.poses[:, :22], whole.poses[:, :22])
        assert np.array_equal(other.translation, whole.translation)
    assert whole.upright.apply([0, 1, 0]) == pytest.approx([0, 0, 1])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((3, 69))}, "no translation"),
        ({"global_orient": np.zeros((2, 3)), "body_pose": np.zeros((3, 69))}, "a row of each"),
        ({"poses": np.zeros((3, 72)), "trans": np.zeros((3, 3)), "betas": np.float64(1)}, "betas"),
    ],
)
def test_what_is_no_motion_of_smpl_s_is_refused(arrays, message, tmp_path):
    np.savez(tmp_path / "motion.npz", **arrays)
    with pytest.raises(InputError, match=message):
        BodyMotion.read(tmp_path / "motion.npz", FRAMES, [0, 1, 2], "SMPL.pkl", "y")
