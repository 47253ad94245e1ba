"""``python -m polyfit garment.obj -o surface.ply``: a mesh as patches of jets, written at any
resolution.
"""

import os
import sys

from .errors import InputError, Parser, cli

_SAME_AXIS = 0.99999  # cosine of two z axes: 0.3 degrees
_MOST_FACES = 100_000_000  # of the surface that is written: some 10 GB of memory
# The paper: plain ACVD, the frame of PCA and the spatial transformer, jets of order 4
PRESETS = {"paper": dict(patches=None, order=4, cuts="acvd", frames="stn", weights="paper")}


def main(argv=None):
    parser = Parser(
        prog="python -m polyfit",
        description="Fit patches of jets to a mesh, write their surface at any resolution.",
    )
    parser.add_argument("mesh", help="an .obj, .ply or .glb file [m]")
    parser.add_argument("-o", "--output", required=True, help="the .ply file to write")
    parser.add_argument(
        "--patches", type=int, help="number of patches (default: the paper's, by the mesh's area)"
    )
    parser.add_argument(
        "--order", type=int, default=4, help="order of the jets, 1 to 10 (default: 4)"
    )
    parser.add_argument(
        "--cuts",
        choices=("jets", "acvd"),
        default="jets",
        help="how the mesh is cut: as jets need it, or by plain ACVD (default: jets)",
    )
    parser.add_argument(
        "--frames",
        choices=("pca", "stn"),
        default="pca",
        help="the patches' frames: of PCA, or refined by the spatial transformer (default: pca)",
    )
    parser.add_argument(
        "--weights",
        metavar="WEIGHTS",
        help="of the transformer: polyfit, paper (one quaternion), or a file (default: polyfit)",
    )
    parser.add_argument(
        "--resolution",
        type=int,
        default=4,
        help="parts that each side of the mesh's faces is cut into (default: 4)",
    )
    parser.add_argument(
        "--smoothing",
        type=int,
        default=0,
        help="rounds of Laplacian smoothing along the patches' boundaries (default: 0)",
    )
    parser.add_presets(PRESETS)
    args = parser.parse_args(argv)
    if not args.output.lower().endswith(".ply"):
        raise InputError(f"{args.output}: a .ply file is needed")
    if os.path.dirname(args.output) and not os.path.isdir(os.path.dirname(args.output)):
        raise InputError(f"{os.path.dirname(args.output)}: no such folder")
    if os.path.isdir(args.output):
        raise InputError(f"{args.output}: is a folder; a .ply file is needed")
    if os.path.exists(args.output) and os.path.realpath(args.output) == os.path.realpath(args.mesh):
        raise InputError(f"{args.output}: is the mesh itself; -o needs another name")
    for name, least in (("resolution", 1), ("smoothing", 0)):
        if getattr(args, name) < least:
            raise InputError(f"--{name} {getattr(args, name)}; at least {least} is needed")
    typed = args.weights != PRESETS.get(args.preset, {}).get("weights")
    if args.weights and typed and args.frames != "stn":
        raise InputError(f"--weights {args.weights}: of the transformer, for --frames stn")
    import numpy as np

    from . import PatchedSurface, PolyFit, read_mesh, write_ply
    from .mesh import centred, checked, seam_note, size_note
    from .network import PRETRAINED

    vertices, faces, _ = read_mesh(args.mesh)
    vertices, faces = checked(vertices, faces, args.mesh, drop_loose=True)
    made = len(faces) * args.resolution**2
    if made > _MOST_FACES:
        raise InputError(
            f"--resolution {args.resolution}: {made:.3g} faces of the {len(faces)} of {args.mesh};"
            f" at most {_MOST_FACES:.3g} can be made"
        )
    for note in size_note(vertices, args.mesh), seam_note(vertices, faces, args.mesh):
        if note:
            print(note, file=sys.stderr)
    vertices, moved = centred(vertices)
    if moved is not None:
        by = ", ".join(f"{x:.9g}" for x in moved)
        print(f"note: {args.mesh}: moved by ({by}): single precision ends so far from the origin")
    refine = None
    if args.frames == "stn":
        path = PRETRAINED.get(args.weights or "polyfit", args.weights)
        refine = PolyFit.load(path, args.order).requires_grad_(False)
    surface = PatchedSurface.from_mesh(
        vertices, faces, args.patches, args.order, acvd=args.cuts == "acvd", polyfit=refine,
        where=args.mesh,
    )  # fmt: skip
    fine, fine_faces = surface.resampled(args.resolution, args.smoothing)
    write_ply(args.output, fine.numpy(), fine_faces.numpy())
    rms = np.sqrt(np.average(surface.residual.square(), weights=surface.patches.entry_weight))
    print(
        f"{len(surface)} patches, {surface.parameters} numbers, {1e3 * float(rms):.4f} mm RMS from"
        " the mesh"
    )
    if refine is not None:
        of_pca = PatchedSurface.fit(surface.patches, args.order).frame.R
        cosine = (of_pca[:, :, 2] * surface.frame.R[:, :, 2]).sum(-1)
        turned = int((cosine < _SAME_AXIS).sum())
        print(f"the transformer turned the z axis of {turned} of them")
    print(f"written: {args.output}, {len(fine)} vertices")


if __name__ == "__main__":
    cli(main)
