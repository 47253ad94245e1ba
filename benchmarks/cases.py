"""The cases that a benchmark goes through, as its command line has them: image sizes and
templates.
"""

from polysft_mi.errors import InputError


def add_case_arguments(parser, sizes, grids):
    """Add ``--sizes`` (texts WIDTHxHEIGHT) and ``--grids`` (vertices a side of square templates)
    with their defaults to an argparse parser.
    """
    parser.add_argument(
        "--sizes",
        nargs="+",
        metavar="WxH",
        default=sizes,
        help=f"image sizes (default: {' '.join(sizes)})",
    )
    shown = " ".join(map(str, grids))
    parser.add_argument(
        "--grids",
        nargs="+",
        type=int,
        metavar="N",
        default=grids,
        help=f"vertices a side of the templates (default: {shown})",
    )


def parse_size(text, least=16):
    """(width, height) [pixels] of a text such as 640x480. Raises InputError where it is none, or a
    side is below ``least``.
    """
    try:
        width, height = (int(x) for x in text.lower().split("x"))
        if min(width, height) < least:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--sizes {text}: WIDTHxHEIGHT is needed, at least {least}x{least}, such as 640x480"
        ) from None
    return width, height
