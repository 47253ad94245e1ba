"""Loading an experiment: a Mitsuba scene with a ``polysft`` integrator, its template mesh, its defaults.

Import only after a Mitsuba variant is set.
"""

import os
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from . import meshio, plugins
from .defaults import located, resolved_defaults
from .errors import InputError
from .settings import Settings
from .template import Template


@dataclass
class Experiment:
    """What a scene file describes, loaded: the scene, the template in it, the video's place, and the settings.

    ``corner`` (V,) is the template vertex of each vertex that Mitsuba renders (its loaders split vertices along texture seams);
    ``defaults`` maps each ``<default>`` to the value in force.
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

    @property
    def size(self):
        """(width, height) of the film's crop window, pixels."""
        return tuple(int(x) for x in self.sensor.film().crop_size())


def load(path, overrides=None):
    """Load a scene file as an :class:`Experiment`; ``overrides`` maps names of its defaults to text.

    Raises InputError for whatever a user can get wrong in it.
    """
    path = os.fspath(path)
    overrides = {k: str(v) for k, v in (overrides or {}).items()}
    defaults = resolved_defaults(path, overrides)
    plugins.register()
    if defaults.get("data") and not os.path.isdir(located(path, defaults["data"])):
        raise InputError(f"{path}: data = {defaults['data']}: no such folder, neither beside the scene nor here; give -D data=FOLDER")
    template_node = _check_nodes(path, overrides)
    try:
        scene = mi.load_file(path, optimize=False, **overrides)
    except Exception as error:  # whatever a plugin raised reaches us wrapped by the parser
        raise InputError(f"{path}: {_innermost(error)}") from None

    experiment = scene.integrator()
    if not isinstance(experiment, plugins.PolySfT):
        raise InputError(f"{path}: its integrator is {type(experiment).__name__}; <integrator type=\"polysft\"> is needed")
    if len(scene.sensors()) != 1:
        raise InputError(f"{path}: {len(scene.sensors())} sensors; exactly one is needed")
    meshes = [s for s in scene.shapes() if s.is_mesh() and s.id() == "template"] or [s for s in scene.shapes() if s.is_mesh()]
    if len(meshes) != 1:
        raise InputError(f"{path}: {len(meshes)} meshes; give the template's shape id=\"template\"")
    mesh, settings = meshes[0], experiment.settings
    template, corner = _template(mesh, template_node, settings)
    return Experiment(
        path, scene, scene.sensors()[0], experiment.renderer, mesh, template, corner, experiment.frames, experiment.masks, settings, defaults
    )


def _innermost(error):
    """The last line of a parser's message that says something, without its location prefix."""
    text = str(error).split("Caused by:")[-1]
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    useful = [line for line in lines if "Error" in line or "not" in line or "fail" in line.lower()]
    line = (useful or lines or [repr(error)])[-1]
    for prefix in ("polysft_mi.errors.InputError: ", "InputError: "):
        if prefix in line:
            line = line.split(prefix)[-1]
    return line


def _check_nodes(path, overrides):
    """Parse the file, check that the files it names are there, and return the properties of the template's shape (or None)."""
    config = mi.parser.ParserConfig(mi.variant())
    try:
        state = mi.parser.parse_file(config, path, **overrides)
    except Exception as error:
        raise InputError(f"{path}: {_innermost(error)}") from None
    shapes = []
    for node in state.nodes:
        props = node.props
        if "filename" in props and isinstance(props["filename"], str):
            name = located(path, props["filename"])
            if not os.path.isfile(name):
                raise InputError(f"{name}: no such file (filename of <{props.plugin_name()}> in {path})")
            props["filename"] = name
        if props.plugin_name() in ("obj", "ply", "serialized", "varol_template"):
            shapes.append(props)
    return next((p for p in shapes if p.id() == "template"), shapes[0] if shapes else None)


def _template(mesh, props, settings):
    """The template that the mesh shows, in its file's own vertex order, and the map from rendered vertices to it."""
    rendered = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    where = f"template {mesh.id()!r}"
    if not mesh.has_vertex_texcoords():
        raise InputError(f"{where}: it has no texture coordinates (uv); the texture cannot be placed on it")
    texcoords = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
    if props is not None and "filename" in props:
        where = props["filename"]
        vertices, faces, _ = meshio.read_template(where)
        if "to_world" in props:
            m = np.array(props["to_world"].matrix, dtype=np.float64).reshape(4, 4)
            vertices = vertices @ m[:3, :3].T + m[:3, 3]
    else:
        vertices, faces = rendered, np.array(mesh.faces_buffer(), dtype=np.int64).reshape(-1, 3)
    if not (np.isfinite(vertices).all() and np.isfinite(rendered).all() and np.isfinite(texcoords).all()):
        raise InputError(f"{where}: positions or texture coordinates are not finite (NaN)")
    distance, corner = cKDTree(vertices).query(rendered)
    size = np.ptp(vertices, axis=0).max()
    if distance.max() > 1e-4 * size:
        raise InputError(f"{where}: its vertices are not those that Mitsuba loads (up to {distance.max():.3g} m apart)")
    uv = np.zeros((len(vertices), 2))
    uv[corner[::-1]] = texcoords[::-1]
    uv[:, 1] = 1 - uv[:, 1]  # Mitsuba's v runs down, a file's up
    meshio.check_template(vertices, faces, uv, where)
    template = Template.fit(vertices, faces, uv, settings.order, tolerance=settings.fit_tolerance, where=where)
    return template, corner
