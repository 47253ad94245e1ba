"""The terms of the objective, one a file. In: a surface, and what a frame shows. Out: its energy on
Dr.Jit arrays and, in closed form, its gradient and Gauss-Newton block. To add one, write a class
as :class:`polysft_mi.objective.terms.term.Term` says, give the setting of its weight to
:class:`polysft_mi.scene.settings.Settings`, and list the class here. Import only after a Mitsuba
variant is set.
"""

from .bending import Bending
from .cameras import Cameras
from .chroma import Chroma
from .coupling import PatchCoupling
from .depth import Depth
from .drape import Drape
from .inextensibility import Inextensibility
from .photometric import Photometric
from .pose import Pose
from .shading import Shading
from .silhouette import Silhouette
from .smoothness import Relief, Sliding
from .temporal import Temporal
from .term import DeviceFrame, Inputs, Term
from .tracks import Tracks
from .volume import Volume

#: all terms, in the order of logs and reports
TERMS: tuple[type[Term], ...] = (
    Photometric,
    Silhouette,
    Shading,
    Chroma,
    Cameras,
    Tracks,
    Depth,
    Drape,
    Pose,
    Inextensibility,
    Volume,
    Temporal,
    Bending,
    PatchCoupling,
    Sliding,
    Relief,
)

__all__ = ["TERMS", "Cameras", "DeviceFrame", "Inputs", "Temporal", "Term"]
