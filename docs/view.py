"""The picture of docs/view.md: what a browser draws of a run, in three of its colours.

    polysft demo -o out/demo
    python docs/view.py out/demo

It needs viser and Chromium.
"""

import argparse
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from polysft_mi.errors import InputError, cli
from polysft_mi.view import open_viewer

COLOURS, SIZE = ("texture", "score", "curvature"), (420, 460)  # (height, width) [pixels]


def pictures(run, frame, browser, patience=60):
    """One picture (H, W, 3) uint8 for each of COLOURS, drawn by ``browser``; ``patience``: seconds
    that it has for the first."""
    viewer = open_viewer([run, "--port", "0", "--frame", str(frame)])
    with tempfile.TemporaryDirectory() as profile:
        words = "--headless --no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader"
        words += f" --enable-unsafe-swiftshader --remote-debugging-port=0 --user-data-dir={profile}"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([browser, *words.split(), viewer.address], **quiet)
        try:
            until = time.monotonic() + patience
            while not viewer.server.get_clients():
                if time.monotonic() > until:
                    raise InputError(f"{browser}: does not open {viewer.address}")
                time.sleep(0.2)
            (client,) = viewer.server.get_clients().values()
            found = []
            for colour in COLOURS:
                viewer.colour.value = colour
                for _ in range(20):  # until the browser has loaded it, and hidden what was before
                    viewer.step()
                    time.sleep(0.3)
                found.append(client.get_render(*SIZE)[..., :3])
        finally:
            process.terminate()
            process.wait()
            viewer.close()
    return found


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", metavar="OUT", help="folder of a run")
    parser.add_argument("--frame", type=int, default=11)
    parser.add_argument("-o", "--output", default=str(Path(__file__).with_name("view.jpg")))
    options = parser.parse_args(arguments)
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise InputError("no Chromium is installed (Debian, Ubuntu: apt-get install chromium)")
    row = np.concatenate(pictures(options.run, options.frame, browser), 1)
    used = np.flatnonzero((row < 250).any((1, 2)))
    row = row[max(0, used[0] - 12) : used[-1] + 12]
    Image.fromarray(row).save(options.output, quality=88)
    print(options.output)


if __name__ == "__main__":
    cli(main)
