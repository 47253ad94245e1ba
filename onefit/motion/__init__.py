"""Motions: a file (AMASS, NCS, BVH) or the name of a kind of motion goes in; poses and translations
of 24 joints over time come out.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "arguments": ["add_file_arguments"],
        "generate": ["KINDS"],
        "likely": ["check_ways"],
        "motion": ["Motion"],
    },
)
