"""The text of a scene file: a whole experiment, for a sequence whose
:class:`polysft_mi.capture.layouts.Layout` is known.
"""

from xml.sax.saxutils import escape, quoteattr

from polysft_mi.errors import InputError
from polysft_mi.scene import defaults_xml, properties_xml


def scene_xml(layout, data, template=None, comment=""):
    """The scene file's text.

    ``data``: the sequence's folder, as the scene shall name it by default. ``template``: the file
    of the template; by default the layout's ``obj`` in the data's folder, or the plugin
    ``varol_template`` where the form has no such file. ``comment`` stands at the top. Raises
    InputError for a path that a scene file cannot hold.
    """
    for path in (data, template):
        if "$" in str(path):
            raise InputError(
                f"{path}: '$' in a path cannot be written in a scene file; rename the folder"
            )
    comment = comment or f"Shape from template on a sequence in the form {layout.form}."
    masks = f"$data/{layout.masks}" if layout.masks else ""
    return f"""<scene version="3.0.0">
    <!-- {escape(comment).replace("--", "- -")} -->

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

{layout.camera.sensor_xml(world_to_camera=layout.world_to_camera)}

{_template_xml(layout, template)}

    <!-- Radiance 1 from everywhere: on an unshadowed sheet, path replay sees the texture's own colour -->
    <emitter type="constant"/>
</scene>
"""  # noqa: E501


def _template_xml(layout, template):
    if template is None and layout.obj is None:
        head = """\
    <default name="resolution" value="33"/>
    <default name="pose_fit" value="auto"/>
    <shape type="varol_template" id="template">
        <string name="folder" value="$data"/>
        <integer name="resolution" value="$resolution"/>
        <string name="pose_fit" value="$pose_fit"/>
"""
    else:
        name = template if template is not None else f"$data/{layout.obj}"
        head = f"""\
    <shape type="obj" id="template">
        <string name="filename" value={quoteattr(name)}/>
"""
    if layout.flip:
        head += """\
        <transform name="to_world">
            <scale value="-1, -1, 1"/>  <!-- to the camera frame: x right, y down, z forward -->
        </transform>
"""
    return f"""{head}\
        <bsdf type="twosided">
            <bsdf type="diffuse">
                <texture type="bitmap" name="reflectance">
                    <string name="filename" value={quoteattr(f"$data/{layout.texture}")}/>
                    <string name="wrap_mode" value="clamp"/>
                </texture>
            </bsdf>
        </bsdf>
    </shape>"""
