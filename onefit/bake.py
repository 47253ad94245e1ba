"""Bakes a garment's drape into bones, corrective shapes and a small network, which games and
browsers evaluate in two tenths of a millisecond.

    python -m onefit.bake skirt -o OUT
    python -m onefit.bake shirt.obj -o OUT --vertices 4000 --motions dance walk motion.npz

It drapes the garment in some minutes of generated motion, and takes minutes itself. OUT receives

    baked.npz       all of it as arrays, which onefit.baking.Baked evaluates by NumPy alone
    NAME.glb        of each motion: skinned meshes with morph targets, which any viewer plays
    baked.html      a page that computes the cloth in the browser, from the poses of all motions
"""

import argparse
import os
from functools import partial
from pathlib import Path

from onefit.draping import command
from onefit.network import DEFAULT
from polyfit.errors import InputError, Parser, cli, require
from polyfit.files import check_aside, folder_aside

SECONDS, SEED = 6.0, 1_000_000  # of a generated motion
_SIGN = "baked.npz"  # of a folder that this command wrote


def _parser():
    raw = argparse.RawDescriptionHelpFormatter
    p = Parser(prog="python -m onefit.bake", description=__doc__, formatter_class=raw)
    p.add_argument(
        "garment", metavar="GARMENT", help="a template's name, a mesh or a sewing pattern"
    )
    p.add_argument("-o", "--output", required=True, metavar="OUT", help="folder of the results")
    p.add_argument(
        "--motions",
        nargs="+",
        default=["dance", "walk", "jumping_jack"],
        metavar="MOTION",
        help="what glTF and the page show, at 30 frames a second: files, or generated kinds"
        " (default: dance walk jumping_jack)",
    )
    command.add_garment_arguments(p)
    command.add_motion_arguments(p, SECONDS, SEED)
    p.add_argument(
        "--shape", nargs="*", default=[], metavar="NAME=VALUE", help="of the body: weight=0.7"
    )
    p.add_argument("--weights", default=DEFAULT, help=f"of the network (default: {DEFAULT})")
    p.add_argument("--overwrite", action="store_true", help="replace an earlier one in OUT")
    return p


def main(argv=None):
    args = _parser().parse_args(argv)
    require("torch", "anny", "pygltflib")

    from onefit.baking import bake, write_glb, write_page
    from onefit.draping import body_model, load, shape_of

    folder = Path(args.output)
    ours = partial(_is_ours, folder)
    check_aside(folder, ours, _SIGN, "baked drape", args.overwrite)
    model = body_model("anny")
    shape = shape_of(model, args.shape)
    motions = command.motions_of(args.motions, args, SECONDS, SEED)
    names = [motion.name for motion in motions]
    for name, motion in zip(args.motions, names):
        if names.count(motion) > 1:
            raise InputError(f"--motions {name}: another one would be {motion}.glb, too")
    (garment,) = command.garments_of([args.garment], args)
    with _progress() as advance:
        draper = load(args.weights, model=model)
        baked = bake(draper, garment, shape, advance=advance)
    body = model.body(shape)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder_aside(folder, ours, _SIGN) as temporary:
        baked.save(Path(temporary) / "baked.npz")
        for motion in motions:
            write_glb(Path(temporary) / f"{motion.name}.glb", baked, body, motion)
        write_page(Path(temporary) / "baked.html", baked, body, motions)
    print(folder)
    print(f"next: open {folder / 'baked.html'} in a browser")


def _is_ours(folder, path):
    """Whether the file ``path`` in ``folder`` is one that baking wrote: of the .glb those of the
    motions that the page plays.
    """
    page, (motion, extension) = folder / "baked.html", os.path.splitext(path)
    if extension == ".glb" and page.is_file():
        from onefit.baking import is_in_page

        return is_in_page(page, motion)
    return path in ("baked.npz", "baked.html")


def _progress():
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    @contextmanager
    def running():
        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            tasks = {}

            def advance(stage, share):
                if stage not in tasks:
                    tasks[stage] = progress.add_task(stage, total=1.0)
                progress.update(tasks[stage], completed=share)

            yield advance

    return running()


if __name__ == "__main__":
    cli(main)
