"""What commands ask of garments' files. Loads no torch."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from polyfit.errors import InputError, Parser

_PLAIN = dict(
    made_for=None, loose=False, scale=1.0, up=None, turn=0.0, offset=(0.0, 0.0, 0.0)
)  # as Garment.read has them


def add_place_arguments(group: Any) -> None:
    """``--scale``, ``--up``, ``--turn`` and ``--offset`` of :meth:`onefit.Garment.read`."""
    group.add_argument(
        "--scale",
        type=float,
        default=1.0,
        help="factor to metres: 0.01 for centimetres (default: 1)",
    )
    group.add_argument(
        "--up",
        choices=("z", "y"),
        help="the axis that points up (default: of .glb y, as glTF has it, or z)",
    )
    group.add_argument(
        "--turn", type=float, default=0.0, help="rotation about the vertical [degrees] (default: 0)"
    )
    group.add_argument(
        "--offset",
        nargs=3,
        type=float,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"),
        help="translation [m]",
    )


def add_mesh_arguments(p: Parser) -> Any:
    """The group of arguments that :func:`read_options` needs."""
    group = p.add_argument_group("a garment's mesh that is not in metres around the standard body")
    add_place_arguments(group)
    group.add_argument(
        "--made-for",
        choices=("T-pose",),
        help="T-pose: the standard body with its arms stretched out",
    )
    group.add_argument(
        "--loose", action="store_true", help="a skirt or dress: the legs' pose is not followed"
    )
    return group


def read_options(names: Sequence[str], args: argparse.Namespace) -> dict[str, Any]:
    """What was given of :func:`add_mesh_arguments`, as options of :meth:`onefit.Garment.read`, for
    the garments called ``names``. Raises InputError where none of them is a file, which these speak
    of.
    """
    from .garment import LOOSE, TEMPLATES

    given = {name: getattr(args, name) for name in _PLAIN} | {"offset": tuple(args.offset)}
    given = {name: value for name, value in given.items() if value != _PLAIN[name]}
    if given and all(name in TEMPLATES + LOOSE for name in names):
        flag = next(iter(given)).replace("_", "-")
        which = f"{names[0]} is a template" if names else "there are templates alone"
        raise InputError(f"--{flag}: for a garment's file; {which}, which lies on the body")
    return given
