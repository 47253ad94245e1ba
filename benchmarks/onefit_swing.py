"""How much skirts hang and swing: networks beside the minimum of the very objective that they are
trained to lower.

    python benchmarks/onefit_swing.py       # dress and skirt in two motions, 4 min on one core
    python benchmarks/onefit_swing.py --garments shirt.obj --motions dance

*least* is no network: in each frame, after the two before it, the deformation of all patches is
what minimises the objective, found by Adam from the last frame's. ``hang``: how far the lowest
third of the garment is, in the mean over time, from where plain skinning has it, as seen from the
root joint; ``swing``: the root mean square of what is left without that mean. ``of it``: how much
of the least's hang and swing a network explains, 1 - |network - least|² / |least|²; 0 for plain
skinning. ``rim``: how far the highest rim is from where skinning has it, in the mean: what has
slipped. A garment that does not hang from the shoulders is held there
(:mod:`onefit.garment.waistband`).
"""

import argparse

import torch
from rich.progress import Progress

import onefit
from onefit.body import ClosestSurface, skinning
from onefit.garment import waistband
from onefit.garment.charts import Deformation
from onefit.network.network import OUTPUT_UNIT
from onefit.objective import losses, measure, objective
from polyfit.errors import cli

SEED = 1_000_000  # of motions, that no training uses
STEPS = 60  # of Adam in a frame, eight times as many in the first
RATE = 0.03  # in the units of the network's outputs, a tenth of it at the end
LOWEST = 0.3  # of the garment's height


def least(draper, garment, motion, advance=lambda: None):
    """Vertices (T, N, 3) [m] of the least objective, frame after frame, on the standard body."""
    body, patched = draper.standard, draper.patched(garment)
    transforms = skinning.transforms(body, motion.poses, motion.translation)
    bodies = skinning.skin(body.vertices, body.blend_weights, transforms)
    collider, rest = ClosestSurface(body.vertices, body.faces), garment.vertices[:, None]
    field = patched.field @ rest
    K, A = patched.alpha.shape
    sizes = dict(alpha=(1, K, A), translation=(1, K, 3), scale=(1, K), drift=(1, K, 3))
    unknowns = {name: torch.zeros(size, requires_grad=True) for name, size in sizes.items()}
    generator, past, out = torch.Generator().manual_seed(0), None, []
    for t in range(len(motion.poses)):
        scene = objective.Scene(transforms[t : t + 1], bodies[t : t + 1], collider, rest, field)
        steps = STEPS if past else 8 * STEPS
        adam = torch.optim.Adam(unknowns.values())
        for step in range(steps):
            adam.param_groups[0]["lr"] = RATE * (1 - 0.9 * step / steps)
            deformation = Deformation(
                **{name: x * OUTPUT_UNIT[name] for name, x in unknowns.items()}
            )
            terms, x = objective.evaluate(
                patched, deformation, scene, losses.Weights(), past=past, generator=generator
            )
            adam.zero_grad()
            sum(terms.values()).backward()
            adam.step()
        x = x.detach()
        past = (x, past[0] if past else x)
        out.append(x[:, 0])
        advance()
    return torch.stack(out)


def compared(vertices, skinned, reference, turned, lowest):
    """(hang, swing [mm], how much of the reference's they explain) of vertices (T, N, 3);
    ``turned`` (T, 3, 3): the root joint's rotation; ``lowest`` (N,): which vertices are looked at.
    The first five frames are left out."""
    ours, wanted = (
        torch.einsum("tji,tnj->tni", turned, (x - skinned)[:, lowest])[5:]
        for x in (vertices, reference)
    )
    mean = ours.mean(0)
    explained = 1 - (ours - wanted).square().sum() / wanted.square().sum()
    return (
        1e3 * mean.norm(dim=-1).mean(),
        1e3 * (ours - mean).square().sum(-1).mean().sqrt(),
        explained,
    )


def slipped(vertices, skinned, garment):
    """How far [mm] the highest rim of ``garment`` is from its place under plain skinning, in the
    mean, of vertices (T, N, 3) [m].
    """
    rim = waistband.highest_rim(garment.vertices.numpy(), garment.faces.numpy())
    return 1e3 * (vertices - skinned)[5:, rim].norm(dim=-1).mean()


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--garments",
        nargs="+",
        default=["dress", "skirt"],
        help="templates or meshes (default: dress and skirt)",
    )
    parser.add_argument(
        "--weights",
        nargs="+",
        default=list(onefit.pretrained()),
        help="networks of the package, or files",
    )
    parser.add_argument(
        "--motions", nargs="+", default=["dance", "jumping_jack"], help="kinds of generated motions"
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="of each motion (default: 2)")
    args = parser.parse_args(argv)
    drapers = {name: onefit.load(name) for name in args.weights}
    first = next(iter(drapers.values()))
    lines = [
        "| garment | motion | | hang mm | swing mm | of it | rim mm | energy J |",
        "|---|---|---|---|---|---|---|---|",
    ]
    with Progress() as progress:
        for garment in map(first.garment, args.garments):
            for k, kind in enumerate(args.motions):
                motion = onefit.Motion.generate(
                    kind, seconds=args.seconds, seed=SEED + k
                ).resampled(30.0)
                task = progress.add_task(f"{garment.name}, {kind}", total=len(motion.poses))
                reference = least(first, garment, motion, lambda: progress.advance(task))
                skinned = first.drape(garment, motion, skinning_only=True)
                turned = skinning.transforms(first.standard, motion.poses, motion.translation)[
                    :, 0, :, :3
                ]
                z = garment.vertices[:, 2]
                lowest = z < z.min() + LOWEST * (z.max() - z.min())
                found = (
                    {"skinning": skinned.vertices}
                    | {n: d.drape(garment, motion, post=False).vertices for n, d in drapers.items()}
                    | {"least": reference}
                )
                collider = ClosestSurface(skinned.body[0], skinned.body_faces)
                for name, vertices in found.items():
                    hang, swing, share = compared(
                        vertices, skinned.vertices, reference, turned, lowest
                    )
                    rim = slipped(vertices, skinned.vertices, garment)
                    energy = measure(
                        vertices,
                        garment.faces,
                        garment.vertices,
                        skinned.body,
                        collider,
                        skinned.root,
                        30.0,
                    ).energy
                    lines.append(
                        f"| {garment.name} | {kind} | {name} | {hang:.0f} | {swing:.0f} |"
                        f" {share:.2f} | {rim:.0f} | {energy:.3f} |"
                    )
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    cli(main)
