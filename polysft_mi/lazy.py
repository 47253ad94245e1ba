"""Packages whose names are imported when they are asked for."""

import importlib
import sys

import lazy_loader

from .errors import InputError

_WITHOUT_VARIANT = "before setting a variant"  # as Mitsuba says it


def attach(package, handed_on=None, with_variant=(), **names):
    """:func:`lazy_loader.attach`, where a name that needs a Mitsuba variant says so. Its own error,
    an AttributeError, would tell that there is no such name. ``handed_on``: names of modules of
    other packages, which are names of this one, too. ``with_variant``: names that say so before
    Mitsuba is imported: Dr.Jit would then have taken an LLVM, and a variant come too late.
    """
    get, _, own = lazy_loader.attach(package, **names)
    home = {name: module for module, others in (handed_on or {}).items() for name in others}
    everything = sorted([*own, *home])

    def __getattr__(name):
        if name in home:
            return getattr(importlib.import_module(home[name]), name)
        mitsuba = sys.modules.get("mitsuba")
        if name not in with_variant or (mitsuba and mitsuba.variant()):
            try:
                return get(name)
            except AttributeError as error:
                if _WITHOUT_VARIANT not in str(error):
                    raise
        raise InputError(
            f"{package}.{name} needs a Mitsuba variant: call polysft_mi.set_variant() first"
        )

    return __getattr__, everything.copy, everything
