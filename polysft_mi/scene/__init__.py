"""A whole experiment as one file.

In: a Mitsuba scene file with the plugin ``polysft``, and the images that it names. Out: an
:class:`Experiment` (scene, camera, template, settings) and its :class:`Sequence` of frames and
masks. :func:`load` and :func:`register` need a Mitsuba variant that is set; the rest needs no
Mitsuba.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "cameras": [
            "camera_names",
            "open_cameras",
            "read_camera",
            "read_cameras",
            "rigid_pose",
            "written",
        ],
        "defaults": ["known_defaults", "located", "resolved_defaults"],
        "evidence": ["DepthImages", "Tracks"],
        "experiment": ["Experiment", "load"],
        "images": [
            "EXTENSIONS",
            "checked_size",
            "focal_35mm",
            "image_size",
            "list_images",
            "read_mask",
            "read_pixels",
            "read_rgb",
        ],
        "plugins": ["register"],
        "rules": ["Rules"],
        "sequence": ["Sequence", "drop_stray_components", "inverted"],
        "settings": ["PRESETS", "Settings", "defaults_xml", "properties_xml"],
        "start": ["check_depth", "check_seen", "check_tracks"],
    },
)
