"""Loading an experiment: a Mitsuba scene with a ``polysft`` integrator, its template mesh, its
defaults.

Import only after a Mitsuba variant is set.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from polyfit.device import on_device
from polyfit.errors import require
from polyfit.jets import CanonicalFrame
from polyfit.mesh import TexCoords, read_textured, write_ply
from polysft_mi.body import put_on, read_motion
from polysft_mi.errors import InputError
from polysft_mi.render import Pinhole
from polysft_mi.surface import Template, meshio

from . import plugins
from .cameras import has_camera, open_cameras
from .defaults import located, resolved_defaults
from .images import checked_size
from .sequence import Sequence
from .settings import PRESETS, Settings


@dataclass
class Experiment:
    """What a scene file describes, loaded: the scene, the template in it, the video's place, and
    the settings.

    ``corner`` (V,) is the template vertex of each vertex that Mitsuba renders (its loaders split
    vertices along texture seams); ``defaults`` maps each ``<default>`` to the value in force;
    ``sensors``: intrinsics and world_to_camera (4, 4) [m] of the scene's other sensors, by id;
    ``notes``: what was left out of the template's file, and what of the scene is not used, a line
    each; ``named``: the files that the scene names: the template's, textures.
    """

    path: str
    scene: mi.Scene
    sensor: mi.Sensor
    renderer: mi.Integrator
    mesh: mi.Mesh
    template: Template
    corner: np.ndarray
    frames: str
    masks: str
    settings: Settings
    defaults: dict = field(default_factory=dict)
    sensors: dict = field(default_factory=dict)
    notes: list = field(default_factory=list)
    named: list = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the film's crop window, pixels."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)

    def inputs(self, sequence: Sequence) -> list[str]:
        """All files that a run of the ``sequence`` depends on, beside the scene's own."""
        s, files = self.settings, list(self.named)
        for video in (sequence, *(camera.sequence for camera in sequence.cameras)):
            files += [*video.files, *(video.mask_files or ())]
        files += sequence.depth.files if sequence.depth else []
        for path in map(self._located, (s.tracks, s.body, s.body_model)):
            folder = os.path.isdir(path)  # of the body's meshes
            files += (
                [os.path.join(path, name) for name in sorted(os.listdir(path))]
                if folder
                else [path]
            )
        return [file for file in files if os.path.isfile(file)]

    def _located(self, name):
        return os.path.normpath(located(self.path, name)) if name else ""

    def sequence(self) -> Sequence:
        """The :class:`Sequence` of the frames that the settings select. Raises InputError."""
        s = self.settings
        names = s.tracks, s.depth, s.cameras, s.body, s.body_model
        tracks, depth, cameras, body, model = map(self._located, names)
        sequence = Sequence.open(
            self.frames,
            self.masks,
            first=s.first,
            last=s.last,
            stride=s.stride,
            size=self.size,
            tracks=tracks,
            track_centre=s.track_centre,
            depth=depth,
            depth_unit=s.depth_unit,
            depth_known_to=s.depth_known_to,
        )
        if cameras:
            for name in self.sensors:
                if has_camera(cameras, name):
                    raise InputError(
                        f"{self.path}: sensor {name!r}: {os.path.join(cameras, name)} has a"
                        " camera.json, too; one of both is needed"
                    )
                if not os.path.isdir(os.path.join(cameras, name)):
                    raise InputError(
                        f"{self.path}: sensor {name!r}: {os.path.join(cameras, name)}: no such"
                        " folder; its frames are needed there"
                    )
            selected = s.first, s.last, s.stride
            sequence.cameras = open_cameras(cameras, sequence.count, *selected, self.sensors)
            videos = [sequence, *(camera.sequence for camera in sequence.cameras)]
            is_grey = any(video.grey for video in videos)  # all are compared with one texture
            for video in videos:
                video.grey = is_grey
        if body:
            motion = read_motion(body, sequence.count, sequence.indices, model, s.body_up)
            sequence.carrier = put_on(self.template.vertices, self.template.faces, motion)
        return sequence


def load(
    path: str | os.PathLike[str],
    overrides: Mapping[str, object] | None = None,
    template: Template | None = None,
) -> Experiment:
    """Load a scene file as an :class:`Experiment`; ``overrides`` maps names of its defaults to
    text, ``template`` is the :class:`Template` of the same scene where it is known already.

    Raises InputError for whatever a user can get wrong in it.
    """
    path = os.fspath(path)
    overrides = {k: str(v) for k, v in (overrides or {}).items()}
    defaults = resolved_defaults(path, overrides)
    preset = PRESETS[defaults.get("preset") or "none"]
    given = {name: defaults[name] for name in (*preset, *overrides)}
    plugins.register()
    if defaults.get("data") and not os.path.isdir(located(path, defaults["data"])):
        raise InputError(
            f"{path}: data = {defaults['data']}: no such folder, neither beside the scene nor here;"
            " give -D data=FOLDER"
        )
    config, state, shape = _parsed(path, given)
    names = (node.props.get("filename") for node in state.nodes)
    named = [name for name in names if isinstance(name, str)]
    source = _source(shape)
    try:
        scene = _instance(path, config, state)
        plain = source is None or _loaded_as_read(scene, source)
    except Exception as error:  # whatever a plugin raised reaches us wrapped by the parser
        if source is None or "shape plugin" not in str(error):
            raise InputError(_mitsuba_message(error, path)) from None
        plain = False
    if not plain:
        with tempfile.TemporaryDirectory(prefix="polysft_mi-") as folder:
            config, state, shape = _parsed(path, given)
            shape["filename"] = _plain_copy(shape["filename"], folder)
            try:
                scene = _instance(path, config, state)
            except Exception as error:
                raise InputError(_mitsuba_message(error, path)) from None

    if not scene.sensors():
        raise InputError(f"{path}: 0 sensors; one is needed")
    sensors = _further(scene.sensors()[1:], path)
    if not mi.has_flag(scene.sensors()[0].film().flags(), mi.FilmFlags.Alpha):
        raise InputError(f"{path}: the film has no alpha channel; pixel_format rgba is needed")
    meshes = _template_meshes(scene)
    if len(meshes) != 1:
        raise InputError(f'{path}: {len(meshes)} meshes; give the template\'s shape id="template"')
    experiment, mesh = scene.integrator(), meshes[0]
    settings = experiment.settings
    template, corner, note = _template(mesh, source, settings, template)
    shown = scene, scene.sensors()[0], experiment.renderer, mesh, template, corner
    files = experiment.frames, experiment.masks
    notes = [note] if note else []
    if sensors and not settings.cameras:
        notes.append(
            f"note: {path}: its sensors {', '.join(sensors)} are not used; cameras names the folder"
            " of their frames"
        )
    return Experiment(path, *shown, *files, settings, defaults, sensors, notes, named)


def _further(sensors, path):
    """Intrinsics and world_to_camera (4, 4) [m] of sensors, by id."""
    found = {}
    for sensor in sensors:
        if not sensor.id():
            raise InputError(
                f"{path}: a further sensor has no id; the first one is the scene's own, and the id"
                " of another is the name of its folder in cameras"
            )
        camera, pose = Pinhole(sensor), np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.axes, -camera.axes @ camera.origin
        found[sensor.id()] = camera.intrinsics(), pose
    return found


def _instance(path, config, state):
    """The scene of the parsed file ``path``; relative paths in it count from its folder."""
    resolver = mi.file_resolver()
    places = [resolver[k] for k in range(len(resolver))]
    resolver.prepend(os.path.dirname(os.path.abspath(path)))
    try:
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)
    finally:
        resolver.clear()
        for place in places:
            resolver.append(place)


def _template_meshes(scene):
    """The meshes that may be the template: those of its name, else all."""
    meshes = [s for s in scene.shapes() if s.is_mesh()]
    return [s for s in meshes if s.id() == "template"] or meshes


def _loaded_as_read(scene, source):
    """Whether Mitsuba has the template's faces as we read them from its file, which its loaders
    understand less well (:mod:`polyfit.mesh`). Faces that are left out do not count.
    """
    _, vertices, faces, _, kept, _ = source
    for mesh in _template_meshes(scene):
        shown = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
        if len(shown) != len(kept):
            return True  # it leaves out some, too
        rendered = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        apart = np.abs(rendered[shown[kept]] - vertices[faces]).max()
        return not apart > 1e-4 * np.ptp(vertices, axis=0).max()
    return True


def _plain_copy(path, folder):
    """A file in ``folder`` with the template of another, its vertices and triangles in their
    order, that any loader understands.
    """
    vertices, faces, texcoords = read_textured(path, what="template")
    copy = os.path.join(folder, f"template{os.path.splitext(path)[1].lower()}")
    if copy.endswith(".obj"):
        meshio.write_obj(copy, vertices, faces, texcoords)
    else:
        index, uv, split = texcoords.split(faces)
        write_ply(copy, vertices[index], split, uv)
    return copy


def _mitsuba_message(error, path):
    """What Mitsuba's parser says of the scene at ``path``, in one line: the file, the line, and the
    cause.
    """
    text = re.sub(r"\[\w+\.cpp:\d+\] *|\[[A-Z]\w+\] +", "", str(error))
    here = re.search(rf"{re.escape(path)} \(line (\d+), col \d+\)", text)
    if "InputError: " in text:  # raised by a plugin of ours, at the end of a traceback
        text = text.rpartition("InputError: ")[2]
    else:
        lines = [line for line in text.splitlines() if not line.startswith(("Traceback", "  File"))]
        text = " ".join(line.strip().removeprefix("- ") for line in lines)
        text = re.sub(rf"(At|(Error )?[Ww]hile loading) {re.escape(path)} \(.*?\): ", "", text)
        text = text.replace("unreferenced", "unknown").replace(
            "Found 1 unknown property", "unknown property"
        )
    return (
        f"{path}:"
        f" {f'line {here[1]}: ' if here else ''}{text if len(text) <= 300 else text[:300] + ' ...'}"
    )


def _parsed(path, overrides):
    """Parse the file, check its integrator, its sensor and that the files it names are there;
    return the parser's configuration, its state, and the properties of the template's shape (or
    None).
    """
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_meshes = config.merge_equivalent = False
    try:
        state = mi.parser.parse_file(config, path, **overrides)
    except Exception as error:
        raise InputError(_mitsuba_message(error, path)) from None
    shapes = []
    top = [
        state.nodes[v.index()]
        for _, v in state.root.props.items()
        if isinstance(v, mi.Properties.ResolvedReference)
    ]
    integrators = [
        node.props.plugin_name() for node in top if node.type == mi.ObjectType.Integrator
    ]
    if integrators != ["polysft"]:
        raise InputError(
            f"{path}: its integrator is {', '.join(integrators) or 'missing'}; one <integrator"
            ' type="polysft"> is needed'
        )
    for node in state.nodes:
        props = node.props
        if node.type == mi.ObjectType.Sensor and props.plugin_name() not in (
            "perspective",
            "pinhole",
        ):
            raise InputError(
                f"{mi.parser.file_location(state, node)}: sensor {props.plugin_name()!r} is not a"
                " pinhole; perspective or pinhole is needed"
            )
        if "filename" in props and isinstance(props["filename"], str):
            name = located(path, props["filename"])
            if not os.path.isfile(name):
                raise InputError(
                    f"{name}: no such file (filename of <{props.plugin_name()}> in {path})"
                )
            props["filename"] = name
            if props.plugin_name() == "bitmap" and not name.lower().endswith(".exr"):
                checked_size(
                    name
                )  # Mitsuba's libraries tell of a broken file in lines of their own
        if props.plugin_name() in ("obj", "ply", "serialized", "varol_template"):
            shapes.append(props)
    template = next((p for p in shapes if p.id() == "template"), shapes[0] if shapes else None)
    return config, state, template


def _source(props):
    """(file, vertices (N, 3), faces (F, 3), texture coordinates, which of the file's faces these
    are, note) of the template's shape in its file's own order, None where it has no file.

    Read and checked before Mitsuba loads the scene, for its loaders tell less, and take files that
    are no meshes.
    """
    if props is None or "filename" not in props:
        return None
    where = props["filename"]
    vertices, faces, texcoords = read_textured(where, what="template")
    if "to_world" in props:
        m = np.array(props["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        vertices = vertices @ m[:3, :3].T + m[:3, 3]
    return _clean(where, vertices, faces, texcoords)


def _clean(where, vertices, faces, texcoords):
    """:func:`_source` of arrays."""
    vertices, faces, texcoords, kept, note = meshio.cleaned(vertices, faces, texcoords)
    meshio.check_template(vertices, faces, texcoords, where)
    return where, vertices, faces, texcoords, kept, note and f"note: {where}: {note}"


def _template(mesh, source, settings, template):
    """The template that the mesh shows, in its file's own vertex order (fitted, where it is not
    given), the map from rendered vertices to it, and a note. What is left out of the template
    leaves the mesh too.
    """
    rendered = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    shown = np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    if not mesh.has_vertex_texcoords():
        raise InputError(
            f"{source[0] if source else mesh.id()}: it has no texture coordinates (uv); the texture"
            " cannot be placed on it"
        )
    if source is None:
        uv = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
        texcoords = TexCoords(uv * (1, -1) + (0, 1), shown)  # Mitsuba's v runs down, a file's up
        source = _clean(f"template {mesh.id()!r}", rendered, shown, texcoords)
    where, vertices, faces, texcoords, kept, note = source
    if len(shown) != len(kept):  # one of both readers has left out some already
        kept = meshio.cleaned(rendered, shown, None)[3]
    if not kept.all():
        shown = shown[kept]
        of_mesh = mi.traverse(mesh)
        of_mesh["faces"] = on_device(shown, mi.UInt32)
        of_mesh.update()
    if not np.isfinite(rendered).all():
        raise InputError(f"{where}: positions are not finite (NaN)")
    corner = _corners(rendered, shown, vertices, faces, where)
    if template is not None:
        return template, corner, note
    order, exact = settings.jet_order, settings.order > 0  # by the patches that it needs

    def fit(frame):
        return Template.fit(
            vertices, faces, texcoords, order, exact=exact, frame=frame, where=where
        )

    one = settings.patches == 1
    template = fit(CanonicalFrame.from_points(vertices) if one else None)
    if settings.canonical_frame == "stn" and len(template) == 1:
        template = fit(_transformed_frame(vertices))
    return template, corner, note


def _transformed_frame(vertices):
    """The frame of the vertices by the spatial transformer that the paper's training made. Raises
    InputError where torch is not installed.
    """
    require("torch", "safetensors")
    from polyfit.network import PolyFit

    return PolyFit.pretrained(name="paper").frame_of(vertices)


def _corners(rendered, shown, vertices, faces, where):
    """The template's vertex at each vertex (V, 3) that Mitsuba renders: its loaders split vertices
    along seams, but keep the order of the faces.
    """
    limit, used = 1e-4 * np.ptp(vertices, axis=0).max(), np.unique(shown)
    if shown.shape == faces.shape:
        corner = np.zeros(len(rendered), dtype=np.int64)
        corner[shown] = faces
        if np.abs(vertices[corner] - rendered)[used].max() <= limit:
            return corner
    distance, corner = cKDTree(vertices).query(rendered)
    farthest = distance[used].max()
    if farthest > limit:
        raise InputError(
            f"{where}: its vertices are not those that Mitsuba loads (up to {farthest:.3g} m apart)"
        )
    return corner
