"""What commands ask of motion files."""


def add_file_arguments(parser):
    """``--fps`` and ``--motion-up`` of :meth:`onefit.Motion.read`; loads no torch."""
    parser.add_argument(
        "--fps", type=float, help="frames a second of a motion file (default: as the file says)"
    )
    parser.add_argument(
        "--motion-up",
        choices=("y", "z"),
        help="the axis that points up in a motion file (default: that of its format)",
    )
