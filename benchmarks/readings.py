"""How far each reading of the paper's image losses sees: on the straight way from the surface of
one frame to that of the next, what is left of the loss against the next frame.

    python -m polysft_mi.run scenes/kinect_paper.xml -D data=DATA/kinect_paper -o RUN
    python benchmarks/readings.py RUN [--frames 115 131 136 144] [-o docs]

RUN is a finished run, whose surfaces are taken for the truth. A descent can follow a fast motion
only if the loss falls from the start. The paper says "RGB and silhouette loss as defined in" φ-SfT,
whose program takes the mean absolute difference of pixel values as they are stored, and of blurred
masks. What stands for the masks is the silhouette of the next surface. Writes ``readings.json``:
by reading and frame, the share of the loss that is left after 10, 35, 65 and 100 % of the way.
"""

import argparse
import os

import numpy as np
from scipy.ndimage import gaussian_filter

from polyfit.backend import add_mode_argument, set_variant
from polysft_mi.errors import cli

WAY = (0.0, 0.1, 0.35, 0.65, 1.0)
BLURS, MASK_BLURS = (1.5, 3.0, 6.0), (0.0, 5.0)  # standard deviations [pixels]


def readings(image, alpha, frame, mask):
    """Each reading's loss of an image (H, W, 3), linear, with its alpha (H, W), against a frame
    and its mask; a mean over what the surface fills.
    """
    from polyfit.colours import srgb

    inside = alpha > 0.999
    difference = image - frame
    stored = srgb(image) - srgb(frame)
    found = {
        "l1": np.sqrt((difference**2).mean(-1))[inside].mean(),
        "l1 of each channel, sRGB": np.abs(stored)[inside].mean(),
        "l2": (difference**2).mean(-1)[inside].mean(),
    }
    for sigma in BLURS:
        blurred = gaussian_filter(difference * inside[..., None], (sigma, sigma, 0))
        found[f"l1, blur {sigma:g}"] = np.sqrt((blurred**2).mean(-1))[inside].mean()
    for sigma in MASK_BLURS:
        blurred = gaussian_filter(alpha - mask, sigma) if sigma else alpha - mask
        found[f"silhouette, blur {sigma:g}"] = np.abs(blurred).sum() / mask.sum()
    return found


def measure(run, frames):
    """Reading to frame to the shares of the loss that are left along :data:`WAY`, but for its
    start.
    """
    import mitsuba as mi

    from polysft_mi.objective import Problem
    from polysft_mi.scene import load

    experiment = load(os.path.join(run.folder, "scene.xml"))
    sequence = experiment.sequence()
    placed = Problem(experiment, sequence).placed
    at = {int(frame): k for k, frame in enumerate(run.frames)}

    def seen(vertices):
        points = mi.Point3f(np.ascontiguousarray(vertices.T, np.float32))
        image, alpha = (np.array(x) for x in placed.image(points))
        return image, alpha[..., 0]

    out = {}
    for frame in frames:
        k = at[frame]
        start, end = run.vertices[k - 1 : k + 1].astype(np.float64)
        mask = seen(end)[1]
        losses = [
            readings(*seen((1 - share) * start + share * end), sequence.frame(k), mask)
            for share in WAY
        ]
        for name, first in losses[0].items():
            out.setdefault(name, {})[str(frame)] = [x[name] / first for x in losses[1:]]
    return out


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", metavar="RUN", help="folder of a finished run")
    parser.add_argument("--frames", nargs="+", type=int, default=(115, 131, 136, 144))
    parser.add_argument("-o", "--out", metavar="FOLDER", default="out/benchmarks")
    add_mode_argument(parser)
    options = parser.parse_args(arguments)
    set_variant(options.mode)
    from polysft_mi import Run
    from polysft_mi.results import outputs

    found = measure(Run.open(options.run), options.frames)
    os.makedirs(options.out, exist_ok=True)
    outputs.write_json(os.path.join(options.out, "readings.json"), found)
    for name, rows in found.items():
        print(f"{name:26s}", *(f"{frame}: {x[1]:.2f}" for frame, x in rows.items()))


if __name__ == "__main__":
    cli(main)
