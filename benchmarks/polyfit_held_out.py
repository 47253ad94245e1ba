"""What ``polyfit_accuracy.py`` measures on: patches of garments and sheets that no training saw.

Kinds of patches, each sampled at ``POINTS`` places:

    as made    cut at the paper's number K, as they are
    large      cut into 10 patches
    posed      cut into 10, 25 and 100 patches, each then taken through a random smooth map of its
               own (polyfit.training.deformations: stretched, bent, waved)
    simulated  no garments, but nothing that resembles the training: the sheets of DATA/cloth, cut
               into 10 patches, in 8 frames each of their simulations
    folded     of large, posed and simulated: those that the PCA frame sees to more than 5 % from
               behind, so that they are no height graphs over its plane, though they are over
               another: of 65 axes over the half sphere one at least sees at most 1 % from behind.
               This is what a better frame can mend; the choice asks the surfaces' normals alone, no
               fit. The difficult kind.
"""

from pathlib import Path

import numpy as np
import torch

from polyfit import mesh
from polyfit.baselines import normalised
from polyfit.errors import InputError
from polyfit.jets import CanonicalFrame
from polyfit.mesh import read_mesh
from polyfit.patches import Patches
from polyfit.training import garments, share_behind
from polyfit.training.training_set import axes, rotations_to

HELD_OUT = [
    *(
        f"garments_snug/{name}.obj"
        for name in ("tshirt", "tank", "long_sleeve_top", "shorts", "pants")
    ),
    *(f"garments_makehuman/{name}.obj" for name in ("f_skirt", "m_dungarees", "m_shirt_wrinkled")),
]
POINTS = 256  # of each patch
CLOUD_POINTS = 10_000  # of a whole garment
LARGE = 10  # patches of a mesh of the kind "large"
POSED_CUTS, POSED = (10, 25, 100), 6000  # patches of a mesh, and how many posed ones altogether
SHEETS, FRAMES = ("flag", "bend", "paper", "curtain", "corner"), 8  # frames of each sheet
# shares of a patch that are seen from behind: more than the one over its PCA plane, at most the
# other over the best plane
FOLDED, GRAPH = 0.05, 0.01


def kinds(data, seed=1):
    """The held-out patches by kind: :class:`garments.GarmentPatches`."""
    paths = [Path(data) / name for name in HELD_OUT]
    missing = [str(p) for p in paths if not p.exists()]
    if missing:
        raise InputError(
            f"{missing[0]}: no such file; DATA holds garments_snug and garments_makehuman"
        )
    out = {
        "as made": garments.cut_meshes(paths, (None,), POINTS, seed),
        "large": garments.cut_meshes(paths, (LARGE,), POINTS, seed),
    }
    # every cut weighs the same, though a fine one has more patches
    each = [garments.cut_meshes(paths, (cut,), POINTS, seed) for cut in POSED_CUTS]
    generator = torch.Generator().manual_seed(seed)
    out["posed"] = garments.GarmentPatches.join(
        [g.deformed(POSED // len(each), generator) for g in each]
    )
    out["simulated"] = simulated(Path(data) / "cloth", seed)
    every = garments.GarmentPatches.join([out[kind] for kind in ("large", "posed", "simulated")])
    folded = is_folded(every)
    out["folded"] = garments.GarmentPatches(every.points[folded], every.normals[folded])
    return out


def simulated(folder, seed):
    generator, parts = np.random.default_rng(seed), []
    for sheet in SHEETS:
        vertices, faces = read_mesh(folder / sheet / "template.obj")[:2]
        patches = Patches.cut(vertices, faces, LARGE)
        with np.load(folder / sheet / "gt.npz") as truth:
            frames = truth["vertices"]
        for V in frames[np.linspace(0, len(frames) - 1, FRAMES).astype(int)]:
            F = patches.given
            for _ in range(patches.levels):
                F, edges = mesh.subdivided(F)
                V = np.concatenate([V, V[edges].mean(axis=1)])
            parts.append(garments.GarmentPatches.sample(patches, POINTS, generator, V))
    return garments.GarmentPatches.join(parts)


def is_folded(patches):
    """Which patches are no height graphs over their PCA plane, but are over another, (M,)."""
    normals = patches.normals @ CanonicalFrame.from_points(patches.points).R
    seen = torch.stack([share_behind(normals @ turn) for turn in rotations_to(axes())], 1)
    return (seen[:, 0] > FOLDED) & (seen.amin(1) <= GRAPH)


def cloud(path):
    """Points (2, 10,000, 3) of one of SNUG's garments, uniform in area, in the unit sphere about
    the centre of its box: one cloud to encode, one to compare with. SNUG's y is up, and z to the
    front; as the garments that were trained on, they have z up here, and y to the back."""
    vertices, faces = read_mesh(path)[:2]
    vertices = vertices[:, [0, 2, 1]] * (1, -1, 1)
    generator, area = np.random.default_rng(0), mesh.areas(vertices, faces)
    chosen = generator.choice(len(faces), (2, CLOUD_POINTS), p=area / area.sum())
    points = np.einsum(
        "cpj,cpjd->cpd", generator.dirichlet((1, 1, 1), chosen.shape), vertices[faces[chosen]]
    )
    return normalised(torch.as_tensor(points, dtype=torch.float32).flatten(0, 1))[0].reshape(
        2, CLOUD_POINTS, 3
    )
