"""Motions with mistaken units or axes: put right where the file says how, else one line. And
unusual ones that are right.
"""

import codecs

import numpy as np
import pytest
import torch
from motions import FROM_SMPL, KINDS, places
from scipy.spatial.transform import Rotation
from test_bvh import write_bvh

from onefit.body import skeleton
from onefit.body.skeleton import INDEX
from onefit.motion import Motion
from polyfit.errors import InputError

HEAD, FEET = INDEX["head"], [INDEX["left_foot"], INDEX["right_foot"]]


def walk(seconds=2.0):
    motion = Motion.generate("walk", seconds=seconds, seed=3)
    motion.poses[:, 22:] = 0
    return motion


def smpl(motion, up="z"):
    """The arrays ``poses`` (T, 72), ``trans`` (T, 3) of a motion in SMPL's axes and a world with
    the axis ``up``.
    """
    world = Rotation.identity() if up == "z" else FROM_SMPL.inv()
    local = FROM_SMPL.inv().apply(motion.poses.double().reshape(-1, 3)).reshape(-1, 24, 3)
    root = world * Rotation.from_rotvec(motion.poses[:, 0].double().numpy()) * FROM_SMPL
    local[:, 0] = root.as_rotvec()
    return {"poses": local.reshape(-1, 72), "trans": world.apply(motion.translation.numpy())}


def saved(path, arrays, **more):
    np.savez(path, **(arrays | more))
    return path


def refused(path, **options):
    with pytest.raises(InputError) as error:
        Motion.read(path, **options)
    assert "\n" not in str(error.value) and path.name in str(error.value)
    return str(error.value)


def same(motion, wanted):
    """Whether joints are at the same places, moved as a whole."""
    a, b = places(motion), places(wanted)
    return np.abs((a - a[:1, :1]) - (b - b[:1, :1])).max() < 2e-4


@pytest.mark.parametrize("kind", KINDS)
def test_every_motion_of_ours_passes(kind, tmp_path):
    motion = Motion.generate(kind, seconds=3.0, seed=1)
    motion.poses[:, 22:] = 0
    path = saved(tmp_path / "m.npz", smpl(motion), mocap_framerate=30)
    assert same(Motion.read(path), motion)


# --- units ----------------------------------------------------------------------------------------


def test_degrees_are_refused(tmp_path):
    arrays = smpl(walk())
    arrays["poses"] = np.degrees(arrays["poses"])
    said = refused(saved(tmp_path / "m.npz", arrays, mocap_framerate=30))
    assert "radians below 2π are needed: in degrees? then multiply poses by π/180" in said


@pytest.mark.parametrize("factor", [100, 1000])
def test_a_translation_in_centimetres_is_refused(factor, tmp_path):
    slow = walk(4.0)
    slow = Motion(slow.poses, slow.translation, 15.0)  # at half the speed
    assert same(Motion.read(saved(tmp_path / "m.npz", smpl(slow), mocap_framerate=15)), slow)
    arrays = smpl(slow)
    arrays["trans"] = arrays["trans"] * factor
    said = refused(saved(tmp_path / "cm.npz", arrays, mocap_framerate=15))
    assert "in centimetres?" in said and ("feet slide at" in said or "root moves at" in said)


@pytest.mark.parametrize("rate", [0.03, 0.5, 1001, 30_000, np.inf])
def test_rates_that_no_file_has_are_refused(rate, tmp_path):
    path = saved(tmp_path / "m.npz", smpl(walk()), mocap_framerate=rate)
    assert "frames a second; 1 to 1000 can be used: fps=30, or --fps 30" in refused(path)
    assert Motion.read(path, fps=30).fps == 30
    assert "1 to 1000 can be used" in refused(path, fps=rate)


def test_frame_times_in_milliseconds_or_that_are_rates_are_refused(tmp_path):
    write_bvh(tmp_path / "m.bvh", walk(), "mixamo", frame_time=33.3333)
    said = refused(tmp_path / "m.bvh")
    assert "a frame time of 33.3333 s" in said and "in milliseconds? then give --fps 30;" in said
    write_bvh(tmp_path / "m.bvh", walk(), "mixamo", frame_time=120.0)
    assert "a rate? then --fps 120;" in refused(tmp_path / "m.bvh")
    assert Motion.read(tmp_path / "m.bvh", fps=120).fps == 120
    for frame_time in (1.0, 0.001):
        write_bvh(tmp_path / "m.bvh", walk()[:1], "mixamo", frame_time=frame_time)
        assert Motion.read(tmp_path / "m.bvh").fps == pytest.approx(1 / frame_time)


def test_one_frame_more_than_announced_is_read(tmp_path):
    motion = walk()
    write_bvh(tmp_path / "m.bvh", motion, "mixamo")
    text = (tmp_path / "m.bvh").read_text()
    assert f"Frames: {len(motion)}\n" in text
    (tmp_path / "n.bvh").write_text(text.replace(f"Frames: {len(motion)}\n", "Frames: 59\n"))
    assert len(motion) == 60 and same(Motion.read(tmp_path / "n.bvh"), motion)
    for count in (58, 61):
        other = text.replace(f"Frames: {len(motion)}\n", f"Frames: {count}\n")
        (tmp_path / "n.bvh").write_text(other)
        assert f"{count} frames are announced, 60 are there" in refused(tmp_path / "n.bvh")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_bvh_in_other_encodings(encoding, tmp_path):
    write_bvh(tmp_path / "m.bvh", walk(), "mixamo")
    text = (tmp_path / "m.bvh").read_text()
    (tmp_path / "m.bvh").write_bytes(text.encode(encoding))
    assert (tmp_path / "m.bvh").read_bytes()[:2] in (codecs.BOM_UTF8[:2], codecs.BOM_UTF16)
    assert same(Motion.read(tmp_path / "m.bvh"), walk())


# --- axes -----------------------------------------------------------------------------------------


def turned(motion, by):
    """The motion in a world that is turned."""
    root = by * Rotation.from_rotvec(motion.poses[:, 0].double().numpy())
    poses = motion.poses.clone()
    poses[:, 0] = torch.as_tensor(root.as_rotvec())
    rest = skeleton.standard_joints()[0].double().numpy()
    way = by.apply(motion.translation.double().numpy() + rest) - rest
    return Motion(poses, torch.as_tensor(way).float(), motion.fps)


def on_ground(motion):
    """The motion with its root as high over 0 as it is over the ground."""
    ground = places(motion)[:, FEET, 2].min()
    return Motion(motion.poses, motion.translation - torch.tensor([0, 0, ground]).float(), 30.0)


@pytest.mark.parametrize("degrees", [90, -90])
def test_bvh_whose_rest_has_another_axis_up_than_its_motion(degrees, tmp_path):
    """Turned upright by itself where the root is a leg's length over its ground, else refused with
    what helps.
    """
    motion = on_ground(walk())
    lying = turned(motion, Rotation.from_euler("x", degrees, degrees=True))
    write_bvh(tmp_path / "m.bvh", lying, "mixamo")
    read = Motion.read(tmp_path / "m.bvh")
    assert same(read, motion)
    low = Motion(lying.poses, lying.translation - lying.translation.mean(0), 30.0)
    write_bvh(tmp_path / "low.bvh", low, "mixamo")
    said = refused(tmp_path / "low.bvh")
    advice = "give up='z', or --motion-up z" if degrees == 90 else "turn it upright"
    assert f"with y up, its body lies down most of the time; {advice}, or up='y' if" in said
    lies = places(Motion.read(tmp_path / "low.bvh", up="y"))
    assert np.abs(lies[:, HEAD, 2] - lies[:, 0, 2]).max() < 0.3
    if degrees == 90:  # z of the file is up
        assert same(Motion.read(tmp_path / "low.bvh", up="z"), motion)
        assert same(Motion.read(tmp_path / "m.bvh", up="z"), motion)


def test_npz_with_another_axis_up_than_its_format(tmp_path):
    motion = on_ground(walk())
    arrays = smpl(motion, "z")
    path = saved(tmp_path / "m.npz", arrays, fps=30)  # y is up where the rate is called so
    assert same(Motion.read(path), motion)
    arrays["trans"] = arrays["trans"] - arrays["trans"].mean(0)
    path = saved(tmp_path / "low.npz", arrays, fps=30)
    assert "with y up, its body lies down most of the time; give up='z'" in refused(path)
    assert same(Motion.read(path, up="z"), motion)
    path = saved(tmp_path / "y.npz", smpl(motion, "y"), mocap_framerate=30)
    assert same(Motion.read(path), motion)


def test_a_body_on_its_head_is_refused(tmp_path):
    over = turned(walk(), Rotation.from_euler("x", 180, degrees=True))
    over = Motion(over.poses, over.translation - over.translation.mean(0), 30.0)
    path = saved(tmp_path / "m.npz", smpl(over), mocap_framerate=30)
    assert "its body stands on its head most of the time; turn the motion over" in refused(path)


def test_a_cartwheel_passes(tmp_path):
    """Two of them, one after the other, the body stiff, the hands and feet where they touch."""
    t = np.linspace(0, 1, 90)
    angle = 4 * np.pi * t
    poses = np.zeros((90, 24, 3))
    poses[:, INDEX["left_shoulder"], 1] = -1.2
    poses[:, INDEX["right_shoulder"], 1] = 1.2
    poses[:, 0] = Rotation.from_rotvec(angle[:, None] * [0, 1, 0]).as_rotvec()
    way = np.stack([4 * t, 0 * t, 0.1 * np.cos(2 * angle)], 1)
    motion = Motion(torch.tensor(poses).float(), torch.tensor(way).float(), 30.0)
    path = saved(tmp_path / "m.npz", smpl(motion), mocap_framerate=30)
    assert same(Motion.read(path), motion)
