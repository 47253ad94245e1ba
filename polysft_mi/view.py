"""``python -m polysft_mi.view OUT``: a run, or a drape, in the browser, to turn, play and colour;
a run may still be at work.
"""

import errno
import os
import socket

from . import commands
from .errors import InputError, cli
from .pictures import Source, Viewer

_EXAMPLES = [
    ("out/demo", "then open the address that it prints"),
    ("out/demo --frame 40", "begins with the frame of index 40"),
    ("out/drape --port 9000 --host 0.0.0.0", "of onefit.drape; other machines may look, too"),
]


def parser():
    p = commands.parser(
        "view",
        "Look at a run or a drape in the browser, also while the run is at work (by viser, of the"
        " optional extra 'view').",
        _EXAMPLES,
    )
    p.add_argument("out", metavar="OUT", help="folder of a run, or of a drape")
    p.add_argument(
        "--frame",
        type=int,
        metavar="K",
        help="frame to begin with, by its index (default: the first; of a run at work the newest)",
    )
    p.add_argument(
        "--port", type=int, default=8080, help="the first port to try; 0: any (default: 8080)"
    )
    p.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen at; 0.0.0.0 lets other machines in (default: this one alone)",
    )
    return p


def open_viewer(arguments=None):
    """The :class:`~polysft_mi.pictures.viewer.Viewer` that the arguments ask for, serving."""
    options = parser().parse_args(arguments)
    if not 0 <= options.port < 65536:
        raise InputError(f"--port {options.port}: a port from 0 to 65535 is needed")
    source, port = Source(options.out), _free_port(options.host, options.port)
    return Viewer(source, host=options.host, port=port, frame=options.frame)


def _free_port(host, first):
    """The first port from ``first`` on that can be listened at. Raises InputError where none can:
    viser would wait for one for ever.
    """
    for port in range(first, min(first + 1000, 65536)):
        try:
            family = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM)[0][0]
            socket.create_server((host, port), family=family).close()
            return port
        except OSError as error:
            unknown = isinstance(error, socket.gaierror)
            problem = error.strerror if unknown else os.strerror(error.errno)
            if unknown or error.errno == errno.EADDRNOTAVAIL:
                break
    raise InputError(
        f"--host {host} --port {first}: {problem}; an address of this machine, such as 127.0.0.1 or"
        " 0.0.0.0, and a free port are needed"
    )


def main(arguments=None):
    viewer = open_viewer(arguments)
    print(f"open {viewer.address} in a browser; Ctrl-C ends it", flush=True)
    viewer.run()
    return 0


if __name__ == "__main__":
    cli(main)
