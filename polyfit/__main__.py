"""``python -m polyfit garment.obj -o surface.ply``: a mesh as patches of jets, written at any
resolution.
"""

import os

from .errors import InputError, Parser, cli


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
    args = parser.parse_args(argv)
    if not args.output.lower().endswith(".ply"):
        raise InputError(f"{args.output}: a .ply file is needed")
    if os.path.dirname(args.output) and not os.path.isdir(os.path.dirname(args.output)):
        raise InputError(f"{os.path.dirname(args.output)}: no such folder")
    for name, least in (("resolution", 1), ("smoothing", 0)):
        if getattr(args, name) < least:
            raise InputError(f"--{name} {getattr(args, name)}; at least {least} is needed")
    from . import PatchedSurface, read_mesh, write_ply
    from .mesh import centred

    vertices, faces, _ = read_mesh(args.mesh)
    vertices, moved = centred(vertices)
    if moved is not None:
        by = ", ".join(f"{x:.9g}" for x in moved)
        print(f"note: {args.mesh}: moved by ({by}): single precision ends so far from the origin")
    surface = PatchedSurface.from_mesh(vertices, faces, args.patches, args.order, where=args.mesh)
    fine, fine_faces = surface.resampled(args.resolution, args.smoothing)
    write_ply(args.output, fine.numpy(), fine_faces.numpy())
    rms = surface.residual.square().mean().sqrt()
    print(
        f"{len(surface)} patches, {surface.parameters} numbers, {1e3 * float(rms):.3f} mm RMS from"
        " the mesh"
    )
    print(f"written: {args.output}, {len(fine)} vertices")


if __name__ == "__main__":
    cli(main)
