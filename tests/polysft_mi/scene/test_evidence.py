"""Files of tracks and depth images, in the forms that other programs write."""

import dataclasses
import zipfile

import cv2
import numpy as np
import OpenEXR
import pytest

from polysft_mi.errors import InputError
from polysft_mi.scene.evidence import DepthImages, Tracks

FRAMES, POINTS = 5, 3


@pytest.fixture
def known(rng):
    """(positions (T, P, 2), visible (T, P))."""
    visible = np.ones((FRAMES, POINTS), bool)
    visible[2:, 1] = visible[0, 2] = False
    return np.random.default_rng(0).uniform(0, 90, (FRAMES, POINTS, 2)), visible


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def read(path, centre=0.5, selected=range(FRAMES), **arrays):
    np.savez(path, **arrays)
    return Tracks.read(path, FRAMES, list(selected), centre)


def same(a, b):
    return all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
    )


def test_files_of_trackers_say_the_same(known, tmp_path):
    """CoTracker has a batch, TAPIR points first and what is hidden, others a likelihood."""
    positions, visible = known
    path = tmp_path / "tracks.npz"
    plain = read(path, tracks=positions, visible=visible)
    assert np.array_equal(plain.positions[visible], positions[visible])
    assert np.array_equal(plain.visible, visible)
    assert plain.query.tolist() == [0, 0, 1]
    others = (
        {"pred_tracks": positions[None], "pred_visibility": visible[None, ..., None]},
        {"tracks": positions.swapaxes(0, 1), "occluded": ~visible.T},
        {"trajs": positions, "visibility": np.where(visible, 0.9, 0.2)},
        {"tracks": np.where(visible[..., None], positions, np.nan)},
        {"tracks": np.where(visible[..., None], positions, 1e300)},
    )
    for arrays in others:
        assert same(read(path, **arrays), plain), list(arrays)
    np.save(tmp_path / "tracks.npy", np.where(visible[..., None], positions, np.nan))
    assert same(Tracks.read(tmp_path / "tracks.npy", FRAMES, list(range(FRAMES))), plain)


def test_points_and_frames_that_are_as_many_are_told_apart(tmp_path):
    """By the queries, or by TAPIR's names; else frames come first."""
    rng, path = np.random.default_rng(1), tmp_path / "t.npz"
    whole, some = rng.uniform(0, 90, (FRAMES, 3, 2)), rng.random((FRAMES, 3)) < 0.7
    some[0] = True  # so that each of them begins in the first frame
    used, queries = [0, 2, 4], np.zeros((3, 3))
    plain = read(path, selected=used, tracks=whole, visible=some)
    turned = {"tracks": whole.swapaxes(0, 1), "visible": some.T}
    assert same(read(path, selected=used, queries=queries, **turned), plain)
    tapir = {"tracks": turned["tracks"], "visibles": some.T}
    assert same(read(path, selected=used, **tapir), plain)
    square, seen = rng.uniform(0, 90, (FRAMES, FRAMES, 2)), rng.random((FRAMES, FRAMES)) < 0.7
    plain = read(path, tracks=square, visible=seen)
    assert np.array_equal(plain.positions[plain.visible], square[seen])
    assert same(read(path, tracks=square.swapaxes(0, 1), occluded=~seen.T), plain)


def test_visibilities_may_be_logits(known, tmp_path):
    positions, visible = known
    plain = read(tmp_path / "t.npz", tracks=positions, visible=visible)
    for low, high in ((-4.0, 0.3), (0, 255), (-1e-4, 1.001)):
        given = {"tracks": positions, "visibility": np.where(visible, high, low)}
        assert same(read(tmp_path / "t.npz", **given), plain), (low, high)
    given = {"tracks": positions, "occlusion": np.where(visible, -0.3, 4.0)}
    assert same(read(tmp_path / "t.npz", **given), plain)
    one = {"tracks": positions[:, :1], "visibility": visible[None, :, :1]}
    assert same(read(tmp_path / "t.npz", **one), read(tmp_path / "t.npz", tracks=positions[:, :1]))


def test_a_pixels_centre_may_be_at_zero(known, tmp_path):
    positions, visible = known
    found = read(tmp_path / "t.npz", 0.0, tracks=positions, visible=visible)
    assert np.allclose(found.positions[visible], positions[visible] + 0.5)


def test_a_track_counts_from_its_query_on(known, tmp_path):
    positions, _ = known
    queries = np.column_stack([[0, 3, 4], positions[[0, 3, 4], range(POINTS)]])
    given = {"tracks": positions, "queries": queries}
    assert read(tmp_path / "t.npz", **given).query.tolist() == [0, 3, 4]
    found = read(tmp_path / "t.npz", selected=[0, 2, 4], **given)
    assert found.query.tolist() == [0, 2, 2]  # counted in the selection
    assert np.array_equal(found.positions, positions[[0, 2, 4]])
    part = Tracks.read(_saved(tmp_path, tracks=positions[:3]), FRAMES, [0, 2, 4])
    assert np.array_equal(part.positions, positions[:3])  # of the frames that are used alone


def _saved(folder, **arrays):
    np.savez(folder / "part.npz", **arrays)
    return folder / "part.npz"


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"a": np.zeros(3)}, "an array 'tracks' .* the file has a"),
        ({"tracks": np.zeros((4, 3, 2))}, "tracks is .4, 3, 2.; 5 frames"),
        ({"tracks": np.zeros((5, 3, 3))}, "x and y"),
        ({"tracks": np.zeros((5, 0, 2))}, "at least one point"),
        ({"tracks": np.zeros((5, 3, 2)), "visible": np.ones((5, 4))}, "visible is .5, 4."),
        ({"tracks": np.full((5, 3, 2), np.nan)}, "no point is seen in any frame"),
        ({"tracks": np.full((5, 3, 2), 1e300)}, "no point is seen in any frame"),
        ({"tracks": np.zeros((5, 3, 2)), "visible": np.zeros((5, 3))}, "no point is seen"),
        ({"tracks": np.zeros((5, 3, 2)), "queries": np.zeros((2, 3))}, "queries is .2, 3."),
        (
            {"tracks": np.zeros((5, 3, 2)), "queries": np.full((3, 3), 7.0)},
            "queries names frames that are not among 0 to 4",
        ),
    ],
)
def test_what_is_no_file_of_tracks_is_told(arrays, said, tmp_path):
    with pytest.raises(InputError, match=said):
        read(tmp_path / "t.npz", **arrays)


def test_a_file_that_is_none_is_told(tmp_path):
    with pytest.raises(InputError, match="no such file of tracks"):
        Tracks.read(tmp_path / "none.npz", 1, [0])
    with zipfile.ZipFile(tmp_path / "tracks.pt", "w") as file:  # as torch.save writes it
        file.writestr("tracks/data.pkl", b"")
        file.writestr("tracks/data/0", b"")
    with pytest.raises(InputError, match=r"tracks.pt: a file of torch; save it as \.npz"):
        Tracks.read(tmp_path / "tracks.pt", 1, [0])
    rows = np.random.default_rng(0).normal(size=(9, 40, 2))
    np.savez_compressed(tmp_path / "damaged.npz", tracks=rows)
    whole = (tmp_path / "damaged.npz").read_bytes()
    (tmp_path / "damaged.npz").write_bytes(whole[:70] + b"\xff" * 250 + whole[320:])
    with pytest.raises(InputError, match="damaged.npz: not a file of tracks"):
        Tracks.read(tmp_path / "damaged.npz", 9, list(range(9)))
    (tmp_path / "text.npz").write_text("tracks")
    with pytest.raises(InputError, match="not a file of tracks"):
        Tracks.read(tmp_path / "text.npz", 1, [0])


def test_depth_is_read_in_metres(tmp_path):
    depth = np.array([[0, 500], [1500, 65535]], np.uint16)
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"{k}.png"), depth)
    images = DepthImages.open(str(tmp_path), 2, [1], 1e-3)
    assert np.allclose(images.read(0), [[0, 0.5], [1.5, 65.535]])
    assert np.allclose(DepthImages.open(str(tmp_path), 2, [0], 2e-4).read(0)[0, 1], 0.1)
    floats = tmp_path / "floats"
    floats.mkdir()
    cv2.imwrite(str(floats / "0.tiff"), np.array([[0.7, np.nan], [-1, np.inf]], np.float32))
    found = DepthImages.open(str(floats), 1, [0], 1e-3).read(0)
    assert np.allclose(found, [[0.7, 0], [0, 0]])


def test_depth_beside_colours_is_found(tmp_path):
    """As renderers write it; their colours were taken for it."""
    depth, colours = np.float32([[0.5, 0.6]]), dict(zip("RGB", np.float32([[[0.1, 1]]] * 3)))
    colours["G"] = 2 * colours["R"]
    layers = {f"ViewLayer.Combined.{name}": plane for name, plane in colours.items()}
    call = lambda: DepthImages.open(str(tmp_path), 1, [0], 1e-3)

    def write(planes):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, planes) as file:
            file.write(str(tmp_path / "0.exr"))

    for planes in (
        {"Z": depth, "ZBack": 2 * depth, **colours},
        {"ViewLayer.Depth.Z": depth, "ViewLayer.Normal.Z": 0 * depth, **layers},
        {"depth": depth.astype(np.float16)},
        dict.fromkeys("RGB", depth),
    ):
        write(planes)
        assert np.allclose(call().read(0), depth, atol=1e-3)
    for planes, said in (colours, "its channels differ"), (layers, "Z, or one called depth"):
        write(planes)
        with pytest.raises(InputError, match=said):
            call()


def test_every_depth_image_is_read(tmp_path):
    """So that a bad one is known before the work starts; of those that are used."""
    good = np.full((6, 8), 500, np.uint16)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), good)
    call = lambda: DepthImages.open(str(tmp_path), 3, [0, 2], 1e-3)
    assert len(call().files) == 2
    for pixels, said in (
        (np.zeros((6, 6), np.uint16), "2.png: 6x6 pixels; .*0.png has 8x6"),
        (good.astype(np.uint8), "2.png: 8 bits"),
    ):
        cv2.imwrite(str(tmp_path / "2.png"), pixels)
        with pytest.raises(InputError, match=said):
            call()
    cv2.imwrite(str(tmp_path / "2.png"), good)
    (tmp_path / "2.png").write_bytes((tmp_path / "2.png").read_bytes()[:60])
    with pytest.raises(InputError, match="2.png: not a readable image"):
        call()
    cv2.imwrite(str(tmp_path / "2.png"), good)
    cv2.imwrite(str(tmp_path / "0.png"), 0 * good)  # a sensor that starts dark
    assert not call().read(0).any()


def test_depth_that_says_nothing_is_told(tmp_path):
    for name, pixels, said in (
        ("empty", np.zeros((2, 2), np.uint16), "every pixel is 0"),
        ("bytes", np.ones((2, 2), np.uint8), "8 bits"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        cv2.imwrite(str(folder / "0.png"), pixels)
        with pytest.raises(InputError, match=said):
            DepthImages.open(str(folder), 1, [0], 1e-3)
    with pytest.raises(InputError, match="0.png: 8 bits; they are too coarse"):
        DepthImages.open(str(tmp_path / "bytes"), 1, [0], 1e-3, "disparity")
    with pytest.raises(InputError, match="1 depth images for 3 or 2 frames"):
        DepthImages.open(str(tmp_path / "empty"), 3, [0, 1], 1e-3)
