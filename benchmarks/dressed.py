"""Garments on moving bodies: what is found where a body's motion, tracks and depth are given.

    python benchmarks/dressed.py --data FOLDER [--evidence FOLDER] [--only sleeves_up ...]
    [--kinds body mesh tracks depth ...] [--docs docs]
    python benchmarks/dressed.py --data OUT --only tshirt_dance_3 --docs OUT

FOLDER holds a folder for each sequence, with ``body.npz``, and ``world_to_camera`` in its
``camera.json``; that of ``--evidence`` holds, for each, a folder with ``tracks.npz`` and ``depth``,
and without it these kinds are left out. Each run is two commands, as a user would give them, on one
core; ``drape`` is what OneFit makes of the motion as it is given, without a video; ``mesh`` has the
same body, given as a moving mesh. Each result goes into ``dressed.json`` in DOCS as soon as it is
there, and the next call does what is missing (all of it with ``--again``); the table in
``evidence.md`` is made anew, and so is ``dressed.jpg``, of a run that was made.
"""

import os
import subprocess
import sys
import tempfile

import given
import numpy as np
import torch
from sequences import ROOT

from polysft_mi.errors import InputError, cli
from polysft_mi.results.evaluation import score
from polysft_mi.results.truth import load_npz

KINDS = {"body": (), "mesh": (), "tracks": ("tracks",), "depth": ("depth",)}
_FILES = {"tracks": "tracks.npz", "depth": "depth"}
_SEQUENCES = ("tshirt_box", "sleeves_up")
_SHOWN = "tshirt_box", "body", 28


def figures(surface, truth):
    """RMSE [mm], a mean over the frames, of a surface (arrays of a ``surface.npz``) against the
    file ``truth``: of the vertices in view, of those that are not, and of all; and the share of the
    errors that lie within two sigma, of a surface that has it.
    """
    of_all = score(surface, truth)
    known = load_npz(truth)
    frames = np.asarray(surface["frames"])
    away = np.linalg.norm(surface["vertices"] - known["vertices"][frames], axis=2)
    hidden = [np.sqrt((a[~s] ** 2).mean()) for a, s in zip(away, known["seen"][frames])]
    found = {name: of_all[name] for name in ("rmse_mm_seen", "rmse_mm", "en_deg_seen")}
    found |= {name: of_all[name] for name in ("sigma_two",) if name in of_all}
    return found | {"rmse_mm_hidden": 1e3 * float(np.mean(hidden))}


def run(folder, kind, where, out, last):
    """A result, a dict, of the sequence in a folder, whose tracks and depth are in the folder
    ``where``; the run goes to ``out``.
    """
    evidence = [f"--{name}={os.path.join(where, _FILES[name])}" for name in KINDS[kind]]
    scene = os.path.join(out, "scene")
    module = [sys.executable, "-m"]
    motion = os.path.join(folder, "body.npz")
    if kind == "mesh":
        motion = moving_mesh(motion, os.path.join(out, "mesh.npz"))
    body = ["--body", motion]
    prepare = [*module, "polysft_mi.prepare", folder, "-o", scene, "-q", *body, *evidence]
    track = [*module, "polysft_mi.run", os.path.join(scene, "scene.xml"), "-q", "--no-report"]
    track += ["-o", os.path.join(out, "run"), "--exr", "0", "-D", f"last={last}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with given.processor_seconds() as spent:
        for command in (prepare, track):
            done = subprocess.run(
                command, env=environment, cwd=ROOT, capture_output=True, text=True
            )
            if done.returncode:
                raise InputError(f"{folder}, {kind}: {done.stderr.strip().splitlines()[-1]}")
    surface = load_npz(os.path.join(out, "run", "surface.npz"))
    found = figures(surface, os.path.join(folder, "gt.npz"))
    return found | {"cpu_seconds_a_frame": spent[0] / len(surface["frames"])}


def moving_mesh(path, to):
    """The mesh of the body whose motion the file ``path`` has, written into the file ``to``."""
    import onefit
    from onefit.body import skinning

    arrays, body = load_npz(path), onefit.AnnyBody().body()
    poses, places = (torch.as_tensor(arrays[n]).float() for n in ("poses", "translation"))
    maps = skinning.transforms(body, poses.reshape(len(poses), -1, 3), places)
    vertices = skinning.skin(body.vertices, body.blend_weights, maps)
    known = {"vertices": vertices, "rest": body.vertices, "faces": body.faces}
    np.savez(to, fps=arrays["fps"], **{name: x.numpy() for name, x in known.items()})
    return to


def drape(folder, last):
    """The figures of OneFit's drape on the motion as it is given."""
    from polysft_mi.body import BodyMotion, put_on
    from polysft_mi.scene import read_camera
    from polysft_mi.surface import meshio

    truth = os.path.join(folder, "gt.npz")
    vertices, faces, _ = meshio.read_textured_template(os.path.join(folder, "template.obj"))
    _, pose = read_camera(os.path.join(folder, "camera.json"))
    count = len(load_npz(truth)["vertices"])
    frames = np.arange(count if last < 0 else last + 1)
    motion = BodyMotion.read(os.path.join(folder, "body.npz"), count, frames.tolist())
    carrier = put_on(vertices, faces, motion)
    world = np.stack([carrier.maps(carrier.at(k))(vertices) for k in frames])
    surface = {"vertices": world @ pose[:3, :3].T + pose[:3, 3], "faces": faces, "frames": frames}
    return figures(surface, truth)


def table(results):
    """The results as a Markdown table."""
    lines = [
        "| sequence | given | RMSE in view [mm] | not in view | normals in view [deg] |"
        " within 2 sigma | s a frame |",
        "|---|---|---|---|---|---|---|",
    ]
    names = {
        "drape": "the motion alone: its drape",
        "body": "video and body",
        "mesh": "video and body, as a mesh",
    }
    order = ["drape", *KINDS]
    for r in sorted(results, key=lambda r: (r["sequence"], order.index(r["kind"]))):
        seconds, sigma = r.get("cpu_seconds_a_frame"), r.get("sigma_two")
        lines.append(
            f"| {r['sequence']} | {names.get(r['kind'], 'and ' + r['kind'])} |"
            f" {r['rmse_mm_seen']:.1f} | {r['rmse_mm_hidden']:.1f} | {r['en_deg_seen']:.1f} |"
            f" {'–' if sigma is None else f'{100 * sigma:.0f} %'} |"
            f" {f'{seconds:.1f}' if seconds else '–'} |"
        )
    return "\n".join(lines)


def picture(path, out, frame):
    """Write a frame of a run in ``out``: the video; the drape on the body as its motion is given;
    and what was found, over the faded video.
    """
    from polyfit.backend import set_variant

    set_variant()
    import cv2
    import mitsuba as mi

    from polyfit.colours import srgb
    from polysft_mi.objective import Problem
    from polysft_mi.scene import load

    experiment = load(os.path.join(out, "scene", "scene.xml"))
    problem = Problem(experiment, experiment.sequence())
    atlas = problem.atlas
    given = atlas.surface(atlas.posed(atlas.start, frame)).vertices
    camera = problem.camera
    found = load_npz(os.path.join(out, "run", "surface.npz"))["vertices"][frame] @ camera.axes
    found = found.astype(float) + camera.origin
    image = problem.sequence.frame(frame)
    panels, faded = [image], 0.5 * image.mean(2, keepdims=True) + 0.25
    for vertices in (given, found):
        rgb, alpha = problem.placed.image(mi.Point3f(vertices.T.astype(np.float32)))
        panels.append(np.array(rgb) + (1 - np.array(alpha)) * faded)
    row = np.round(255 * srgb(np.hstack(panels))).astype(np.uint8)
    cv2.imwrite(path, row[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def main(argv=None):
    parser = given.parser(__doc__, "dressed", _SEQUENCES, ["drape", *KINDS])
    parser.add_argument("--data", metavar="FOLDER", required=True)
    parser.add_argument("--evidence", metavar="FOLDER")
    parser.add_argument("--last", type=int, default=-1, help="last frame (default: all)")
    args = parser.parse_args(argv)
    for sequence in args.only:
        if not os.path.isdir(folder := os.path.join(args.data, sequence)):
            raise InputError(f"{folder}: no such folder; --only takes names of folders in --data")

    def result(sequence, kind):
        if KINDS.get(kind) and not args.evidence:
            return None
        folder = os.path.abspath(os.path.join(args.data, sequence))
        if kind == "drape":
            return drape(folder, args.last)
        where = os.path.abspath(os.path.join(args.evidence or ".", sequence))
        with tempfile.TemporaryDirectory(prefix="dressed-") as out:
            found = run(folder, kind, where, out, args.last)
            if (sequence, kind) == _SHOWN[:2] and args.last < 0:
                picture(os.path.join(args.docs, "dressed.jpg"), out, _SHOWN[2])
        return found

    given.show(args, "dressed", table(given.results(args, "dressed", result)))


if __name__ == "__main__":
    cli(main)
