"""What all readers of motion files share: numbers are checked, and the motion is put on the
ground.
"""

import numpy as np
import torch

from onefit.body import skeleton, skinning
from polyfit.errors import InputError


def require_finite(path, **arrays):
    """Raises InputError, with the name and the first bad frame of an array (T, ...) that is not
    finite.
    """
    for key, array in arrays.items():
        bad = ~np.isfinite(array).reshape(len(array), -1).all(1)
        if bad.any():
            where = f"{bad.sum()} of {len(bad)} frames, the first is frame {bad.argmax()}"
            raise InputError(
                f"{path}: {key} are not finite in {where}; cut them out or fill them in"
            )


def placed(poses, translation):
    """``(poses (T, 24, 3) [rad], translation (T, 3) [m])``, float32, of arrays, moved as a whole.

    The motion starts at x = y = 0, and its lowest foot stands where the standard body's feet do.
    Files seldom say where the floor is and how tall the person was.
    """
    at = skeleton.INDEX["left_foot"], skeleton.INDEX["right_foot"]
    poses = torch.as_tensor(poses, dtype=torch.float32)
    feet = (
        skinning.joint_places(skeleton.standard_joints(), poses, torch.zeros(len(poses), 3))[
            :, at, 2
        ]
        .amin(1)
        .double()
        .numpy()
    )
    translation = translation - [
        translation[0, 0],
        translation[0, 1],
        (feet + translation[:, 2]).min() - skeleton.standard_joints()[at[0], 2].item(),
    ]
    return poses, torch.as_tensor(translation, dtype=torch.float32)
