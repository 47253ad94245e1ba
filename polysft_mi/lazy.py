"""Packages whose names are imported when they are asked for."""

import lazy_loader

from .errors import InputError

_WITHOUT_VARIANT = "before setting a variant"  # as Mitsuba says it


def attach(package, **names):
    """:func:`lazy_loader.attach`, where a name that needs a Mitsuba variant says so. Its own error,
    an AttributeError, would tell that there is no such name.
    """
    get, names_of, everything = lazy_loader.attach(package, **names)

    def __getattr__(name):
        try:
            return get(name)
        except AttributeError as error:
            if _WITHOUT_VARIANT not in str(error):
                raise
        raise InputError(
            f"{package}.{name} needs a Mitsuba variant: call polysft_mi.set_variant() first"
        )

    return __getattr__, names_of, everything
