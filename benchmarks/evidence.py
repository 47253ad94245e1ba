"""What tracks, depth and further cameras bring: accuracy and processor's time, beside the video
alone.

    python benchmarks/evidence.py --evidence FOLDER [--data FOLDER ...] [--only tube ...]
    [--kinds video tracks depth cameras ...] [--repeats 3] [--docs docs]

FOLDER holds, for each sequence, a folder with ``tracks.npz``, ``depth`` and ``cameras``; what is
missing is left out. Further cameras are made by ``further_cameras.py``. Each run is a command, as a
user would give it, on one core; its figures are those of ``python -m polysft_mi.evaluate``. Runs
are repeated with ``rgb_scale`` changed in its sixth digit, which shows what chance does; the table
has the medians, and the least and the most of e3d. Each result goes into ``evidence.json`` in DOCS
as soon as it is there, and the next call does what is missing (all of it with ``--again``); the
table in ``evidence.md``, and the picture of what is given, are made anew.
"""

import os
import tempfile

import given
import numpy as np
import sft_runs
from sequences import DATA, folder_of

from polysft_mi.errors import InputError, cli
from polysft_mi.scene import Settings

#: kind of evidence: names of what is given, in the sequence's folder of evidence
KINDS = {
    "video": (),
    "tracks": ("tracks",),
    "depth": ("depth",),
    "cameras": ("cameras",),
    "tracks and depth": ("tracks", "depth"),
}
_FILES = {"tracks": "tracks.npz", "depth": "depth", "cameras": "cameras"}
_SEQUENCES = ("flag", "curtain", "corner", "tube")


def definitions(kind, folder):
    """``name=value`` of what a kind gives; None where something of it is missing."""
    paths = {name: os.path.join(folder, _FILES[name]) for name in KINDS[kind]}
    if not all(os.path.exists(path) for path in paths.values()):
        return None
    return [f"{name}={os.path.abspath(path)}" for name, path in paths.items()]


def result(sequence, kind, data, define, repeats):
    """A result, a dict: the ``runs``, and the medians of their figures and times."""
    scale = Settings().rgb_scale
    changed = [[f"rgb_scale={scale * (1 + 1e-5 * k):.8g}"] if k else [] for k in range(repeats)]
    runs = [run(sequence, kind, data, define + more) for more in changed]
    names = set.intersection(*(set(r["figures"]) for r in runs))
    middle = {n: float(np.median([r["figures"][n] for r in runs])) for n in sorted(names)}
    seconds = float(np.median([r["cpu_seconds_a_frame"] for r in runs]))
    return {"figures": middle, "cpu_seconds_a_frame": seconds, "runs": runs}


def run(sequence, kind, data, define):
    """One run of a result, a dict: figures, frames lost, the processor's seconds."""
    setup = {"frames": None, "threads": 1, "define": define, "mode": "", "iterations": None}
    with (
        tempfile.TemporaryDirectory(prefix="evidence-") as out,
        given.processor_seconds() as spent,
    ):
        result = sft_runs.run(sequence, "gauss-newton", data, os.path.join(out, "run"), setup)
    if "error" in result:
        raise InputError(f"{sequence}, {kind}: {result['error']}")
    return {
        "figures": {k: v for k, v in result["figures"].items() if isinstance(v, float)},
        "lost": result["lost"],
        "cpu_seconds_a_frame": spent[0] / result["frames"],
        "machine": result["machine"],
    }


def table(results):
    """The results as a Markdown table."""
    lines = [
        "| sequence | given | e3d, in view | least, most | normals [deg] | RMSE [mm] | e3d, all |"
        " within 2 sigma | s a frame |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in sorted(
        results, key=lambda r: (_SEQUENCES.index(r["sequence"]), list(KINDS).index(r["kind"]))
    ):
        f = r["figures"]
        seen = lambda name, f=f: f.get(f"{name}_seen", f[name])
        each = [seen("e3d_proc", one["figures"]) for one in r["runs"]]
        lines.append(
            f"| {r['sequence']} | {r['kind']} | {seen('e3d_proc'):.5f} |"
            f" {min(each):.5f}, {max(each):.5f} | {seen('en_deg'):.2f} |"
            f" {seen('rmse_mm'):.2f} | {f['e3d_proc']:.5f} | {100 * f['sigma_two']:.0f} % |"
            f" {r['cpu_seconds_a_frame']:.2f} |"
        )
    return "\n".join(lines)


def picture(path, data, folder, frame=22):
    """Write what is given of a sequence in a frame: its tracks, where they are and came from; its
    depth; what a further camera sees.
    """
    import cv2

    from polysft_mi.scene import DepthImages, Tracks, list_images, read_rgb

    frames = list_images(os.path.join(data, "frames"))
    image, count = read_rgb(frames[frame]), len(frames)
    every = list(range(count))
    shown = image // 2
    tracks = Tracks.read(os.path.join(folder, _FILES["tracks"]), count, every)
    for k in np.flatnonzero(tracks.visible[frame]):
        past = np.arange(frame - 8, frame + 1)
        before = tracks.positions[past[tracks.visible[past, k]], k]
        line = np.round(8 * (before - 0.5)).astype(np.int32)
        hue = np.uint8([[[int(180 * tracks.positions[0, k, 0] / image.shape[1]), 200, 255]]])
        colour = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
        cv2.polylines(shown, [line], False, colour, 1, cv2.LINE_AA, 3)
        cv2.circle(shown, line[-1].tolist(), 16, colour, -1, cv2.LINE_AA, 3)
    depth = DepthImages.open(os.path.join(folder, _FILES["depth"]), count, every, 1e-3).read(frame)
    low, high = np.quantile(depth[depth > 0], (0.01, 0.5))
    grey = np.uint8(255 * np.clip((high + (high - low) - depth) / (2 * (high - low)), 0, 1))
    coloured = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    coloured = np.where(depth[..., None] > 0, coloured, 0).astype(np.uint8)
    parts = [image, shown, coloured]
    cameras = os.path.join(folder, _FILES["cameras"])
    if os.path.isdir(cameras):
        name = sorted(os.listdir(cameras))[0]
        parts.append(read_rgb(list_images(os.path.join(cameras, name, "frames"))[frame]))
    row = np.hstack(parts)
    size = 1600, round(row.shape[0] * 1600 / row.shape[1])
    small = cv2.resize(row, size, interpolation=cv2.INTER_AREA)
    cv2.imwrite(path, small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def main(argv=None):
    parser = given.parser(__doc__, "evidence", _SEQUENCES, KINDS)
    parser.add_argument("--evidence", metavar="FOLDER", required=True)
    parser.add_argument("--data", nargs="+", metavar="FOLDER", default=[DATA])
    parser.add_argument("--repeats", type=int, default=3, help="runs of each (default: 3)")
    args = parser.parse_args(argv)
    if args.repeats < 1:
        raise InputError(f"--repeats {args.repeats}: at least one run is needed")
    data = {
        sequence: next(filter(None, (folder_of(place, sequence) for place in args.data)), None)
        for sequence in args.only
    }
    if missing := [sequence for sequence, folder in data.items() if folder is None]:
        raise InputError(f"{missing[0]}: not in {', '.join(args.data)}")

    def of(sequence, kind):
        define = definitions(kind, os.path.join(args.evidence, sequence))
        if define is None:
            return None
        return result(sequence, kind, data[sequence], define, args.repeats)

    results = given.results(args, "evidence", of)
    shown = os.path.join(args.evidence, "tube")
    if "tube" in args.only and definitions("tracks and depth", shown):
        picture(os.path.join(args.docs, "evidence.jpg"), data["tube"], shown)
    given.show(args, "evidence", table(results))


if __name__ == "__main__":
    cli(main)
