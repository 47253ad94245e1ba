"""A rendering as a loss in torch: `python examples/torch_loss.py`.

Torch holds the vertices of the demo's sheet, Mitsuba renders them, and torch's autograd goes
through the rendering. The sheet starts 6 mm beside its place in the first frame; the image alone
pulls it back.

Look at the last line: the distance falls to a fraction of a millimetre. To train a network, let it
make the vertices; ``bridge.surface`` does so with a PolyFit.
"""

import argparse
from pathlib import Path

import torch

import polysft_mi
from polyfit.errors import cli, number

DEMO = Path(__file__).parents[1] / "scenes" / "demo.xml"


def main(steps=30):
    """Returns the distances [mm] of the sheet from its place, one a step."""
    steps = number("--steps", steps, 1, whole=True)
    polysft_mi.set_variant()
    from polysft_mi import bridge

    experiment = polysft_mi.load(str(DEMO))
    sequence = polysft_mi.Sequence.open(experiment.frames, experiment.masks, size=experiment.size)
    problem = polysft_mi.Problem(experiment, sequence)
    render = bridge.rendering(problem)  # vertices (N, 3) -> rgb (H, W, 3), alpha (H, W)

    place = torch.tensor(experiment.template.vertices, dtype=torch.float32)
    image = torch.tensor(sequence.frame(0), dtype=torch.float32)
    mask = torch.tensor(sequence.mask(0), dtype=torch.float32)
    shift = torch.tensor([0.006, 0.0, 0.0], requires_grad=True)  # metres
    adam = torch.optim.Adam([shift], lr=6e-4)

    distances = []
    for _ in range(steps):
        rgb, alpha = render(place + shift)
        loss = ((rgb - image * mask[..., None]) ** 2).mean() + ((alpha - mask) ** 2).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        distances.append(1e3 * float(shift.detach().norm()))
    return distances


def command():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=30)
    found = main(parser.parse_args().steps)
    print(f"distance: {found[0]:.2f} mm after the first step, {found[-1]:.2f} mm after the last")


if __name__ == "__main__":
    cli(command)
