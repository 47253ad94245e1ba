"""Bad input as a user meets it: scenes and settings.

One line names the file, property or value and says what is accepted; the exit status is 2; OUT is
untouched.
"""

import re

import pytest
import synthetic
from refusals import SIZE, edited, has, line_of, refused

from polysft_mi import capture
from polysft_mi.errors import InputError


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


# what is changed, into what, a text of the line that the message names, and words of the message
INTEGRATOR, FRAMES = '<integrator type="$integrator"/>', '<string name="frames" value="$frames"/>'
FOV, LIGHT = r'name="fov" value="[^"]*"', '<emitter type="constant"/>'
MASKS, K_FOO = '<string name="masks"', '<float name="k_foo" value="1"/><string name="masks"'
REFUSED_BY_MITSUBA = [
    ('type="twosided"', 'type="twosidde"', "twosidde", 'bsdf|"twosidde" not found'),
    ('name="wrap_mode"', 'name="wrap_mod"', 'type="bitmap"', '"bitmap"|"wrap_mod": "clamp"'),
    (MASKS, K_FOO, 'type="polysft"', 'unknown property|"polysft"|"k_foo"'),
    (LIGHT, '<emiter type="constant"/>', "<emiter", "<emiter>"),
    (LIGHT, '<include filename="nope.xml"/>', "nope.xml", '"nope.xml" not found'),
    (INTEGRATOR, "", 'type="polysft"', 'polysft: 0 nested integrators|type="raster"/>'),
    (FRAMES, "", 'type="polysft"', "polysft: property 'frames' is missing; a folder of images"),
    ('value="$frames"', 'value="$framez"', "$framez", "undefined parameter: $framez"),
    (' version="3.0.0"', "", None, "missing version attribute"),
    (FOV, 'name="fov" value="abc"', 'value="abc"', 'floating point value "abc"'),
    (FOV, 'name="fov" value="200"', 'type="perspective"', '"perspective"|field of view|[0, 180]'),
]


@pytest.mark.parametrize("old, new, at, words", REFUSED_BY_MITSUBA)
def test_xml_that_mitsuba_refuses(sheet, old, new, at, words):
    path = edited(sheet, old, new, pattern=old.startswith("name="))
    message = refused(path)
    has(message, *words.split("|"))
    if at:
        has(message, line_of(path, at))
    assert message.startswith(f"{path}: ") and message.count(str(path)) <= 2


def test_integrator(sheet):
    has(
        refused(sheet / "scene.xml", "-D", "integrator=depth", "-D", "solver=gauss-newton"),
        "solver gauss-newton needs a quadratic model of each term",
        "rgb is rendered by DepthIntegrator; raster is needed, or solver = adam",
    )
    has(
        refused(sheet / "scene.xml", "-D", "integrator=foo"),
        line_of(sheet / "scene.xml", 'type="$integrator"'),
        "integrator",
        '"foo" not found',
    )
    has(
        refused(sheet / "scene.xml", "-D", "integrator=depth"),
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
        path = edited(
            sheet,
            '<sensor type="perspective">.*?<transform',
            f'<sensor type="{kind}">{extra}<transform',
            pattern=True,
        )
        has(
            refused(path),
            line_of(path, "<sensor"),
            f"sensor '{kind}' is not a pinhole; perspective or pinhole is needed",
        )
    has(
        refused(edited(sheet, "<sensor.*</sensor>", "", pattern=True)),
        "0 sensors; one is needed",
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
    path = pinhole(sheet, fy=value)
    has(
        refused(path),
        line_of(path, "<sensor") + ": camera: ",
        "is not a pinhole; finite values and positive focal lengths are needed",
    )


def test_focal_length_missing(sheet):
    path = pinhole(sheet, fy=None)
    has(
        refused(path),
        line_of(path, "<sensor") + ": pinhole: property 'fy' is missing; fx, fy, cx, cy are needed",
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


def test_unknown_setting_lists_the_known_ones_and_the_nearest(sheet):
    message = refused(sheet / "scene.xml", "-D", "ordre=4")
    has(
        message,
        "-D ordre: ",
        "did you mean order?; known: blur, body, body_model, body_up, brightness, cameras,",
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
        ("k_mi=nan", "k_mi = nan; a finite number, at least 0, or -1, is needed"),
        ("k_mi=1e999", "k_mi = inf; a finite number, at least 0, or -1, is needed"),
        *(
            (f"{name}=-0.5", f"{name} = -0.5; a finite number, at least 0, is needed")
            for name in ("k_rgb", "k_shading", "k_tc", "lr_uv")
        ),
        *((f"order={n}", f"order = {n}; a whole number, 0 to 10, is needed") for n in (-1, 11)),
        *((f"order={n}", f"order = '{n}'; a whole number is needed") for n in ("four", "2.5", "")),
        ("rgb_scale=0", "rgb_scale = 0.0; a finite number, above 0, is needed"),
        ("window=0", "window = 0; a whole number, at least 1, is needed"),
        ("sweeps=-1", "sweeps = -1; a whole number, at least 0, is needed"),
        ("sweeps=1.5", "sweeps = '1.5'; a whole number is needed"),
        ("solver=newton", "solver = 'newton'; known values: auto, gauss-newton, adam"),
        ("rgb_norm=l3", "rgb_norm = 'l3'; known values: cauchy, l1, l2, charbonnier, phi-sft"),
        ("first=3", "first = 3; "),
        ("last=3", "last = 3; it must lie in [0, 2]"),
        ("data=/nowhere", "data = /nowhere: no such folder"),
        ("frames=nothing", "nothing: no such folder"),
        ("masks=nothing", "nothing: no such folder"),
    ],
)
def test_bad_value(sheet, setting, words):
    has(refused(sheet / "scene.xml", "-D", setting), words)


@pytest.mark.parametrize(
    "settings, words",
    [
        (["window=3", "smooth=1"], "window = 1, or smooth = 0, is needed"),
        (["window=3", "sweeps=1"], "window = 1, or sweeps = 0, is needed"),
        (["rgb_norm=l1", "sweeps=1"], "rgb has rgb_norm = l1; cauchy is needed, or sweeps = 0"),
        (
            ["brightness=gain", "solver=gauss-newton"],
            "rgb has brightness = gain; local or none is needed, or solver = adam",
        ),
        (["period=7"], "period = 7 is read by solver = adam alone, and this is gauss-newton"),
        (
            ["solver=adam", "k_relief=0.1"],
            "k_relief = 0.1 is read by solver = gauss-newton alone, and this is adam",
        ),
        (["preset=newest"], "preset = 'newest'; known values: none, paper"),
    ],
)
def test_values_that_do_not_go_together(sheet, settings, words):
    has(refused(sheet / "scene.xml", *(part for text in settings for part in ("-D", text))), words)


def test_samples_that_raster_does_not_take(sheet):
    words = refused(sheet / "scene.xml", "-D", "spp=3", "-D", "solver=adam")
    has(words, "raster: spp = 3; a square number is needed")


def test_order_too_high_for_the_vertices(tmp_path):
    truth = synthetic.cloth(tmp_path / "sheet", frames=1, size=SIZE, rows=4, columns=5)
    capture.prepare_folder(str(truth.folder))
    has(
        refused(truth.folder / "scene.xml", "-D", "order=10"),
        "template.obj: order = 10 is too high",
        "66 coefficients, and the 20 vertices determine no more than order 3",
    )


@pytest.mark.parametrize(
    "options", [["--fps", "0"], ["--fps", "nan"], ["--exr", "-1"], ["--exr", "some"]]
)
def test_bad_numbers_of_flags(sheet, options):
    has(refused(sheet / "scene.xml", *options), " ".join(options), "is needed")


def test_a_default_that_nothing_uses_is_told(sheet):
    path = edited(sheet, '<default name="k_mi"', '<default name="k_im"')
    path.write_text(path.read_text().replace("$k_mi", "100"))
    has(refused(path), "<default name='k_im'>: nothing in it uses $k_im, did you mean k_mi?")


def test_a_lens_in_the_camera_s_file_is_told(sheet):
    camera = sheet / "camera.json"
    camera.write_text(camera.read_text().replace("{", '{"distortion": [0.1, 0, 0, 0], ', 1))
    with pytest.raises(InputError, match=r"camera\.json: distortion = \[0\.1, 0, 0, 0\]; frames"):
        capture.prepare_folder(str(sheet), overwrite=True)
