"""Analytic surfaces and meshes of garments go in; trained weights come out, with a log and what
made them. The loop, its checkpoints and its processes serve other trainings too.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "garments": ["GarmentPatches", "cut_meshes"],
        "loop": ["Training", "conduct"],
        "losses": ["Discrepancy", "share_behind", "discrepancy"],
        "processes": ["Processes", "add_run_arguments", "device_of", "run"],
        "settings": ["LOSSES", "MODELS", "PRESETS", "Settings"],
        "trainer": ["train"],
    },
)
