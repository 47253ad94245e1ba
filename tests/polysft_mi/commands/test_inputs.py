"""Bad input as a user meets it: one line that names the file, property or value and says what is
accepted, exit status 2, OUT untouched.
"""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
import trimesh
from places import ROOT

from polysft_mi import errors, prepare, run
from polysft_mi.pictures import exr
from polysft_mi.surface import meshio

SIZE = (48, 36)
QUICK = ["-q", "--exr", "2", "-D", "period=2", "-D", "last=1", "-D", "window=2"]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A sound sequence with its scene; not to be changed."""
    truth = synthetic.cloth(tmp_path_factory.mktemp("inputs") / "sheet", frames=3, size=SIZE)
    prepare.prepare(str(truth.folder))
    return truth


@pytest.fixture
def sheet(good, tmp_path):
    """A copy of it, to be spoilt."""
    folder = tmp_path / "sheet"
    shutil.copytree(good.folder, folder)
    return folder


@pytest.fixture(scope="module")
def finished(good, tmp_path_factory):
    """A small whole run; not to be changed."""
    out = tmp_path_factory.mktemp("finished") / "out"
    assert run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK]) == 0
    return out


def contents(out):
    return {p.relative_to(out): p.read_bytes() for p in sorted(Path(out).rglob("*")) if p.is_file()}


def refused(scene, *options, out=None):
    """The line that ``run`` refuses with; OUT is afterwards as it was before."""
    out = Path(out) if out else Path(scene).parent / "out"
    before = contents(out) if out.is_dir() else out.exists()
    with pytest.raises(errors.InputError) as caught:
        run.main([str(scene), "-o", str(out), *options])
    assert (contents(out) if out.is_dir() else out.exists()) == before
    message = str(caught.value)
    assert (
        "\n" not in message
        and "Traceback" not in message
        and ".cpp" not in message
        and len(message) < 700
    )
    return message


def edited(folder, old, new, *, pattern=False):
    """The folder's scene with ``old`` (a text, or a regular expression) replaced, as another file
    beside it.
    """
    text = (folder / "scene.xml").read_text()
    changed = re.sub(old, new, text, flags=re.S) if pattern else text.replace(old, new)
    assert changed != text
    path = folder / "changed.xml"
    path.write_text(changed)
    return path


def has(message, *words):
    assert all(word in message for word in words), message


# ---- the scene -----------------------------------------------------------------------------------


def test_no_scene(tmp_path):
    has(refused(tmp_path / "nothing.xml"), f"{tmp_path / 'nothing.xml'}: no such scene file")
    has(refused(tmp_path), str(tmp_path), "no such scene file")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        '<scene version="3.0.0"><integrator',
        '<?xml version="1.0" encoding="klingon"?><scene/>',
        "\x00\xff",
    ],
)
def test_not_xml(tmp_path, text):
    (tmp_path / "scene.xml").write_text(text)
    has(refused(tmp_path / "scene.xml"), f"{tmp_path / 'scene.xml'}: not a readable XML scene")


REFUSED_BY_MITSUBA = [
    ('type="twosided"', 'type="twosidde"', ["line 97: ", "bsdf", '"twosidde" not found']),
    (
        'name="wrap_mode"',
        'name="wrap_mod"',
        ["line 99: unknown property", '"bitmap"', '"wrap_mod": "clamp"'],
    ),
    (
        '<string name="masks"',
        '<float name="k_foo" value="1"/><string name="masks"',
        ["line 42: unknown property", '"polysft"', '"k_foo"'],
    ),
    ('<emitter type="constant"/>', '<emiter type="constant"/>', ["line 108: ", "<emiter>"]),
    (
        '<emitter type="constant"/>',
        '<include filename="nope.xml"/>',
        ["line 108: ", '"nope.xml" not found'],
    ),
    (
        '<integrator type="$integrator"/>',
        "",
        ["line 42: polysft: 0 nested integrators", 'e.g. <integrator type="raster"/>'],
    ),
    (
        '<string name="frames" value="$frames"/>',
        "",
        ["line 42: polysft: property 'frames' is missing; a folder of images"],
    ),
    ('value="$frames"', 'value="$framez"', ["line 43: undefined parameter: $framez"]),
    (' version="3.0.0"', "", ["missing version attribute"]),
    (
        r'name="fov" value="[^"]*"',
        'name="fov" value="abc"',
        ["line 78: ", 'floating point value "abc"'],
    ),
    (
        r'name="fov" value="[^"]*"',
        'name="fov" value="200"',
        ["line 77: ", '"perspective"', "field of view", "[0, 180]"],
    ),
]


@pytest.mark.parametrize(
    "old, new, words", REFUSED_BY_MITSUBA, ids=[w[-1] for _, _, w in REFUSED_BY_MITSUBA]
)
def test_xml_that_mitsuba_refuses(sheet, old, new, words):
    path = edited(sheet, old, new, pattern=old.startswith("name="))
    message = refused(path)
    has(message, *words)
    assert message.startswith(f"{path}: ") and message.count(str(path)) <= 2


def test_integrator(sheet):
    has(
        refused(sheet / "scene.xml", "-D", "integrator=depth"),
        "solver gauss-newton renders with raster",
        "give solver=adam",
    )
    has(
        refused(sheet / "scene.xml", "-D", "integrator=foo"),
        "line 74: ",
        "integrator",
        '"foo" not found',
    )
    has(
        refused(sheet / "scene.xml", "-D", "integrator=depth", "-D", "solver=adam"),
        "DepthIntegrator gives no gradients; raster or prb_projective is needed",
    )
    message = refused(edited(sheet, '<integrator type="polysft">', '<integrator type="path">'))
    has(message, 'its integrator is path; one <integrator type="polysft"> is needed')
    message = refused(edited(sheet, "<integrator.*</integrator>", "", pattern=True))
    has(message, 'its integrator is missing; one <integrator type="polysft"> is needed')


def test_sensors_that_are_no_pinhole(sheet):
    for kind, extra in (
        ("thinlens", '<float name="aperture_radius" value="0.01"/>'),
        ("orthographic", ""),
    ):
        message = refused(
            edited(
                sheet,
                '<sensor type="perspective">.*?<transform',
                f'<sensor type="{kind}">{extra}<transform',
                pattern=True,
            )
        )
        has(
            message,
            "line 77",
            f"sensor '{kind}' is not a pinhole; perspective or pinhole is needed",
        )
    has(
        refused(edited(sheet, "<sensor.*</sensor>", "", pattern=True)),
        "0 sensors; exactly one is needed",
    )


def test_film_without_alpha(sheet):
    message = refused(
        edited(sheet, 'name="pixel_format" value="rgba"', 'name="pixel_format" value="rgb"')
    )
    has(message, "the film has no alpha", "pixel_format rgba is needed")


def pinhole(folder, **values):
    values = {"fx": 55, "fy": 50, "cx": 24, "cy": 18} | values
    floats = "".join(f'<float name="{k}" value="{v}"/>' for k, v in values.items() if v is not None)
    return edited(
        folder,
        '<sensor type="perspective">.*?<transform',
        f'<sensor type="pinhole">{floats}<transform',
        pattern=True,
    )


@pytest.mark.parametrize("value", [0, -50, "nan", "inf"])
def test_focal_length_that_is_none(sheet, value):
    has(
        refused(pinhole(sheet, fy=value)),
        "line 77: camera: ",
        "is not a pinhole; finite values and positive focal lengths are needed",
    )


def test_focal_length_missing(sheet):
    has(
        refused(pinhole(sheet, fy=None)),
        "line 77: pinhole: property 'fy' is missing; fx, fy, cx, cy are needed",
    )


@pytest.mark.parametrize("integrator", ["prb_projective", "path"])
def test_pixels_that_are_not_square_with_path_replay(sheet, integrator):
    message = refused(pinhole(sheet), "-D", f"integrator={integrator}")
    has(message, "takes Mitsuba's perspective sensor only (fx = fy); use raster")


def test_which_mesh_is_the_template(sheet):
    shape = re.search("<shape.*</shape>", (sheet / "scene.xml").read_text(), re.S)[0]
    anonymous = shape.replace(' id="template"', "")
    has(
        refused(edited(sheet, shape, anonymous + anonymous)),
        '2 meshes; give the template\'s shape id="template"',
    )
    has(refused(edited(sheet, shape, "")), '0 meshes; give the template\'s shape id="template"')
    has(refused(edited(sheet, shape, shape + shape)), 'duplicate ID: "template"')


# ---- settings ------------------------------------------------------------------------------------


def test_unknown_setting_lists_the_known_ones_and_the_nearest(sheet):
    message = refused(sheet / "scene.xml", "-D", "ordre=4")
    has(
        message,
        "-D ordre: ",
        "did you mean order?; known: blur, brightness, data,",
        "k_mi",
        "window",
    )
    has(refused(sheet / "scene.xml", "-D", "zzz=4"), "has no such setting; known: blur")


@pytest.mark.parametrize("text", ["order", "=3", ""])
def test_malformed_setting(sheet, text):
    has(refused(sheet / "scene.xml", "-D", text), f"-D {text}: NAME=VALUE is needed")


@pytest.mark.parametrize(
    "setting, words",
    [
        ("k_mi=abc", "setting k_mi = 'abc'; a finite number is needed"),
        ("k_mi=", "setting k_mi = ''; a finite number is needed"),
        ("k_mi=nan", "k_mi = nan; a finite number, at least 0, is needed"),
        ("k_mi=1e999", "k_mi = inf; a finite number, at least 0, is needed"),
        *(
            (f"{name}=-0.5", f"{name} = -0.5; a finite number, at least 0, is needed")
            for name in ("k_rgb", "k_silhouette", "k_mi", "k_tc", "lr_uv")
        ),
        *((f"order={n}", f"order = {n}; a whole number, 0 to 10, is needed") for n in (-1, 11)),
        *((f"order={n}", f"order = '{n}'; a whole number is needed") for n in ("four", "2.5", "")),
        ("fit_tolerance=0", "fit_tolerance = 0.0; a finite number, above 0, is needed"),
        ("window=-1", "window = -1; a whole number, at least 0, is needed"),
        ("solver=newton", "solver = 'newton'; known values: gauss-newton, adam"),
        ("rgb_norm=l3", "rgb_norm = 'l3'; known values: l1, l2, charbonnier"),
        ("spp=3", "raster: spp = 3; a square number is needed"),
        ("first=3", "first = 3; "),
        ("last=3", "last = 3; it must lie in [0, 2]"),
        ("data=/nowhere", "data = /nowhere: no such folder"),
        ("frames=nothing", "nothing: no images"),
        ("masks=nothing", "nothing: no images"),
    ],
)
def test_bad_value(sheet, setting, words):
    has(refused(sheet / "scene.xml", "-D", setting), words)


@pytest.mark.parametrize(
    "settings, words",
    [
        (["window=3", "smooth=1"], "window = 1, or smooth = 0, is needed"),
        (
            ["brightness=gain"],
            "brightness = 'gain' with solver = gauss-newton; auto, local or none is needed",
        ),
    ],
)
def test_values_that_do_not_go_together(sheet, settings, words):
    has(refused(sheet / "scene.xml", *(part for text in settings for part in ("-D", text))), words)


def test_order_too_high_for_the_vertices(tmp_path):
    truth = synthetic.cloth(tmp_path / "sheet", frames=1, size=SIZE, rows=4, columns=5)
    prepare.prepare(str(truth.folder))
    has(
        refused(truth.folder / "scene.xml", "-D", "order=10"),
        "template.obj: order = 10 is too high",
        "66 coefficients, and the 20 vertices determine no more than order 3",
    )


@pytest.mark.parametrize(
    "options", [["--fps", "0"], ["--fps", "nan"], ["--exr", "-1"], ["--exr", "some"]]
)
def test_bad_numbers_of_flags(sheet, options):
    has(refused(sheet / "scene.xml", *options), " ".join(options), "are needed")


# ---- images --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["texture.png", "frames/001.png", "masks/001.png"])
@pytest.mark.parametrize("kind", ["truncated", "garbage", "empty"])
def test_image_that_cannot_be_read(sheet, name, kind):
    path = sheet / name
    data = path.read_bytes()
    path.write_bytes({"truncated": data[: len(data) // 2], "garbage": b"hello", "empty": b""}[kind])
    has(
        refused(sheet / "scene.xml"),
        name,
        "line 99: " if name == "texture.png" else "not a readable image",
    )


@pytest.mark.parametrize(
    "name, words", [("frames", "3 masks for the 2 images"), ("masks", "2 masks for the 3 images")]
)
def test_an_image_is_missing(sheet, name, words):
    (sheet / name / "001.png").unlink()
    has(refused(sheet / "scene.xml"), str(sheet / "masks"), words, "one mask an image is needed")


@pytest.mark.parametrize("name", ["texture.png", "frames", "masks"])
def test_files_are_missing(sheet, name):
    if name == "texture.png":
        (sheet / name).unlink()
    else:
        shutil.rmtree(sheet / name)
    has(
        refused(sheet / "scene.xml"),
        str(sheet / name) if name == "texture.png" else name,
        "no such file" if name == "texture.png" else "no images",
    )


@pytest.mark.parametrize("name", ["frames", "masks"])
def test_image_of_another_size(sheet, name):
    assert cv2.imwrite(str(sheet / name / "002.png"), np.full((30, 40, 3), 99, np.uint8))
    has(refused(sheet / "scene.xml"), f"{name}/002.png: 40x30 pixels", "48x36")


def test_film_of_another_size(sheet):
    message = refused(
        edited(sheet, '<integer name="width" value="48"/>', '<integer name="width" value="64"/>')
    )
    has(message, "frames/000.png: 48x36 pixels; the camera's film has 64x36")


def test_first_mask_is_empty(sheet):
    assert cv2.imwrite(str(sheet / "masks" / "000.png"), np.zeros(SIZE[::-1], np.uint8))
    has(refused(sheet / "scene.xml"), "masks/000.png: the mask is empty")


# ---- the template --------------------------------------------------------------------------------


def moved(truth, by=(0, 0, 0), scale=1.0):
    return truth.vertices[0] * scale + by, truth.uv, truth.faces


def with_extra(truth, points, faces):
    V, uv, F = moved(truth)
    points, faces = np.reshape(points, (-1, 3)), np.reshape(faces, (-1, 3)).astype(int)
    return (
        np.concatenate([V, points]),
        np.concatenate([uv, np.zeros((len(points), 2))]),
        np.concatenate([F, faces]),
    )


def with_nan(truth, which):
    arrays = [a.copy() for a in moved(truth)]
    arrays[which][5] = np.nan
    return arrays


def twice(truth):
    V, uv, F = moved(truth)
    return (
        np.concatenate([V, V + (0, 0.3, 0)]),
        np.concatenate([uv, uv]),
        np.concatenate([F, F + len(V)]),
    )


def ball(_):
    mesh = trimesh.creation.icosphere(2, 0.06)
    return mesh.vertices + (0, 0, 0.5), mesh.vertices[:, :2] * 8 + 0.5, mesh.faces


BAD_TEMPLATES = {
    "nan": (
        lambda t: with_nan(t, 0),
        ["template.obj: 1 vertices have coordinates that are not finite (the first is vertex 5"],
    ),
    "uv nan": (
        lambda t: with_nan(t, 1),
        ["template.obj: 1 texture coordinates are not finite (the first is vertex 5"],
    ),
    "degenerate": (
        lambda t: with_extra(t, [], [0, 0, 1]),
        ["template.obj: 1 faces have no area (the first is face 160"],
    ),
    "non-manifold": (
        lambda t: with_extra(t, [0, 0, 0.4], [1, 11, 99]),
        ["template.obj: 1 edges have more than two faces (the first joins vertices 1 and 11)"],
    ),
    "unreferenced": (
        lambda t: with_extra(t, [0, 0, 0.4], []),
        ["template.obj: 1 vertices are in no face (the first is vertex 99"],
    ),
    "components": (twice, ["template.obj: 2 separate components; one connected mesh is needed"]),
    "closed": (
        ball,
        [
            "template.obj: one jet cannot hold it",
            "triangles fold over",
            "residual of the 8-jet is",
            "mm RMS",
        ],
    ),
    "behind": (
        lambda t: moved(t, (0, 0, -1)),
        ["99 of 99 vertices behind the camera; it must stand in its pose of the first frame"],
    ),
    "out of view": (
        lambda t: moved(t, (5, 0, 0)),
        ["out of view in the first frame: it projects to x 5", "an image of 48x36 pixels"],
    ),
    "off the mask": (
        lambda t: moved(t, (0.15, 0.1, 0.5), 0.05),
        ["does not meet the mask of the first frame: it projects to x"],
    ),
}


@pytest.mark.parametrize("kind", BAD_TEMPLATES)
def test_bad_template(good, sheet, kind):
    make, words = BAD_TEMPLATES[kind]
    synthetic.write_obj(sheet / "template.obj", *make(good))
    has(refused(sheet / "scene.xml"), *words)


def test_template_without_uv(sheet):
    path = sheet / "template.obj"
    path.write_text(
        "\n".join(
            re.sub(r"/\d+", "", line)
            for line in path.read_text().splitlines()
            if not line.startswith("vt")
        )
    )
    has(refused(sheet / "scene.xml"), f"{path}: it has no texture coordinates (uv)")


def test_template_that_cannot_be_read(sheet):
    path = sheet / "template.obj"
    text = path.read_text()
    for content, words in (
        ("", "template.obj: 0 vertices; a template has at least 3"),
        ("\x00garbage", "template.obj: 0 vertices"),
        (text + "f 1/1 2/2 999/1\n", "template.obj: a face names number 999 of 99 vertices"),
        (text + "v 1 two 3\n", "template.obj: line 359: 'v 1 two 3' is not OBJ"),
    ):
        path.write_text(content)
        has(refused(sheet / "scene.xml"), words)
    path.unlink()
    has(
        refused(sheet / "scene.xml"),
        f"{path}: no such file (filename of <obj> in {sheet / 'scene.xml'})",
    )
    has(
        refused(edited(sheet, "template.obj", "texture.png")),
        "texture.png: template of type '.png'; .obj or .ply is needed",
    )


# ---- OUT -----------------------------------------------------------------------------------------


def test_out_that_cannot_be_a_folder(good, tmp_path):
    scene, file = good.folder / "scene.xml", tmp_path / "file"
    file.write_text("mine")
    has(refused(scene, out=file), f"{file}: is a file; OUT must be a folder")
    has(refused(scene, out=file / "out"), f"{file} is not a folder that can be written to")
    assert file.read_text() == "mine"
    with pytest.raises(errors.InputError, match="-o '': "):
        run.main([str(scene), "-o", ""])


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into every folder")
def test_out_in_a_folder_that_cannot_be_written(good, tmp_path):
    tmp_path.chmod(0o555)
    try:
        has(
            refused(good.folder / "scene.xml", out=tmp_path / "out"),
            f"{tmp_path} is not a folder that can be written to",
        )
    finally:
        tmp_path.chmod(0o755)


def test_out_that_holds_something(good, finished, tmp_path):
    scene = good.folder / "scene.xml"
    has(
        refused(scene, out=finished),
        f"{finished}: holds another run; give --overwrite to replace it or --resume",
    )
    (tmp_path / "notes.txt").write_text("mine")
    for flag in ([], ["--overwrite"]):
        has(
            refused(scene, *flag, out=tmp_path),
            f"{tmp_path}: is not empty and holds no run; give an empty or new folder",
        )


def test_nothing_to_resume(good, finished, tmp_path):
    scene = good.folder / "scene.xml"
    has(
        refused(scene, "--resume", out=tmp_path / "out"),
        "out: holds no run to resume; leave out --resume",
    )
    has(
        refused(scene, "--resume", *QUICK, "-D", "k_mi=0.2", out=finished),
        "was run with another scene or other settings",
        "--overwrite",
    )
    shutil.copytree(finished, tmp_path / "broken")
    (tmp_path / "broken" / "scene.xml").unlink()
    has(
        refused(scene, "--resume", *QUICK, out=tmp_path / "broken"),
        "scene.xml: missing; the run cannot be resumed",
    )


@pytest.mark.parametrize("keep", [0, 1 / 2])
def test_checkpoint_that_cannot_be_read(good, finished, tmp_path, keep):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    data = (out / "checkpoint.npz").read_bytes()
    (out / "checkpoint.npz").write_bytes(data[: int(keep * len(data))])
    message = refused(good.folder / "scene.xml", "--resume", *QUICK, out=out)
    has(message, f"{out / 'checkpoint.npz'}: not a checkpoint of a run", "--overwrite")


def test_bad_input_spares_the_run_that_would_be_replaced(sheet, finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (sheet / "frames" / "001.png").write_bytes(b"hello")
    has(refused(sheet / "scene.xml", "--overwrite", out=out), "001.png: not a readable image")


def test_overwriting_a_run_by_its_own_scene(finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    assert run.main([str(out / "scene.xml"), "-o", str(out), "-q", "--overwrite"]) == 0
    assert (out / "scene.xml").read_text() == (finished / "scene.xml").read_text()


# ---- whole processes -----------------------------------------------------------------------------


def process(*arguments, module="run", **options):
    """Exit status 2 and one line; returns it."""
    done = subprocess.run(
        [sys.executable, "-m", f"polysft_mi.{module}", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        **options,
    )
    assert done.returncode == 2, done.stderr
    assert (
        done.stderr.startswith("error: ") and done.stderr.count("\n") == 1 and done.stdout == ""
    ), done.stderr
    return done.stderr


def test_processes_end_with_one_line_and_status_2(sheet, tmp_path):
    scene, out = sheet / "scene.xml", tmp_path / "out"
    has(process(tmp_path / "nothing.xml", "-o", out), "nothing.xml: no such scene file")
    has(process(scene, "-o", out, "-D", "integrator=foo"), "line 74", '"foo" not found')
    has(process(scene, "-o", out, "-m", "scalar_rgb"), "mode 'scalar_rgb': one of llvm_ad_rgb,")
    has(
        process(edited(sheet, 'name="wrap_mode"', 'name="wrap_mod"'), "-o", out),
        'unknown property in texture plugin of type "bitmap"',
    )
    (sheet / "frames" / "001.png").write_bytes(b"hello")
    has(process(scene, "-o", out), "frames/001.png: not a readable image")
    assert not out.exists()


def test_wrong_names_are_told_before_anything_is_loaded(good, tmp_path):
    """Mitsuba is not even imported for them."""
    code = (
        "import sys; from polysft_mi import errors, run\ntry: run.main(sys.argv[1:])\nexcept"
        " errors.InputError: print('mitsuba' in sys.modules)"
    )
    for option in ("ordre=4", "order=four"):
        arguments = [good.folder / "scene.xml", "-o", tmp_path / "out", "-D", option]
        done = subprocess.run(
            [sys.executable, "-c", code, *map(str, arguments)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == "False\n"


@pytest.mark.parametrize(
    "values, words",
    [
        ({"fx": 0}, "not a pinhole; finite values and positive focal lengths are needed"),
        ({"fy": float("nan")}, "not a pinhole"),
        ({"cx": "middle"}, "are needed"),
        ({"width": 0}, "0x36"),
    ],
)
def test_camera_file_that_is_no_pinhole(sheet, values, words):
    path = sheet / "camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))
    with pytest.raises(errors.InputError) as caught:
        prepare.main([str(sheet), "--overwrite"])
    has(str(caught.value), str(path), words)


@pytest.mark.parametrize(
    "K, words",
    [
        ("50 9 24\n0 50 18\n0 0 1", "skew 9"),
        ("50 0 24\n0 50 18\n0 0.1 1", "it must read [[fx, 0, cx]"),
        ("50 0\n0 50", "3x3 is needed"),
    ],
)
def test_matrix_that_is_no_pinhole(tmp_path, K, words):
    truth = synthetic.kinect_paper(tmp_path / "paper", frames=1, size=SIZE)
    (truth.folder / "cam.intr").write_text(K)
    has(process(truth.folder, module="prepare"), "cam.intr: ", words)
    assert not (truth.folder / "scene.xml").exists()


# ---- a full disk ---------------------------------------------------------------------------------


def whole(out):
    """Every file that a run left under its own name can be read."""
    for path in filter(Path.is_file, Path(out).rglob("*")):
        if path.suffix == ".npz":
            with np.load(path) as data:
                assert all(np.isfinite(data[k]).all() for k in data if data[k].dtype.kind == "f")
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".ply":
            meshio.read_template(path)
        elif path.suffix == ".exr":
            exr.read_exr(path)
        elif path.suffix == ".png":
            assert cv2.imread(str(path)) is not None
        elif path.suffix == ".xml":
            assert path.read_text().endswith("</scene>\n")
        elif path.suffix == ".mp4":
            assert cv2.VideoCapture(str(path)).read()[0]
        else:
            assert path.suffix == ".jsonl", path


@pytest.fixture
def small_disk(tmp_path):
    """Mounts a disk of so many KiB, returns its folder."""
    mounted = []

    def mount(kibibytes):
        place = tmp_path / "disk"
        place.mkdir()
        try:
            done = subprocess.run(
                ["mount", "-t", "tmpfs", "-o", f"size={kibibytes}k", "tmpfs", place],
                capture_output=True,
                text=True,
            )
        except FileNotFoundError:
            pytest.skip("no mount command")
        if done.returncode:
            pytest.skip(f"a small disk cannot be mounted here: {done.stderr.strip()}")
        mounted.append(place)
        return place

    yield mount
    for place in mounted:
        subprocess.run(["umount", place], check=True)


@pytest.mark.parametrize("kibibytes", [4, 8, 16, 24, 48, 80, 110])
def test_full_disk(good, small_disk, capsys, kibibytes):
    out = small_disk(kibibytes) / "out"
    ours = signal.getsignal(signal.SIGINT)
    with pytest.raises(SystemExit) as ended:
        errors.cli(lambda: run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK]))
    signal.signal(signal.SIGINT, ours)  # a command's end gives it back to the system
    error = capsys.readouterr().err
    assert ended.value.code == 2 and error.count("\n") == 1, error
    assert error.startswith(f"error: {out}") and "No space left on device" in error
    whole(out)


def test_a_run_that_a_full_disk_stopped_is_resumed(good, small_disk):
    out = small_disk(48) / "out"
    with pytest.raises(OSError, match="No space left"):
        run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK])
    subprocess.run(["mount", "-o", "remount,size=4m", out.parent], check=True)
    assert run.main([str(good.folder / "scene.xml"), "-o", str(out), *QUICK, "--resume"]) == 0
    assert {"surface.npz", "metrics.json", "comparison.mp4"} <= {p.name for p in out.iterdir()}
    whole(out)


def test_files_that_may_not_grow(good, tmp_path):
    """The same without a mount: a limit on the size of files."""
    out = tmp_path / "out"
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
    command = [
        sys.executable,
        "-m",
        "polysft_mi.run",
        str(good.folder / "scene.xml"),
        "-o",
        str(out),
        *QUICK,
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, preexec_fn=limit)
    # Dr.Jit's cache has files too, and says so where it has a kernel that is new to it
    lines = [line for line in done.stderr.splitlines() if not line.startswith("jit_kernel_write()")]
    assert (
        done.returncode == 2
        and len(lines) == 1
        and lines[0].startswith("error: ")
        and not done.stdout
    ), done.stderr
    has(lines[0], str(out), "File too large")
    whole(out)
