"""How much OneFit's drapes are like cloth: folds, swing and strain beside a simulation of the same
garment on the same body, by a simulator that shares no code with OneFit.

    pip install newton                                  # for this benchmark only
    python benchmarks/onefit_reference.py CACHE         # dress and skirt in a dance, 2 s
    python benchmarks/onefit_reference.py CACHE --garments tshirt circle_skirt \\
        --motions dance box --picture side.jpg --video side.mp4

Simulations are kept in CACHE; one that is cut short goes on where it was. 2 s take 9 minutes for
the skirt and 14 for the dress, on one core. The rows of the table: *skinning* is plain skinning of
the template; the drape of each network of ``--weights``, and what OneFit's simulation makes of it;
*Newton* is that simulator's vertex block descent (:mod:`cloth_simulation`).

Columns. wave, fold [degrees], swing, hang [mm], strain [%]: :mod:`onefit.objective.folds`. inside
[%] of the vertices in the body, and of the faces' middles. jitter [mm]: mean second difference in
time. rims [mm]: how far the loops of the boundary, all but the lowest, are in the mean from where
plain skinning has them; the worst of them. A strap that slides off a shoulder shows there, and a
sleeve that bunches up. crossings: pairs of faces that pass through each other.
"""

import argparse
import hashlib
import json
import os

import cloth_simulation
import numpy as np
import torch
from rich.progress import Progress

import onefit
from onefit.body import ClosestSurface, skinning
from onefit.draping import inputs
from onefit.draping.draper import FPS
from onefit.garment import waistband
from onefit.network import DEFAULT
from onefit.objective import crossings
from onefit.objective.folds import folds, inner_edges
from onefit.physics import MATERIALS, Material
from polyfit.errors import InputError, cli
from polyfit.files import aside
from polyfit.mesh import loops

SEED = 1_000_003  # of motions, that no training uses
CHECKPOINT = 10  # frames


def simulated(folder, garment, motion, body, material, settings, advance=lambda: None):
    """Vertices (T, N, 3) [m] of the garment on ``body`` in the T frames of ``motion``, from the
    cache or now. ``advance`` is called for each frame.
    """
    motion = motion.resampled(FPS)
    rest = garment.graded(body)
    about = cloth_simulation.description(material, settings)
    hashed = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    lengths = garment.rest_lengths(garment.faces[:, :2], rest)
    for array in (rest, lengths, garment.faces, motion.poses, motion.translation, body.vertices):
        hashed.update(np.ascontiguousarray(array.numpy()).tobytes())
    path = os.path.join(folder, f"{garment.name}-{motion.name}-{hashed.hexdigest()[:12]}.npz")
    os.makedirs(folder, exist_ok=True)
    done, state = [], None
    if os.path.exists(path):
        with np.load(path) as file:
            done, state = list(file["vertices"]), file["state"]
    poses, translation, lead = _led_in(body, motion, settings)
    frames = len(poses)
    for _ in done:
        advance()
    if len(done) == frames:
        return torch.as_tensor(np.array(done[lead:]))
    maps = skinning.transforms(body, poses, translation)
    surface = skinning.skin(body.vertices, body.blend_weights, maps).numpy()
    held = waistband.held(rest.numpy(), garment.faces.numpy(), body.joints.numpy()) > 0.5
    moved = skinning.skin(rest[held], garment.blend_weights[held], maps).numpy()
    simulation = cloth_simulation.Simulation(
        rest.numpy(), garment.faces.numpy(), garment.sides(rest).double().numpy(), held,
        surface[0], body.faces.numpy(), material, settings,
    )  # fmt: skip
    if state is not None:
        simulation.state = state
    else:
        done = [rest.numpy()]
    while len(done) < frames:
        done.append(simulation.frame(surface, moved, len(done) - 1, FPS).astype(np.float32))
        if not np.isfinite(done[-1]).all():
            raise RuntimeError(f"{garment.name}: the simulation blew up in frame {len(done)}")
        advance()
        if len(done) % CHECKPOINT == 0 or len(done) == frames:
            with aside(path) as temporary:
                np.savez_compressed(
                    temporary, vertices=np.array(done, np.float32), state=simulation.state
                )
    return torch.as_tensor(np.array(done[lead:]))


def _led_in(body, motion, settings):
    """Poses, translations and how many frames come before the motion's own: from the body's rest,
    in which garments are made, to its first pose.
    """
    lead, hold = round(settings.lead * FPS), round(settings.hold * FPS)
    share = torch.linspace(0, 1, lead + 1)[:-1, None, None]
    share = share * share * (3 - 2 * share)
    first, place = motion.poses[:1], motion.translation[:1]
    poses = body.rest_pose + share * (first - body.rest_pose)
    translation = share[:, 0] * place
    return (
        torch.cat([poses, first.expand(hold, -1, -1), motion.poses]),
        torch.cat([translation, place.expand(hold, -1), motion.translation]),
        lead + hold,
    )


def contenders(garment, motion, shape, drapers, material):
    """Drapes by name: plain skinning, and of each draper its drape and its simulation."""
    first = next(iter(drapers.values()))
    out = {"skinning": first.drape(garment, motion, shape, skinning_only=True)}
    for name, draper in drapers.items():
        out[name] = draper.drape(garment, motion, shape)
        made = draper.simulate(garment, motion, shape, material=material)
        out[f"{name}, simulated"] = made
    return out


def figures(vertices, skinned, garment, rest):
    """The row's numbers of vertices (T, N, 3) [m]; ``skinned``: the :class:`onefit.Drape` of plain
    skinning.
    """
    F, plain = garment.faces, skinned.vertices
    lengths = garment.rest_lengths(inner_edges(F)[0], rest)
    found = folds(vertices, plain, F, lengths.double())
    collider = ClosestSurface(skinned.body[0], skinned.body_faces)
    points = torch.cat([vertices, vertices[:, F].mean(2)], 1)
    inside = torch.stack(
        [collider.distances(x[None], b[None])[0] < 0 for x, b in zip(points, skinned.body)]
    ).float()
    second = vertices[2:] - 2 * vertices[1:-1] + vertices[:-2]
    z = garment.vertices[:, 2]
    rims = sorted(loops(F.numpy()), key=lambda loop: z[loop].mean())[1:]
    away = [1e3 * float((vertices - plain)[5:, loop].norm(dim=-1).mean()) for loop in rims]
    return [
        found.wave, found.fold, found.swing, found.hang, found.strain,
        100 * float(inside[:, : len(z)].mean()), 100 * float(inside[:, len(z) :].mean()),
        1e3 * float(second.norm(dim=-1).mean()), max(away),
        np.mean([crossings(x, F.numpy()) for x in vertices[::FRAME_STEP].numpy()]),
    ]  # fmt: skip


HEAD = (
    "| garment | motion | | wave ° | fold ° | swing mm | hang mm | strain % | inside % | faces % |"
    " jitter mm | rims mm | crossings |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)
DIGITS = (1, 1, 0, 0, 2, 2, 2, 2, 0, 1)
FRAME_STEP = 3  # one frame in so many is looked at for crossings


def pictures(drapes, skinned, frames, size, spp):
    """Images (H, W, 3) uint8, one a frame of ``frames``: the drapes side by side."""
    from polyfit.backend import set_variant

    set_variant()
    from onefit.draping.output import BODY_COLOUR, GARMENT_COLOURS
    from polyfit.pictures import stage

    body = (skinned.body[frames].numpy(), skinned.body_faces.numpy(), BODY_COLOUR)
    rows = [
        stage.render(
            [body, (x[frames].numpy(), skinned.faces.numpy(), GARMENT_COLOURS[0])],
            size=size, spp=spp, follow=True, near=1,
        )
        for x in drapes.values()
    ]  # fmt: skip
    for images in zip(*rows):
        yield [_titled(image, name) for image, name in zip(images, drapes)]


def _titled(image, text):
    import cv2

    image = np.ascontiguousarray(image)
    place, font = (8, 20), cv2.FONT_HERSHEY_SIMPLEX
    return cv2.putText(image, text, place, font, 0.5, (20, 20, 20), 1, cv2.LINE_AA)


def parser():
    raw = argparse.RawDescriptionHelpFormatter
    p = argparse.ArgumentParser(
        prog="python benchmarks/onefit_reference.py", description=__doc__, formatter_class=raw
    )
    p.add_argument("cache", metavar="CACHE", help="folder of the simulations")
    p.add_argument("--garments", nargs="+", default=["dress", "skirt"], metavar="GARMENT")
    p.add_argument("--motions", nargs="+", default=["dance"], metavar="MOTION")
    p.add_argument("--seconds", type=float, default=2.0)
    p.add_argument("--seed", type=int, default=SEED)
    p.add_argument("--shape", nargs="*", default=[], metavar="NAME=VALUE")
    p.add_argument("--weights", nargs="+", default=[DEFAULT], metavar="WEIGHTS")
    p.add_argument("--material", default="cotton", choices=list(MATERIALS))
    p.add_argument("--picture", metavar="FILE.jpg", help="moments of all, side by side")
    p.add_argument("--moments", type=int, default=4, help="of a motion in the picture (default: 4)")
    p.add_argument("--video", metavar="FILE.mp4", help="all frames, side by side")
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    material = Material.named(args.material)
    settings = cloth_simulation.Settings()
    drapers = {name: onefit.load(name) for name in args.weights}
    first = next(iter(drapers.values()))
    shape = inputs.shape_of(first.model, args.shape)
    body, lines, strips, films = first.model.body(shape), [HEAD], [], []
    with Progress() as progress:
        for garment in map(first.garment, args.garments):
            for kind in args.motions:
                motion = inputs.motion_of(kind, seconds=args.seconds, seed=args.seed)
                drapes = contenders(garment, motion, shape, drapers, material)
                skinned = drapes["skinning"]
                task = progress.add_task(f"{garment.name}, {kind}", total=None)
                moved = motion if shape is None else motion.fitted(body)
                x = simulated(
                    args.cache, garment, moved, body, material, settings,
                    lambda: progress.advance(task),
                )  # fmt: skip
                vertices = {name: drape.vertices for name, drape in drapes.items()}
                vertices["Newton"] = x
                for name, v in vertices.items():
                    row = figures(v, skinned, garment, skinned.rest)
                    cells = " | ".join(f"{n:.{d}f}" for n, d in zip(row, DIGITS))
                    lines.append(f"| {garment.name} | {kind} | {name} | {cells} |")
                if args.picture:
                    frames = np.linspace(8, len(x) - 1, args.moments + 1)[1:].astype(int)
                    shown = pictures(vertices, skinned, frames, (420, 330), 128)
                    strips.append(np.vstack([np.hstack(row) for row in shown]))
                if args.video:
                    shown = pictures(vertices, skinned, np.arange(len(x)), (420, 330), 64)
                    films += [np.hstack(row) for row in shown]
    print("\n".join(lines))
    if strips:
        import cv2

        if len({s.shape[1] for s in strips}) > 1:
            raise InputError("--picture: all rows need the same drapes")
        cv2.imwrite(args.picture, np.vstack(strips)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
    if films:
        from polyfit.pictures import write_video

        write_video(args.video, films, FPS)


if __name__ == "__main__":
    cli(main)
