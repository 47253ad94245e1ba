"""The settings of a training of PolyFit's network, or of one that it is compared with."""

from dataclasses import dataclass

from polyfit.baselines import DGCNN, AtlasNet, PointNet
from polyfit.errors import InputError
from polyfit.jets import check_order
from polyfit.network import PRETRAINED, PolyFit, SpatialTransformer

from . import families

MODELS = ("polyfit", "pointnet", "dgcnn", "atlasnet")
LOSSES = ("axes", "height")
# The paper's training (supplement, "PolyFit: Training and Implementation"). It says hours, not
# steps, and no number of analytic patches: here there are as many as of garments, 100,000.
PRESETS = {
    "paper": dict(
        order=4, turns=1, pca=False, loss="height", cuts=["paper"], subdivided=4, acvd=True,
        deformed=False, garment_share=0.5, patches=200_000, batch=512, lr=1e-3, decay=False,
        steps=2500,
    )
}  # fmt: skip
POINTS_PER_PATCH = 256  # points that are made of each patch


@dataclass(frozen=True)
class Settings:
    """What decides the result.

    ``cuts``: the numbers of patches that each mesh is cut into, or "paper", the paper's number by
    its area; ``subdivided``: how often each is subdivided before, None for as often as patches
    need; ``acvd``: by plain ACVD. ``patches`` of the training set, ``garment_share`` of them of
    meshes, ``deformed`` by random maps or as they are; the rest are sums of the ``families``.
    ``points`` are kept of each patch and ``reads`` of them read in a step.

    ``turns``, ``pca``: of the :class:`polyfit.network.SpatialTransformer`. ``loss``: "axes", the
    heights and normals of jets along many axes, tabulated once; or "height", the heights of the
    jets that the network's own frames get, with the gradient through frame and fit. ``decay``: the
    rate ``lr`` falls as a cosine; else it stays. ``start``: weights to go on from, a file, or
    "polyfit" or "paper", those of the package.
    """

    model: str = "polyfit"
    order: int = 4
    families: tuple = families.FAMILIES
    meshes: tuple = ()
    cuts: tuple = (6, 10, 16, 25, 40, 60, 100)
    subdivided: int | None = None
    acvd: bool = False
    patches: int = 30_000
    garment_share: float = 0.75
    deformed: bool = True
    points: int = 128
    reads: int = 64
    steps: int = 2500
    batch: int = 512
    lr: float = 1e-3
    decay: bool = True
    loss: str = "axes"
    turns: int = 5
    pca: bool = True
    charts: int = 25
    start: str = ""
    seed: int = 0

    def __post_init__(self):
        if self.model not in MODELS:
            raise InputError(f"model {self.model}: choose among {', '.join(MODELS)}")
        unknown = sorted(set(self.families) - set(families.FAMILIES))
        if unknown:
            raise InputError(
                f"families {', '.join(unknown)}: choose among {', '.join(families.FAMILIES)}"
            )
        if self.loss not in LOSSES:
            raise InputError(f"loss {self.loss}: choose among {', '.join(LOSSES)}")
        for cut in self.cuts:
            if cut != "paper" and not (isinstance(cut, int) and cut > 0):
                raise InputError(f"cuts {cut}: numbers of patches, or paper")
        if self.subdivided is not None and not 0 <= self.subdivided <= 6:
            raise InputError(f"subdivided = {self.subdivided}; 0 to 6 times are possible")
        if not 0 <= self.garment_share <= 1:
            raise InputError(f"garment_share = {self.garment_share}; 0 to 1 is needed")
        for name in ("patches", "points", "reads", "steps", "batch", "charts", "turns"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)}; at least 1 is needed")
        if self.seed < 0:
            raise InputError(f"seed = {self.seed}; at least 0 is needed")
        check_order(self.order)
        if not self.lr > 0:
            raise InputError(f"lr = {self.lr}; more than 0 is needed")
        if self.points > POINTS_PER_PATCH or self.reads > self.points:
            raise InputError(
                f"reads = {self.reads}, points = {self.points};"
                f" reads <= points <= {POINTS_PER_PATCH} is needed"
            )
        if not self.meshes and (not self.families or self.model == "atlasnet"):
            raise InputError(
                "nothing to train on: give meshes"
                + ("" if self.model == "atlasnet" else ", or families")
            )

    def network(self):
        """A fresh network, or that of ``start``. Raises InputError where that is of another kind or
        order.
        """
        if self.start:
            kinds = dict(polyfit=PolyFit, pointnet=PointNet, dgcnn=DGCNN, atlasnet=AtlasNet)
            order = () if self.model == "atlasnet" else (self.order,)
            path = PRETRAINED.get(self.start, self.start)
            return kinds[self.model].load(path, *order).train()
        if self.model == "polyfit":
            stn = SpatialTransformer(points=self.reads, turns=self.turns, pca=self.pca)
            return PolyFit(self.order, stn)
        return (
            {"pointnet": PointNet, "dgcnn": DGCNN}[self.model](self.order)
            if self.model != "atlasnet"
            else AtlasNet(self.charts)
        )
