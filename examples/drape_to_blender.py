"""A drape for Blender: `python examples/drape_to_blender.py`.

A network of the package drapes a T-shirt on a body that walks. Garment and body become two USD
files of moving meshes, in metres.

Look at them: in Blender, File > Import > Universal Scene Description, once for each file; set the
scene's rate to 30 frames a second, which the import leaves as it was; then press the space bar. The
add-on of docs/blender.md opens a folder that `python -m onefit.drape` wrote, with its rate.
"""

import argparse
from pathlib import Path

import onefit
from polyfit.animation import write_usd


def main(out="out/blender", garment="tshirt", seconds=2.0):
    """Returns the paths of the garment's and the body's file."""
    motion = onefit.Motion.generate("walk", seconds=seconds)
    drape = onefit.load().drape(garment, motion)
    Path(out).mkdir(parents=True, exist_ok=True)
    parts = {
        Path(garment).stem: (drape.vertices, drape.faces),
        "body": (drape.body, drape.body_faces),
    }
    paths = []
    for name, (vertices, faces) in parts.items():
        paths.append(Path(out) / f"{name}.usdc")
        write_usd(paths[-1], vertices.numpy(), faces.numpy(), fps=drape.fps, up="z", name=name)
    return paths


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", default="out/blender")
    parser.add_argument("--garment", default="tshirt", help="a template's name, or a mesh")
    args = parser.parse_args()
    for path in main(args.output, args.garment):
        print(path)
