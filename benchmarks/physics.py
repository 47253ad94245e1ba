"""What physics can tell of cloth that no pixel sees: the surface in view is held where it is, and
OneFit's cloth (weight, inertia, air, bending; the body and itself in its way) says the rest.

    python benchmarks/physics.py RUN ... --truth FOLDER [--material cotton]

Each RUN is a folder that ``polysft run`` wrote of all frames of a sequence, and has its name
(``RUNS/tshirt_box``); FOLDER/NAME has ``template.obj`` and ``gt.npz``. On a body the cloth begins
with the drape and settles; without one, as the template (``skirt`` of ``simulate.py``).

It prints the RMSE [mm], a mean over the frames, of what the camera does not see: as the run
``found`` it; of cloth that is ``held`` by what the run found in view; and by the ``truth`` in view,
which is more than any tracker has; without a body, by the truth of the upper rim, too (``waist``).
"""

import os

import numpy as np

from polyfit.errors import InputError, Parser, cli
from polysft_mi.results.truth import load_npz

HOLD = 10.0  # [N/m] of the spring at each vertex in view; one of .1 g hangs .1 mm down
STEPS, SETTLING = 2, 24  # steps of a frame; before the motion
FPS = 60.0  # of simulate.py
RIM = 1e-3  # [m] below the highest vertex


def inside(shown, faces):
    """Of vertices ``shown`` (N,) bool those whose neighbours of the second order are, too."""
    out = shown
    for _ in range(2):
        rim = faces[~out[faces].all(1)]
        out = out.copy()
        out[rim] = False
    return out


def rmse(found, true, hidden):
    """[mm], a mean over frames of vertices (T, N, 3) [m] where ``hidden`` (T, N)."""
    away = np.linalg.norm(found - true, axis=2)
    return 1e3 * float(np.mean([np.sqrt((a[h] ** 2).mean()) for a, h in zip(away, hidden)]))


def simulated(cloth, step, targets, holds):
    """Vertices (T, N, 3) [m] of ``cloth`` that makes steps ``step(t, pull, target)``, t a time in
    frames, while those of ``holds`` (T, N) are held at ``targets`` (T, N, 3) [m].
    """
    out = [cloth.x.copy()]
    for t in range(1, len(targets)):
        for share in np.arange(1, STEPS + 1) / STEPS:
            hold = holds[t] & (holds[t - 1] | (share == 1))
            step(t - 1 + share, HOLD * hold, between(targets, t - 1 + share))
        out.append(cloth.x.copy())
    return np.stack(out)


def between(frames, time):
    """What ``frames`` (T, ...) are at a time, in frames."""
    k = min(int(time), len(frames) - 2)
    return frames[k] + (time - k) * (frames[k + 1] - frames[k])


def free_cloth(sheet, targets, holds):
    """Cloth of a ``sheet`` without a body, from rest."""
    from onefit.physics.cloth import Cloth

    cloth = Cloth(sheet, sheet.rest)
    step = lambda time, pull, target: cloth.step(1 / FPS / STEPS, (), target, pull)
    return simulated(cloth, step, targets, holds)


def worn_cloth(sheet, carrier, targets, holds):
    """Cloth of a ``sheet`` on the body of a ``carrier``, from its drape, which settles."""
    from onefit.physics import Settings, WornCloth

    poses, settings = [carrier.at(k) for k in range(len(targets))], Settings()
    bodies = np.stack([carrier.body(pose) for pose in poses])
    start = carrier.maps(poses[0])(sheet.rest)
    worn, dt = WornCloth(sheet, start, bodies[0], carrier.skin[2], settings), 1 / carrier.fps
    step = lambda time, pull, target: worn.step(dt / STEPS, between(bodies, time), target, pull)
    for _ in range(SETTLING):
        step(0, HOLD * holds[0], targets[0])
        worn.cloth.v *= settings.damping
    return simulated(worn.cloth, step, targets, holds)


def figures(run, folder, material):
    """The figures, a dict, of a run of the sequence in a folder."""
    from onefit.physics import Material, Sheet
    from polysft_mi.body import BodyMotion, put_on
    from polysft_mi.scene import read_camera
    from polysft_mi.surface import meshio

    truth, found = (load_npz(p) for p in (f"{folder}/gt.npz", f"{run}/surface.npz"))
    rest, faces, _ = meshio.read_textured_template(f"{folder}/template.obj")
    count, seen = len(truth["vertices"]), truth["seen"].astype(bool)
    if len(found["frames"]) != count:
        raise InputError(f"{run}: {len(found['frames'])} frames; all {count} are needed")
    holds = np.stack([inside(s, faces) for s in seen])
    worn = os.path.exists(f"{run}/body.npz")
    if worn:
        _, pose = read_camera(f"{folder}/camera.json")
        z_up = lambda x: (x - pose[:3, 3]) @ pose[:3, :3]
        motion = BodyMotion.read(f"{run}/body.npz", count, list(range(count)))
        carrier = put_on(rest, faces, motion)
        sheet = Sheet(rest, faces, Material.named(material))
        simulate = lambda *held: worn_cloth(sheet, carrier, *held)
    else:  # the camera is level
        z_up = lambda x: np.stack([x[..., 0], x[..., 2], -x[..., 1]], -1)
        sheet = Sheet(z_up(rest), faces, Material.named(material))
        simulate = lambda *held: free_cloth(sheet, *held)
    true, tracked = (z_up(a["vertices"].astype(float)) for a in (truth, found))
    row = {"found": rmse(tracked, true, ~seen), "held": rmse(simulate(tracked, holds), true, ~seen)}
    row["truth"] = rmse(simulate(true, holds), true, ~seen)
    if not worn:
        height = sheet.rest[:, 2]
        row["waist"] = rmse(simulate(true, holds | (height > height.max() - RIM)), true, ~seen)
    return row


def main(argv=None):
    p = Parser(prog="python benchmarks/physics.py", description=__doc__.splitlines()[0])
    p.add_argument("runs", nargs="+", metavar="RUN")
    p.add_argument("--truth", required=True, metavar="FOLDER", help="of the sequences' folders")
    p.add_argument("--material", default="cotton")
    args = p.parse_args(argv)
    for run in args.runs:
        name = os.path.basename(os.path.normpath(run))
        row = figures(run, os.path.join(args.truth, name), args.material)
        print(name, ", ".join(f"{k} {v:.1f}" for k, v in row.items()), flush=True)


if __name__ == "__main__":
    cli(main)
