"""What the generated motions and the random bodies are like: the figures of
``docs/onefit_bodies.md``.

    python benchmarks/onefit_motions.py              (three minutes)

A row for each kind of motion, over ``--seeds`` sequences of 8 s on the standard body: the speed of
feet on the ground (98th percentile), the lowest point (below the floor where negative), the bend of
knees, in how many of the looked-at frames a forearm or hand is more than 1 cm deep in trunk, head
or legs, and how deep at most. Then heights and volumes of random bodies, and what skinning from the
T-pose to the A-pose and on loses.
"""

import argparse
from dataclasses import replace

import numpy as np
import pyvista
import torch
from vtkmodules.vtkFiltersModeling import vtkSelectEnclosedPoints

from onefit.body import AnnyBody, skeleton, skinning
from onefit.motion import Motion, generate

FOREARMS = [
    skeleton.INDEX[f"{side}_{part}"]
    for side in ("left", "right")
    for part in ("elbow", "wrist", "hand")
]
ARMS = FOREARMS + [skeleton.INDEX["left_shoulder"], skeleton.INDEX["right_shoulder"]]


class Core:
    """A body without its arms: a closed surface, cut at the shoulders; a ring where it is cut is
    closed by a fan to its middle.
    """

    def __init__(self, body):
        of = body.blend_weights.argmax(1).numpy()
        self.kept = ~np.isin(of, ARMS)
        self.forearms = np.flatnonzero(np.isin(of, FOREARMS))[::2]
        faces = body.faces.numpy()
        faces = faces[self.kept[faces].all(1)]
        sides = {(int(f[a]), int(f[b])) for f in faces for a, b in ((0, 1), (1, 2), (2, 0))}
        following = {b: a for a, b in sides if (b, a) not in sides}
        self.rings = []
        while following:
            start, at = following.popitem()
            self.rings.append([start])
            while at != start:
                self.rings[-1].append(at)
                at = following.pop(at)
        fans = [
            (a, b, len(of) + k)
            for k, ring in enumerate(self.rings)
            for a, b in zip(ring, ring[1:] + ring[:1], strict=True)
        ]
        self.faces = np.concatenate([faces, np.array(fans)])

    def depth(self, vertices):
        """How deep [m] the vertices (V, 3) of a posed body's forearms and hands are in it at most;
        0 where none is.
        """
        closed = np.concatenate([vertices, [vertices[ring].mean(0) for ring in self.rings]])
        select = vtkSelectEnclosedPoints()
        select.SetSurfaceData(
            pyvista.PolyData(
                closed, np.concatenate([np.full((len(self.faces), 1), 3), self.faces], 1)
            )
        )
        select.SetInputData(pyvista.PolyData(vertices[self.forearms]))
        select.Update()
        inside = np.asarray(pyvista.wrap(select.GetOutput()).point_data["SelectedPoints"]) > 0
        if not inside.any():
            return 0.0
        return float(
            np.linalg.norm(
                vertices[self.forearms][inside][:, None] - vertices[self.kept][None], axis=-1
            )
            .min(1)
            .max()
        )


def posed(body, motion):
    """Vertices (T, V, 3) [m] of a body in a motion."""
    maps = skinning.transforms(body, motion.poses, motion.translation)
    return skinning.skin(body.vertices, body.blend_weights, maps).double().numpy()


def row(kind, body, core, seeds, every=8):
    ball = skeleton.standard_joints()[skeleton.INDEX["left_foot"], 2].item()
    floor = float(body.vertices[:, 2].min())
    speeds, lowest, bends, depths = [], [], [], []
    for seed in range(seeds):
        motion = Motion.generate(kind, seconds=8, seed=seed)
        feet = (
            skinning.posed_joints(
                body, skinning.transforms(body, motion.poses, motion.translation)
            )[:, [10, 11]]
            .double()
            .numpy()
        )
        down = (feet[1:, :, 2] < ball + 0.006) & (feet[:-1, :, 2] < ball + 0.006)
        speeds.append((np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) * motion.fps)[down])
        bends.append(
            np.degrees(
                motion.poses[
                    :, [skeleton.INDEX["left_knee"], skeleton.INDEX["right_knee"]], 0
                ].numpy()
            )
        )
        vertices = posed(body, motion[::every])
        lowest.append(vertices[..., 2].min() - floor)
        depths += [core.depth(V) for V in vertices]
    speed, bends, depths = (
        np.percentile(np.concatenate(speeds), 98),
        np.concatenate(bends),
        np.array(depths),
    )
    knees = f"{bends.min():4.0f} to {bends.max():4.0f}"
    inside = f"{(depths > 0.01).sum()}/{len(depths)}"
    print(
        f"{kind:14s} {speed:8.2f} {1000 * min(lowest):12.0f} {knees:>14s} {inside:>11s}"
        f" {1000 * depths.max():10.0f}"
    )


def shapes(model, count):
    rng = np.random.default_rng(0)
    tall, litres = [], []
    for _ in range(count):
        body = model.body(model.random_shape(rng))
        V = body.vertices.double()
        tall.append(float(V[:, 2].max() - V[:, 2].min()))
        litres.append(float(torch.linalg.det(V[body.faces]).sum() / 6 * 1000))
    for what, values in (("height [m]", tall), ("volume [l]", litres)):
        print(
            f"{count} random bodies, {what}: {min(values):.2f} to {max(values):.2f}, median"
            f" {np.median(values):.2f}"
        )


def there_and_on(body):
    """Distance of a body skinned from its T-pose to the A-pose and from there to a pose, from one
    skinned from the T-pose at once.
    """
    still = Motion(torch.zeros(1, 24, 3), torch.zeros(1, 3), 30.0)
    maps = skinning.transforms(body, still.poses, still.translation)
    at_t = replace(
        body,
        vertices=skinning.skin(body.vertices, body.blend_weights, maps)[0],
        joints=skinning.posed_joints(body, maps)[0],
        rest_pose=torch.zeros(24, 3),
    )
    maps = skinning.transforms(at_t, body.rest_pose[None], still.translation)
    at_a = replace(body, vertices=skinning.skin(at_t.vertices, body.blend_weights, maps)[0])
    off = np.concatenate(
        [
            np.linalg.norm(posed(at_t, m) - posed(at_a, m), axis=-1)
            for m in (Motion.generate(k, 8, 3)[::30] for k in generate.KINDS)
        ]
    )
    print(
        f"T-pose to A-pose and on, against T-pose at once: {1000 * off.mean():.2f} mm in the mean,"
        f" {1000 * off.max():.0f} mm at most"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=8, help="sequences of each kind")
    parser.add_argument("--bodies", type=int, default=1000, help="random bodies")
    arguments = parser.parse_args()
    model = AnnyBody()
    body = model.body()
    core = Core(body)
    print("kind           feet [m/s] floor [mm]    knees [deg]  arm inside  depth [mm]")
    for kind in generate.KINDS:
        row(kind, body, core, arguments.seeds)
    shapes(model, arguments.bodies)
    there_and_on(body)


if __name__ == "__main__":
    main()
