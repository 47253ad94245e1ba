"""What decides the result of a training."""

from dataclasses import dataclass, field

from onefit.garment import FRAMES
from onefit.network import EXTRAS
from onefit.objective import Weights
from onefit.physics import Material
from polyfit.errors import InputError

# the paper's six garments
STANDARD = ("tshirt", "dress", "trousers", "shorts", "long_sleeve_top", "tank")
OBJECTIVES = ("material", "paper")
# The paper's training (section "Experiments" and supplement). It does not say how many epochs there
# are; k_ext grows for 100.
PRESETS = {
    "paper": dict(
        objective="paper", extras=[], frames="stn", acvd=True, order=4, batch=20_000, epochs=100,
        lr=1e-3, lr_epochs=10, epoch_steps=0, cuts=0, k_c=1.0, k_i=0.5, k_b=5e3, k_mi=2.0, k_g=1.0,
        k_in=1.0, k_bn=1.0,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """What decides the result. ``garments``: by default those of the lessons, or else
    :data:`STANDARD`; ``read``: options of :meth:`onefit.Garment.read`, for those that are files;
    ``fps`` and ``motion_up``: of the files of ``motions``, as
    :meth:`onefit.Motion.read` takes them; ``batch``: patches of a step, all frames together
    (the paper's 20,000); ``lr`` for the first ``lr_epochs`` epochs, a tenth of it for the rest; an
    epoch has ``epoch_steps`` steps (0: as many as show each window of the motions once); ``cuts``:
    how many random cuts (:mod:`onefit.garment.sewing.cuts`) are trained on beside the garments;
    ``objective``: "paper", or "material", the energies of ``material``; where it is not named, the
    latter beside lessons, else the paper's; ``teacher``: a folder of lessons
    (:mod:`onefit.training.teacher`) to learn as well. ``extras``: what the network has beyond the
    paper's (:data:`onefit.network.EXTRAS`); ``frames``, ``acvd``: how garments are cut, as in
    :class:`onefit.PatchedGarment`; with ``start`` all three and ``order`` are those of its network.
    """

    garments: tuple = ()
    read: dict = field(default_factory=dict)
    motions: tuple = ()
    fps: float | None = None
    motion_up: str | None = None
    start: str = ""
    objective: str = ""
    material: str = "cotton"
    teacher: str = ""
    order: int = 4
    extras: tuple = EXTRAS
    frames: str = "pca"
    acvd: bool = False
    batch: int = 20_000
    epochs: int = 30
    lr_epochs: int = 10
    epoch_steps: int = 0
    lr: float = 1e-3
    seeds: int = 4
    shapes: int = 48
    cuts: int = 0
    seed: int = 0
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self):
        for name in ("batch", "epochs", "seeds"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} = {getattr(self, name)}; at least 1 is needed")
        for name in ("epoch_steps", "lr_epochs", "shapes", "cuts", "seed"):
            if getattr(self, name) < 0:
                raise InputError(f"{name} = {getattr(self, name)}; at least 0 is needed")
        if self.objective and self.objective not in OBJECTIVES:
            raise InputError(f"objective '{self.objective}': choose {' or '.join(OBJECTIVES)}")
        unknown = [name for name in self.extras if name not in EXTRAS]
        if unknown:
            raise InputError(f"extras {' '.join(unknown)}: choose among {', '.join(EXTRAS)}")
        if self.frames not in FRAMES:
            raise InputError(f"frames '{self.frames}': choose {' or '.join(FRAMES)}")
        Material.named(self.material)
        if self.teacher and self.cuts:
            raise InputError("--teacher and --cuts: lessons have their own garments and cuts")
        if self.teacher and self.read:
            flag = next(iter(self.read)).replace("_", "-")
            raise InputError(f"--{flag}: for garments' files; --teacher has its own garments")
        if not 2 <= self.order <= 10:
            raise InputError(f"order = {self.order}; the order of OneFit's jets is 2 to 10")
        if not self.lr > 0:
            raise InputError(f"lr = {self.lr}; more than 0 is needed")

    @property
    def lowered(self):
        """The objective in force, one of :data:`OBJECTIVES`."""
        return self.objective or ("material" if self.teacher else "paper")
