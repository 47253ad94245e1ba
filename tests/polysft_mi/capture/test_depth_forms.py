"""Depth as recording programs leave it: found, read in metres, and brought to the camera of the
frames.
"""

import json

import numpy as np
import OpenEXR
import pytest
import synthetic
from clips import refused, write_png

from polysft_mi import prepare
from polysft_mi.camera import Intrinsics
from polysft_mi.capture import GivenEvidence
from polysft_mi.capture.camera import Lens, Undistortion
from polysft_mi.capture.depth import recognise_depth
from polysft_mi.scene import DepthImages

COLOUR = Intrinsics(110.4, 110.4, 48.75, 35.5, 96, 72)  # that of synthetic.cloth
DEEP = Intrinsics(70.0, 72.0, 35.0, 26.0, 68, 54)  # wider, of another shape


def plane(camera, k=0):
    """Depth (H, W) [m] of a slanted plane."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return (0.8 + 0.1 * k) / (1 + 0.2 * x - 0.3 * y[:, None])


def scannet(folder, camera=DEEP, count=2, half=0.5):
    for k in range(count):
        depth = np.round(1000 * plane(camera, k)).astype(np.uint16)
        write_png(folder / "depth" / f"{k}.png", depth)
        write_png(
            folder / "color" / f"{k}.png", np.zeros((COLOUR.height, COLOUR.width, 3), np.uint8)
        )
    (folder / "intrinsic").mkdir()
    for of, c in (("depth", camera), ("color", COLOUR)):
        K = np.eye(4)
        K[:3, :3] = c.matrix()
        K[:2, 2] -= half
        np.savetxt(folder / "intrinsic" / f"intrinsic_{of}.txt", K)
        np.savetxt(folder / "intrinsic" / f"extrinsic_{of}.txt", np.eye(4))
    return folder


def written(folder, depth, count=2, lens=None, unit=1e-3):
    """What is written of the depth images, read back; and the lines."""
    straight = Undistortion(lens or Lens(COLOUR))
    evidence = GivenEvidence(depth=str(depth), depth_unit=unit)
    for k in range(count):
        write_png(folder / "frames" / f"{k}.png", np.zeros((COLOUR.height, COLOUR.width), np.uint8))
    evidence.open(str(folder / "frames"), (COLOUR.width, COLOUR.height))
    settings, lines = evidence.write(str(folder), list(range(count)), straight)
    images = DepthImages.open(str(folder / settings["depth"]), count, list(range(count)), 1e-4)
    return np.stack([images.read(k) for k in range(count)]), lines


def test_depth_of_another_camera_is_brought_to_that_of_the_frames(tmp_path):
    source = scannet(tmp_path / "scan")
    for k, path in enumerate((source, source / "depth")):
        (tmp_path / f"out{k}").mkdir()
        found, lines = written(tmp_path / f"out{k}", path)
        assert "ScanNet, as the frames' camera sees it" in lines[0]
        assert found.shape == (2, 72, 96)
        inside = found > 0
        assert inside.mean() > 0.9  # all that the wider camera sees
        for t in range(2):
            off = np.abs(found[t] - plane(COLOUR, t))[inside[t]]
            assert off.max() < 0.006 and off.mean() < 0.0025  # a pixel of it, and a millimetre
    # half the depth image: what is beyond is unknown
    c = DEEP
    narrow = Intrinsics(c.fx, c.fy, 0.0, c.cy, c.width, c.height)
    (tmp_path / "out").mkdir()
    found, _ = written(tmp_path / "out", scannet(tmp_path / "half", narrow))
    assert (found[:, :, :48] == 0).all() and (found[:, :, 50:] > 0).mean() > 0.9
    # a lens's distortion is none of the depth camera's
    (tmp_path / "bent").mkdir()
    bent, _ = written(tmp_path / "bent", source, lens=Lens(COLOUR, (-0.3, 0, 0, 0)))
    np.testing.assert_array_equal(bent, found_of(tmp_path / "out0"))


def found_of(folder):
    images = DepthImages.open(str(folder / "depth"), 2, [0, 1], 1e-4)
    return np.stack([images.read(k) for k in range(2)])


def test_a_scene_is_prepared_with_it(tmp_path, capsys):
    source = scannet(tmp_path / "scan")
    folder = synthetic.cloth(tmp_path / "data", frames=2).folder
    words = [str(folder), "--depth", str(source)]
    prepare.main(words)
    text = (folder / "scene.xml").read_text()
    assert '<default name="depth" value="depth"/>' in text
    assert '<default name="depth_unit" value="0.0001"/>' in text
    found = found_of(folder)[1]
    assert (found > 0).mean() > 0.9
    assert np.abs(found - plane(COLOUR, 1))[found > 0].max() < 0.006
    assert "--overwrite" in refused(prepare.main, words)
    prepare.main([*words, "--overwrite"])
    assert len(list((folder / "depth").iterdir())) == 2
    (folder / "depth" / "mine.txt").write_text("")
    assert "not written by this" in refused(prepare.main, [*words, "--overwrite"])
    # of the camera of the frames, it stays where it is
    alike = Intrinsics(*(x / 2 for x in (110.4, 110.4, 48.75, 35.5)), 48, 36)
    same = scannet(tmp_path / "same", alike)
    words_of_same = [str(folder), "--depth", str(same), "--overwrite"]
    assert "must be wrong (0.00063 would fit)" in refused(prepare.main, words_of_same)
    for path in (same / "depth").iterdir():
        write_png(path, np.full((36, 48), 500, np.uint16))  # where the template is
    prepare.main(words_of_same)
    text = (folder / "scene.xml").read_text()
    assert f'<default name="depth" value="{same / "depth"}"/>' in text
    assert '<default name="depth_unit" value="0.001"/>' in text
    np.savetxt(source / "intrinsic" / "extrinsic_depth.txt", np.eye(4) + 0.02)
    assert "stands elsewhere" in refused(prepare.main, [*words, "--overwrite"])
    np.savetxt(source / "intrinsic" / "extrinsic_depth.txt", np.eye(3))
    assert "4 x 4 is needed" in refused(prepare.main, [*words, "--overwrite"])


def exr(path, depth):
    path.parent.mkdir(exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"R": depth.astype(np.float32)}).write(str(path))


def test_depth_of_which_nothing_would_be_left_is_refused(tmp_path):
    """The likely unit is named."""
    for k in range(2):
        exr(tmp_path / "mm" / f"{k}.exr", 1000 * plane(COLOUR, k))
        write_png(tmp_path / "png" / f"{k}.png", np.full((72, 96), 800, np.uint16))
    (tmp_path / "out").mkdir()
    said = refused(written, tmp_path / "out", tmp_path / "mm")
    assert (
        "0.exr: 8" in said and "in units of 0.001 m; EXR, TIFF and CSV are read in metres" in said
    )
    for unit in (1.0, 1e-8):
        said = refused(written, tmp_path / "out", tmp_path / "png", unit=unit)
        assert "800 is likely in units of 0.001 m; --depth-unit says the unit" in said
    assert not (tmp_path / "out" / "depth").exists()
    assert written(tmp_path / "out", tmp_path / "png")[0].max() == pytest.approx(0.8)
    folder = synthetic.cloth(tmp_path / "data", frames=2).folder
    words = [str(folder), "--depth", str(scannet(tmp_path / "scan")), "--depth-unit", "1"]
    assert "in units of 0.001 m" in refused(prepare.main, words)
    assert not (folder / "depth").exists() and not (folder / "scene.xml").exists()


def test_depth_of_another_shape_is_refused_before_the_work(tmp_path):
    """Of a folder and of a video."""
    for k in range(2):
        write_png(tmp_path / "square" / f"{k}.png", np.full((72, 72), 600, np.uint16))
    (tmp_path / "out").mkdir()
    said = "0.png: 72x72 pixels are not of the shape of the frames, 96x72"
    assert said in refused(written, tmp_path / "out", tmp_path / "square")
    folder = synthetic.cloth(tmp_path / "data", frames=2).folder
    words = [str(folder), "--depth", str(tmp_path / "square"), "--depth-known-to", "affine"]
    assert said in refused(prepare.main, words)
    assert not (folder / "scene.xml").exists()


def test_record3d(tmp_path):
    """Its depth has fewer pixels; its K, column by column, is that of the colour images."""
    c = COLOUR
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
    small = Intrinsics(*(x / 4 for x in (c.fx, c.fy, c.cx, c.cy)), 24, 18)
    for k in range(2):
        depth = plane(small, k).astype(np.float32)
        depth[0, 0] = np.nan
        exr(tmp_path / "depth" / f"{k}.exr", depth)
    (tmp_path / "metadata.json").write_text(json.dumps({"K": K, "w": 96, "h": 72, "fps": 60}))
    (tmp_path / "out").mkdir()
    found, lines = written(tmp_path / "out", tmp_path)
    assert "Record3D" in lines[0]
    assert (found[:, :4, :4] == 0).all()
    assert np.abs(found[1, 8:] - plane(COLOUR, 1)[8:]).max() < 0.02
    lens = GivenEvidence(depth=str(tmp_path)).lens(48, 36)
    assert (lens.camera.fx, lens.camera.cy) == pytest.approx((55.2, 17.75))
    # without what Record3D writes it is a folder as any
    (tmp_path / "metadata.json").write_text(json.dumps({"title": "mine"}))
    assert recognise_depth(str(tmp_path / "depth")).form == ""
    assert GivenEvidence(depth=str(tmp_path / "depth")).lens(48, 36) is None
    for broken in ({"title": "mine"}, {"K": K[:3], "w": 96, "h": 72}):
        (tmp_path / "metadata.json").write_text(json.dumps(broken))
        said = refused(recognise_depth, str(tmp_path))
        assert (
            "metadata.json with K, w and h (Record3D)" in said and f"{tmp_path / 'depth'}" in said
        )
    assert "EXR + RGB" in refused(recognise_depth, str(tmp_path / "a.r3d"))
    (tmp_path / "a.sens").write_bytes(b"")
    said = refused(recognise_depth, str(tmp_path / "a.sens"))
    assert "a folder of depth images, one a frame, is needed, as ScanNet's SensReader" in said
    write_png(tmp_path / "raw" / "rgbd" / "0.png", np.zeros((4, 4), np.uint8))
    (tmp_path / "raw" / "rgbd" / "0.depth").write_bytes(b"bvx2")
    assert "EXR + RGB" in refused(recognise_depth, str(tmp_path / "raw"))


def test_realsense(tmp_path):
    """What rs-convert writes, in the order of its times, which have as many digits as there are."""
    times = [f"{t:.14f}" for t in (999.5, 1000.25)]
    for k, time in enumerate(times):
        depth = plane(COLOUR, k).round(3)
        depth[:, :5] = 0
        rows = [",".join(map(str, row)) for row in depth]
        (tmp_path / f"a_Depth_{time}.csv").write_text("\n".join(rows) + "\n")
        (tmp_path / f"a_Depth_metadata_{time}.txt").write_text("Stream: Depth\n")
        (tmp_path / f"a_Color_{time}.csv").write_text("1,2,3\n")
    (tmp_path / "out").mkdir()
    found, lines = written(tmp_path / "out", tmp_path)
    assert "RealSense" in lines[0] and "left infrared camera" in lines[1]
    assert (found[:, :, :5] == 0).all()
    for k in range(2):
        assert np.abs(found[k, :, 5:] - plane(COLOUR, k)[:, 5:]).max() < 0.0006
    pattern = str(tmp_path / "*_Depth_[0-9]*.csv")
    assert len(DepthImages.open(pattern, 2, [0, 1], 1e-3).files) == 2  # a run reads them, too
    (tmp_path / f"a_Depth_{times[1]}.csv").write_text("far,away\n")
    assert "not a table of depth" in refused(written, tmp_path / "out", tmp_path)
    deep, painted = tmp_path / "deep", tmp_path / "painted"
    for k, time in enumerate(times):
        whole = np.round(4000 * plane(COLOUR, k)).astype(np.uint16)
        write_png(deep / f"b_Depth_{time}.png", whole)
        write_png(deep / f"b_Color_{time}.png", np.zeros((72, 96, 3), np.uint8))
        write_png(painted / f"b_Depth_{time}.png", np.zeros((72, 96, 3), np.uint8))
    (tmp_path / "out2").mkdir()
    found, _ = written(tmp_path / "out2", deep, unit=0.25e-3)
    assert np.abs(found[1] - plane(COLOUR, 1)).max() < 0.0003
    assert "rs-convert -v" in refused(recognise_depth, str(painted))
