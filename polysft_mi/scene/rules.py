"""The numbers that the second-order tracker decides by: one immutable object, with what each means.

A scene file has no say in them; :class:`polysft_mi.scene.settings.Settings` holds what a user
chooses. They are the same for every sequence. ``benchmarks/ablation.py`` switches each rule off
alone and measures what that costs. ``python -m polysft_mi.scene.rules`` prints them as the table in
``docs/tracker.md``.
"""

import dataclasses
import math
from dataclasses import dataclass, field


def _rule(default, unit, doc, row=""):
    """A field; ``row``: of docs/ablation.md, where it is switched off."""
    return field(default=default, metadata={"unit": unit, "doc": doc, "row": row})


@dataclass(frozen=True)
class Rules:
    """Every number that the tracker decides by. The metadata of a field holds its unit, what it
    does, and the row of docs/ablation.md that says what it is worth.

    A "share" is a fraction of one. A field without a unit is a factor, a count, or a switch.
    """

    # stages: coarse to fine
    blurs: tuple = _rule(
        (2.5, 1.5, 1.0),
        "pixels",
        "blur of the images at the three stages, on a sheet of 225 pixels; it grows with the sheet",
        row="three stages",
    )
    far_blur: float = _rule(
        6.0,
        "pixels",
        "blur of the stage for a sheet that moved far, likewise",
        row="a wider blur where it moved far",
    )
    stiffness: tuple = _rule(
        (0.1, 0.3, 1.0),
        "share",
        "of `k_mi` at the three stages: soft edges register first",
        row="soft edges first",
    )
    iterations: tuple = _rule(
        (6, 4, 3), "", "iterations of the three stages", row="more steps at first"
    )
    window: float = _rule(
        8.0,
        "pixels",
        "standard deviation of the window of local brightness, likewise",
        row="window of local brightness",
    )
    # surfaces of several patches
    unseen: float = _rule(
        10.0,
        "",
        "factor of the weights of smoothness where no pixel sees such a surface",
        row="unseen parts are held",
    )
    # the step
    gain: float = _rule(
        0.01,
        "share",
        "of the objective, chromaticity, tracks and depth aside, that a step must promise, or a"
        " pass must gain, for another one to follow",
        row="small step ends a stage",
    )
    damping: tuple = _rule(
        (1e-4, 3e-3),
        "",
        "Levenberg-Marquardt damping at a stage's start, without and with relief",
        row="damping",
    )
    scale_least: float = _rule(
        0.2, "deviations", "that the robust scale is at least", row="robust scale"
    )
    # frames that the stages do not explain
    fine_passes: bool = _rule(
        True,
        "",
        "whether a frame that is not explained goes through the fine stages again while they gain",
        row="fine passes",
    )
    # starts
    motion_starts: bool = _rule(
        True,
        "",
        "whether a frame may start where the motion of the two before leads",
        row="motion starts",
    )
    margin: float = _rule(
        0.03,
        "misfit",
        "that tells: below it a frame counts as explained; one that exceeds the usual by it is"
        " suspect",
        row="a frame may be explained",
    )
    usual_frames: int = _rule(
        5,
        "frames",
        "over which the usual misfit is a median; of less than three there is none",
        row="other starts",
    )
    # mirror images
    mirror_share: float = _rule(
        0.2,
        "share",
        "of a frame's cost that the mirror image of a sheet may cost more, to be tracked too",
        row="mirror images",
    )
    rim: float = _rule(
        0.1,
        "share",
        "of a surface's size, the root of its area: what is nearer to its border is tried anew, as"
        " it would go on from the inside",
        row="rims",
    )
    # the relief, and caution with noise
    relief_vertices: int = _rule(
        3000,
        "vertices",
        "of the template, above which there is no relief: it costs too much time",
        row="relief",
    )
    relief_bend: float = _rule(
        3e-3, "share", "of the relief's weight, for its bending", row="relief's bending"
    )
    noise_misfit: float = _rule(
        0.05,
        "misfit",
        "of noise, at which the relief's weight has doubled",
        row="relief's caution",
    )
    noise_power: float = _rule(
        8.0, "", "with which it grows with the noise", row="caution's steepness"
    )
    second_pass: float = _rule(
        0.05,
        "share",
        "that outline, shading, colours and evidence must cost less where what a misfit has above"
        " the noise is taken for folds, for such a second pass to be kept; 1: none is made",
        row="second pass",
    )
    give: float = _rule(
        0.002,
        "strain",
        "from which on a stretched edge hardly pulls harder (Charbonnier)",
        row="edges give",
    )
    # the texture
    texels: float = _rule(
        1.5, "texels", "of the baked texture to a pixel of the first frame", row="fine texture"
    )
    texture_gain: float = _rule(
        0.6,
        "share",
        "of the first frame's misfit that may be left, for the texture to be fitted to it",
        row="texture fit",
    )
    appearance: bool = _rule(
        True,
        "",
        "whether the sheet's own image takes the place of its blurred texture",
        row="appearance",
    )
    border: float = _rule(
        2.0,
        "windows",
        "from the sheet's border where images without masks are not corrected so",
        row="borders",
    )
    # colours of triangles
    chroma_scale: float = _rule(
        0.04,
        "share",
        "of the mean luminance, beyond which a triangle's chromaticity is an outlier",
        row="chromaticity's outliers",
    )
    shading_blur: float = _rule(
        0.45, "triangles", "blur of texture and frames, in triangle sides", row="triangles' blur"
    )
    exposure: bool = _rule(
        True, "", "whether a frame's overall brightness is its own", row="exposure"
    )
    light_ridge: float = _rule(
        3e-3,
        "observations",
        "a triangle, that hold the light to be the same from all sides",
        row="light's prior",
    )
    light_refits: int = _rule(
        3, "", "of a frame's robust regression, which ends before it converges", row="few refits"
    )
    light_kept: float = _rule(
        0.8, "share", "of what earlier frames say of light, a frame later", row="light's memory"
    )
    light_scale: float = _rule(
        0.05,
        "share",
        "of the mean luminance, at which a triangle's residual is an outlier",
        row="shading's robust norm",
    )

    def for_patches(self, count: int) -> "Rules":
        """The rules for a template of so many patches: a sheet is one."""
        return dataclasses.replace(self, unseen=1.0) if count == 1 else self

    def caution(self, noise):
        """The factor by which weights grow with the ``noise`` (a misfit; NaN: none is known)."""
        noise = 0.0 if math.isnan(noise) else noise
        return 1 + (noise / self.noise_misfit) ** self.noise_power


def table():
    """All rules as a Markdown table."""
    rows = ["| rule | value | unit | meaning | ablation |", "|---|---|---|---|---|"]
    for f in dataclasses.fields(Rules):
        value = (
            ", ".join(f"{x:g}" for x in f.default) if isinstance(f.default, tuple) else f.default
        )
        rows.append(
            f"| `{f.name}` | {value} | {f.metadata['unit']} | {f.metadata['doc']} |"
            f" {f.metadata['row']} |"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    print(table())
