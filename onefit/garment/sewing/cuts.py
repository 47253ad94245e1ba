"""Random cuts of the tailor's patterns, to train on: tight and loose, short and long, of any
neckline and mesh.

A network that has seen six garments drapes others badly: it has learned what to do at the few
places where their patches lie. Each cut is one of the patterns with its measures drawn at random,
with or without wrinkles, and triangles of another size and shape.
"""

import os

import numpy as np

from onefit.garment import Garment, standard_body
from onefit.garment.fitting import pushed_out
from polyfit import mesh
from polyfit.errors import InputError
from polyfit.files import aside
from polyfit.mesh import loops

from .block import Block
from .sew import sewn

# The pattern, how many loops its boundary has, and its measures [m], from .. to, more of them near
# the first: little ease, to the ankles and wrists, where the body is hardest to follow. The wide
# ones are fitted to the hips only, and swing.
CUTS = {
    "tshirt": (
        "tshirt", 4,
        dict(
            waist_ease=(0, 0.03), sleeve_ease=(0, 0.03), sleeve=(0.23, 0.07), hem=(-0.12, 0.10),
            front=(0.49, 0.41), back=(0.54, 0.48), narrow=(8, 3)
        )
    ),
    "trousers": (
        "trousers", 3,
        dict(hip_ease=(0, 0.02), leg_ease=(0, 0.03), waist=(0.22, 0.04), hem=(-0.715, -0.35))
    ),
    "long_sleeve_top": (
        "long_sleeve_top", 4,
        dict(
            waist_ease=(0, 0.03), sleeve_ease=(0, 0.02), sleeve=(0.24, 0.0), hem=(-0.15, 0.08),
            front=(0.49, 0.42), back=(0.545, 0.49), narrow=(8, 3)
        )
    ),
    "dress": (
        "dress", 4,
        dict(
            hem=(-0.16, -0.62), waist=(0.11, 0.14), flare=(0.20, 0.38), front=(0.47, 0.38),
            back=(0.52, 0.44), narrow=(10, 4)
        )
    ),
    "shorts": (
        "shorts", 3,
        dict(hip_ease=(0, 0.02), leg_ease=(0, 0.03), waist=(0.04, 0.20), hem=(-0.10, -0.40))
    ),
    "tank": (
        "tank", 4,
        dict(
            waist_ease=(0, 0.03), hem=(-0.12, 0.15), front=(0.46, 0.37), back=(0.52, 0.44),
            narrow=(10, 4)
        )
    ),
    "skirt": (
        "dress", 2,
        dict(hem=(-0.14, -0.62), waist=(0.11, 0.14), flare=(0.20, 0.38), top=(0.06, 0.16))
    ),
    "wide_dress": (
        "dress", 4,
        dict(
            hem=(-0.30, -0.60), waist=(0.11, 0.14), flare=(0.27, 0.40), front=(0.47, 0.38),
            back=(0.52, 0.44), narrow=(10, 4)
        )
    ),
    "wide_skirt": (
        "dress", 2,
        dict(hem=(-0.25, -0.60), waist=(0.11, 0.14), flare=(0.27, 0.42), top=(0.06, 0.16))
    ),
}  # fmt: skip
EASE = 0.001, 0.020  # of all [m], drawn evenly in its logarithm: half of the cuts lie on the skin
VERTEX_COUNTS = 500, 5000  # vertices, likewise
WRINKLE_HEIGHT = (
    0.004  # the greatest amplitude [m] of four waves, halved in their sum, for half of the cuts
)
_WAVE_LENGTHS = 0.05, 0.15  # their lengths [m]
_LOG_STRETCH = 0.4  # of the triangles: the logarithm of the greatest
SHORTEST_EDGE = 2e-4  # edge [m]: at a rim, vertices may slide onto each other
_TRIES = 20


def drawn(name, rng):
    """The arguments of :func:`onefit.garment.sewing.sew.sewn` for a cut ``name`` of :data:`CUTS`,
    but for its ``bumps``: a dict, lengths in metres.
    """
    measures = {"snug": rng.uniform(), "ease": _log_uniform(rng, *EASE)}
    for key, (first, last) in CUTS[name][2].items():
        measures[key] = first + (last - first) * rng.uniform() ** 2
    if (
        "flare" in measures
        # of the skirt: its depths, and how far it is fitted to the body; a narrow one has to hold
        # the thighs
    ):
        measures["waist"] = measures["waist"], rng.uniform(0.55, 0.75) * measures["waist"]
        measures["flare"] = measures["flare"], rng.uniform(0.75, 0.95) * measures["flare"]
        measures["fitted"] = (
            -0.12 if name.startswith("wide") else rng.uniform(measures["hem"] - 0.02, -0.12)
        )
    return measures | dict(
        count=int(_log_uniform(rng, *VERTEX_COUNTS)),
        stretch=np.exp(rng.uniform(-_LOG_STRETCH, _LOG_STRETCH, 3)),
    )


def wrinkles(block, rng):
    """Four plane waves, summed, on the grid (X, Y, Z) of ``block`` [m], at most twice
    :data:`WRINKLE_HEIGHT` high; or 0.
    """
    if rng.random() < 0.5:
        return 0.0
    height = rng.uniform(0, WRINKLE_HEIGHT)
    out = 0.0
    for _ in range(4):
        direction = rng.normal(size=3)
        wave = 2 * np.pi / rng.uniform(*_WAVE_LENGTHS) * direction / np.linalg.norm(direction)
        out = (
            out
            + np.sin(
                wave[0] * block.x
                + wave[1] * block.y
                + wave[2] * block.z
                + rng.uniform(0, 2 * np.pi)
            )
            / 2
        )
    return (height * out).astype(np.float32)


def cut(block, number, seed=0):
    """``(name, vertices (N, 3) [m], faces (F, 3))`` of the cut ``number`` of all those of ``seed``:
    the kinds of :data:`CUTS` in turn.

    Measures that do not go together (a hem above the crotch), or do not give a clean mesh, are
    drawn again.
    """
    rng = np.random.default_rng([seed, number])
    name = list(CUTS)[number % len(CUTS)]
    for _ in range(_TRIES):
        pattern, rims, _ = CUTS[name]
        measures = drawn(name, rng)
        V, F = sewn(block, pattern, bumps=wrinkles(block, rng), **measures)
        try:
            V, _ = pushed_out(V, F, name)
        except InputError:
            continue
        edges = mesh.edges_of(F)[0]
        shortest = np.linalg.norm(V[edges[:, 0]] - V[edges[:, 1]], axis=1).min()
        if len(loops(F)) == rims and shortest > SHORTEST_EDGE:
            return name, V, F
    raise RuntimeError(f"no cut {number} of {name} in {_TRIES} tries")


def cuts(count, folder, seed=0, advance=lambda: None):
    """The first ``count`` cuts as garments. Sewn once, in seconds each, into ``folder``, and read
    from there after.
    """
    os.makedirs(folder, exist_ok=True)
    garments, block = [], None
    for number in range(count):
        path = os.path.join(folder, f"cut-{seed}-{number}.npz")
        if not os.path.exists(path):
            if block is None:
                body = standard_body()
                block = Block(body.vertices.numpy(), body.faces.numpy())
            name, V, F = cut(block, number, seed)
            with aside(path) as temporary:
                np.savez_compressed(
                    temporary, name=name, vertices=V.astype(np.float32), faces=F.astype(np.int32)
                )
        with np.load(path) as file:
            garments.append(
                Garment.bound(f"{file['name']}, cut {number}", file["vertices"], file["faces"])
            )
        advance()
    return garments


def _log_uniform(rng, low, high):
    return np.exp(rng.uniform(np.log(low), np.log(high)))
