"""Files of weights: safetensors with a description, a JSON object, in their header."""

import json
import os
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from polyfit.errors import InputError
from polyfit.files import aside


def write_weights(
    path: str | os.PathLike[str], weights: Mapping[str, Tensor], about: dict[str, Any]
) -> None:
    """Tensors by name, and what they are for; written aside and then renamed."""
    from safetensors.torch import save

    data = save(
        {k: v.detach().cpu().contiguous() for k, v in weights.items()}, {"about": json.dumps(about)}
    )
    with aside(path) as temporary, open(temporary, "wb") as file:
        file.write(data)


def read_weights(
    path: str | os.PathLike[str], model: str, version: int
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """(tensors, description) of a file of :func:`write_weights`. Raises InputError where it cannot
    be read, or is of another model or version.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {}).get("about", "null"))
            weights = {key: file.get_tensor(key) for key in file.keys()}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a file of weights in safetensors ({error})") from None
    if not isinstance(about, dict) or "model" not in about:
        raise InputError(f"{path}: no weights (the file does not say what they are for)")
    if about["model"] != model:
        raise InputError(f"{path}: weights of {about['model']}, not of {model}")
    if about.get("version") != version:
        this = f"and this is version {version}; training again makes new ones"
        raise InputError(f"{path}: weights of version {about.get('version')}, {this}")
    return weights, about


def load_into(
    module: torch.nn.Module, weights: Mapping[str, Tensor], path: str | os.PathLike[str]
) -> None:
    """``module.load_state_dict`` that ends in one line where shapes or names do not match."""
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise InputError(
            f"{path}: weights for a network of another shape ({' '.join(str(error).split())[:160]})"
        ) from None
