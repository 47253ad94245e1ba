"""``python -m polysft_mi.prepare``: the scene file of a sequence's folder, whose form is recognised
by the files in it; or the whole folder from a video.

Three forms are known (:data:`FORMS`). Names of OBJ files and images, numbers and sizes of frames
are the folder's own. What makes a folder from a video is :mod:`polysft_mi.capture`.
"""

import contextlib
import json
import os
import shlex
import sys
from dataclasses import dataclass, field
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from .camera import Intrinsics
from .errors import InputError, cli
from .files import aside
from .scene import kinect_paper
from .scene.kinect_paper import template as kinect_paper_template
from .scene.sequence import EXTENSIONS, Sequence, image_size
from .scene.settings import defaults_xml, properties_xml
from .surface import meshio

FORMS = (
    "cloth (camera.json, an OBJ file, a texture image, frames/, masks/ or none), "
    "phi-SfT (camera.json, an OBJ file, a texture image, rgbs/, masks/ or none), "
    "Kinect-Paper (cam.intr, cam.ext, mesh.pts, mesh.tri, frame_* images)"
)


@dataclass(frozen=True)
class Layout:
    """What a scene file needs of a folder. Paths are relative to the folder; ``frames`` and
    ``masks`` as for Sequence.open.

    ``obj``: the template's file, None where the form has none; ``flip``: its x and y are negated in
    the camera frame; ``settings``: what differs from the defaults of
    :class:`polysft_mi.scene.settings.Settings`.
    """

    form: str
    camera: Intrinsics
    frames: str
    masks: str
    texture: str
    obj: str = None
    flip: bool = False
    settings: dict = field(default_factory=dict)


def recognise(folder):
    """The :class:`Layout` of a folder. Raises InputError for an unknown form, and for what a known
    one lacks.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder; the folder of a sequence is needed")
    has = lambda name: os.path.exists(os.path.join(folder, name))
    if any(map(has, kinect_paper.FILES)):
        return _kinect_paper(folder)
    if has("rgbs"):
        return _camera_and_obj(folder, "phi-SfT", "rgbs", flip=True)
    if has("frames"):
        return _camera_and_obj(folder, "cloth", "frames", flip=False)
    raise InputError(f"{folder}: not a sequence in a form that is known; these are: {FORMS}")


def _camera_and_obj(folder, form, frames, flip):
    _require(folder, form, "camera.json")
    camera = Intrinsics.from_json(os.path.join(folder, "camera.json"))
    obj = _the_file(folder, form, "template", (".obj",), "an OBJ file with the template")
    texture = _the_file(folder, form, "texture", EXTENSIONS, "an image with the texture")
    masks = "masks" if os.path.isdir(os.path.join(folder, "masks")) else ""
    return Layout(form, camera, frames, masks, texture, obj, flip)


def _kinect_paper(folder):
    _require(folder, "Kinect-Paper", *kinect_paper.FILES)
    first = kinect_paper.images(folder)[0]
    frames = f"frame_*{os.path.splitext(first)[1]}"
    return Layout("Kinect-Paper", kinect_paper.camera(folder), frames, "", os.path.basename(first))


def _require(folder, form, *names):
    for name in names:
        if not os.path.isfile(os.path.join(folder, name)):
            raise InputError(
                f"{os.path.join(folder, name)}: no such file; a sequence in the form {form}"
                " needs it"
            )


def _the_file(folder, form, stem, extensions, what):
    """The file of these types in the folder, the one called ``stem`` where there are several."""
    found = sorted(
        n for n in os.listdir(folder) if n.lower().endswith(extensions) and not n.startswith(".")
    )
    chosen = (
        [n for n in found if os.path.splitext(n)[0].lower() == stem] if len(found) > 1 else found
    )
    if len(chosen) == 1:
        return chosen[0]
    there = f"it holds {', '.join(found)}; call one of them {stem}" if found else "there is none"
    raise InputError(f"{folder}: a sequence in the form {form} needs {what}; {there}")


# ---- the scene file ------------------------------------------------------------------------------


def scene_xml(layout, data, template=None, comment=""):
    """The scene file's text.

    ``data``: the sequence's folder as the scene shall name it, its default. ``template``: the file
    of the template; by default the layout's own ``obj`` in the data's folder, or where the form has
    none the plugin ``varol_template``. ``comment`` stands at the top.
    """
    if "$" in str(data) or "$" in str(template):
        raise InputError(
            f"{data if '$' in str(data) else template}: '$' in a path cannot be written in a scene"
            " file; rename the folder"
        )
    clean = lambda text: escape(text).replace("--", "- -")
    shape = _template_xml(layout, template)
    masks = f"$data/{layout.masks}" if layout.masks else ""
    return f"""<scene version="3.0.0">
    <!-- {clean(comment or f"Shape from template on a sequence in the form {layout.form}.")} -->

    <!-- The sequence's folder; a relative path counts from this file's folder -->
    <default name="data" value={quoteattr(str(data))}/>
    <default name="frames" value={quoteattr(f"$data/{layout.frames}")}/>
    <default name="masks" value={quoteattr(masks)}/>

    <!-- What renders the template: raster, or one of Mitsuba's integrators, e.g. prb_projective -->
    <default name="integrator" value="raster"/>

{defaults_xml(**layout.settings)}

    <integrator type="polysft">
        <string name="frames" value="$frames"/>
        <string name="masks" value="$masks"/>
{properties_xml()}
        <integrator type="$integrator"/>
    </integrator>

{layout.camera.sensor_xml()}

{shape}

    <!-- Radiance 1 from everywhere: an unshadowed sheet shows its texture's own colour -->
    <emitter type="constant"/>
</scene>
"""


def _template_xml(layout, template):
    if template is None and layout.obj is None:
        head = [
            '    <default name="resolution" value="33"/>',
            '    <default name="pose_fit" value="auto"/>',
            '    <shape type="varol_template" id="template">',
            '        <string name="folder" value="$data"/>',
            '        <integer name="resolution" value="$resolution"/>',
            '        <string name="pose_fit" value="$pose_fit"/>',
        ]
    else:
        name = template if template is not None else f"$data/{layout.obj}"
        head = [
            '    <shape type="obj" id="template">',
            f'        <string name="filename" value={quoteattr(name)}/>',
        ]
    if layout.flip:
        head += [
            '        <transform name="to_world">',
            (
                '            <scale value="-1, -1, 1"/>  <!-- to the camera frame: x right, y down,'
                " z forward -->"
            ),
            "        </transform>",
        ]
    body = [
        '        <bsdf type="twosided">',
        '            <bsdf type="diffuse">',
        '                <texture type="bitmap" name="reflectance">',
        (
            '                    <string name="filename"'
            f" value={quoteattr(f'$data/{layout.texture}')}/>"
        ),
        '                    <string name="wrap_mode" value="clamp"/>',
        "                </texture>",
        "            </bsdf>",
        "        </bsdf>",
        "    </shape>",
    ]
    return "\n".join(head + body)


def prepare(folder, out=None, resolution=33, overwrite=False, pose_fit="auto"):
    """Write ``scene.xml`` for a sequence into ``out`` (default: the folder itself); for
    Kinect-Paper ``template.obj`` beside it, of that ``resolution``, in its pose of
    :func:`polysft_mi.kinect_paper.template`.

    Everything that the scene names is read and checked first. Returns (path of the scene, what was
    found, in lines). Raises InputError; then nothing is written.
    """
    folder = os.path.normpath(folder)
    layout = recognise(folder)
    camera = layout.camera
    masks = os.path.join(folder, layout.masks) if layout.masks else ""
    sequence = Sequence.open(
        os.path.join(folder, layout.frames), masks, size=(camera.width, camera.height)
    )
    image_size(os.path.join(folder, layout.texture))
    template, where, said = None, "template.obj", []
    if layout.obj is None:
        vertices, faces, uv = template = kinect_paper_template(
            folder, resolution, pose_fit, said.append
        )
    else:
        where = os.path.join(folder, layout.obj)
        vertices, faces, uv = meshio.read_template(where)
    meshio.check_template(vertices, faces, uv, where)
    _check_view(vertices * ((-1, -1, 1) if layout.flip else 1), camera, where)

    here = out is None or os.path.realpath(out) == os.path.realpath(folder)
    target = folder if here else out
    written = ["scene.xml"] + (["template.obj"] if template else [])
    for name in written:
        if os.path.exists(os.path.join(target, name)) and not overwrite:
            raise InputError(
                f"{os.path.join(target, name)}: is there already; give --overwrite to replace it,"
                " or another folder by -o"
            )
    text = scene_xml(
        layout, "." if here else os.path.abspath(folder), "template.obj" if template else None
    )
    scene = os.path.join(target, "scene.xml")
    made = not os.path.isdir(target)
    try:
        os.makedirs(target, exist_ok=True)
        with contextlib.ExitStack() as stack:  # both files appear, or neither
            if template:
                write_obj(
                    stack.enter_context(aside(os.path.join(target, "template.obj"))), *template
                )
            with open(stack.enter_context(aside(scene)), "w", encoding="utf-8") as file:
                file.write(text)
    except OSError as error:
        if made:
            with contextlib.suppress(OSError):
                os.rmdir(target)
        hint = "; give a folder that can be written by -o DIR" if here else ""
        raise InputError(f"{target}: {error.strerror or error}{hint}") from None
    recognised = (
        f"{folder}: a sequence in the form {layout.form}, {len(sequence)} frames of"
        f" {camera.width}x{camera.height}, {'with' if masks else 'without'} masks, template of"
        f" {len(vertices)} vertices ({layout.obj or f'subdivided to {resolution}x{resolution}'})"
    )
    return scene, "\n".join([recognised, *said])


def _check_view(vertices, camera, where):
    if vertices[:, 2].min() <= 0:
        raise InputError(
            f"{where}: the template lies behind the camera (z down to {vertices[:, 2].min():.3g}"
            " m); z must be positive in the camera frame"
        )
    x = camera.project(vertices)
    if not ((x > 0) & (x < (camera.width, camera.height))).all(axis=1).any():
        raise InputError(
            f"{where}: the template is out of view: no vertex lies in the"
            f" {camera.width}x{camera.height} image"
        )


def write_obj(path, vertices, faces, uv):
    """Write a mesh as OBJ: vertices (N, 3), faces (F, 3), uv (N, 2) with v up."""
    with open(path, "w", encoding="utf-8") as file:
        file.writelines("v {:.9g} {:.9g} {:.9g}\n".format(*p) for p in vertices)
        file.writelines("vt {:.9g} {:.9g}\n".format(*t) for t in uv)
        file.writelines("f {0}/{0} {1}/{1} {2}/{2}\n".format(*f) for f in np.asarray(faces) + 1)


_EXAMPLES = [
    ("FOLDER", "a folder in a form that is known: writes FOLDER/scene.xml"),
    (
        "clip.mp4 --texture photo.jpg --size 297mm 210mm --fov 65 -o OUT",
        (
            "a video of a printed sheet, and a straight photo of it that shows nothing else; then"
            " look at OUT/prepare, and: polysft run OUT/scene.xml"
        ),
    ),
    (
        "clip.mp4 --texture photo.jpg --size A4 --calibrate chessboard.mp4 --board 9x6 -o OUT",
        "the camera from a video of a chessboard",
    ),
    (
        (
            "clip.mp4 --texture first-frame --corners 212,80 431,95 420,260 200,241 --size A4 --fov"
            " 65 -o OUT"
        ),
        "no photo: the first frame is the texture, and the sheet's corners in it are given",
    ),
    (
        (
            "clip.mp4 --texture photo.jpg --size A4 --fov 65 --first 30 --last 229 --scale 0.5"
            " --no-masks -o OUT"
        ),
        "a part of a video, at half its size, and without masks",
    ),
]


def parser():
    """The command line's parser."""
    from . import commands
    from .capture.command import add_arguments

    p = commands.parser(
        "prepare",
        "Make a sequence's folder, with its scene file, from a video and a photo of the sheet; or"
        f" write the scene file of a folder in one of the forms {FORMS}.",
        _EXAMPLES,
    )
    p.add_argument(
        "folder",
        metavar="FOLDER|VIDEO",
        help="a sequence's folder; or a video, a folder of images, or a pattern of images",
    )
    p.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        help="what to write into (default: FOLDER; for a video, its name without the extension)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace what is there")
    p.add_argument(
        "--resolution",
        type=int,
        default=33,
        metavar="N",
        help=(
            "vertices along the longer side of a flat template; of Kinect-Paper's, along both"
            " (default: 33)"
        ),
    )
    p.add_argument(
        "--pose-fit",
        choices=("auto", "none"),
        default="auto",
        help=(
            "move a pose that is given, by --corners or Kinect-Paper's cam.ext, to the edges of the"
            " first frame that are near the template's outline, where these are clear; none: take"
            " it as it is (default: auto)"
        ),
    )
    p.add_argument("-q", "--quiet", action="store_true", help="no progress, only errors")
    p.add_argument("--json", action="store_true", help="print what was found as JSON")

    add_arguments(p)
    return p


def main(argv=None):
    from .capture.command import from_video

    args = parser().parse_args(argv)
    given = [
        o
        for o, value in (
            ("--size", args.size),
            ("--template", args.template),
            ("--corners", args.corners),
            ("--fov", args.fov),
            ("--camera", args.camera),
        )
        if value is not None
    ]
    if args.texture is not None or os.path.isfile(args.folder):
        scene, found = from_video(
            args,
            shlex.join(
                ["python", "-m", "polysft_mi.prepare", *(sys.argv[1:] if argv is None else argv)]
            ),
        )
        line = None
    elif given:
        raise InputError(
            f"{args.folder}: {given[0]} is for a video, or a folder of images, which also needs"
            " --texture"
        )
    else:
        scene, line = prepare(
            args.folder, args.output, args.resolution, args.overwrite, args.pose_fit
        )
        found = {"folder": args.folder}
    if args.json:
        print(json.dumps({"scene": scene, **found}, ensure_ascii=False))
    elif not args.quiet:
        print(
            *filter(None, [line]),
            f"next: python -m polysft_mi.run {shlex.quote(scene)} -o OUT",
            sep="\n",
        )


if __name__ == "__main__":
    cli(main)
