"""The settings of a training of PolyFit's network, or of one that it is compared with."""

from dataclasses import dataclass

from polyfit.baselines import DGCNN, AtlasNet, PointNet
from polyfit.errors import InputError
from polyfit.network import PolyFit, SpatialTransformer

from . import families

MODELS = ("polyfit", "pointnet", "dgcnn", "atlasnet")
POINTS_PER_PATCH = 256  # points that are made of each patch


@dataclass(frozen=True)
class Settings:
    """What decides the result. ``cuts``: the numbers of patches that each mesh is cut into;
    ``points`` are kept of each patch and ``reads`` of them read in a step.
    """

    model: str = "polyfit"
    order: int = 4
    families: tuple = families.FAMILIES
    meshes: tuple = ()
    cuts: tuple = (6, 10, 16, 25, 40, 60, 100)
    patches: int = 30_000
    points: int = 128
    reads: int = 64
    steps: int = 2500
    batch: int = 512
    lr: float = 1e-3
    charts: int = 25
    seed: int = 0

    def __post_init__(self):
        if self.model not in MODELS:
            raise InputError(f"model {self.model}: choose among {', '.join(MODELS)}")
        unknown = sorted(set(self.families) - set(families.FAMILIES))
        if unknown:
            raise InputError(
                f"families {', '.join(unknown)}: choose among {', '.join(families.FAMILIES)}"
            )
        for name in ("patches", "points", "reads", "steps", "batch", "charts"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)}; at least 1 is needed")
        if not 1 <= self.order <= 10:
            raise InputError(f"order = {self.order}; the order of a jet is 1 to 10")
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
        if self.model == "polyfit":
            return PolyFit(self.order, SpatialTransformer(points=self.reads))
        return (
            {"pointnet": PointNet, "dgcnn": DGCNN}[self.model](self.order)
            if self.model != "atlasnet"
            else AtlasNet(self.charts)
        )
