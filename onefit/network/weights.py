"""Trained networks: files, and those that come with the package."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from polyfit.errors import InputError
from polyfit.files import as_path
from polyfit.network import load_into, read_weights, write_weights

VERSION = 4  # of the network's shape and the meaning of its weights
_SCALE = ":scale"  # after the name of a matrix: its rows' scales
FOLDER = Path(__file__).parents[1] / "data" / "weights"


def pretrained() -> tuple[str, ...]:
    """Names of the networks that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.safetensors")))


@dataclass(frozen=True)
class Trained:
    """A ``network`` (:class:`onefit.OneFit`), the ``body`` model's kind that it was trained
    on, and the names of its ``garments``.
    """

    network: Any  # torch.nn.Module, whose type tells nothing of its parts
    body: str
    garments: tuple


def save(path, network, model, garments):
    """The weights of ``network``, matrices in eight bits a number and a scale for each row, with
    what is needed to use them: ``model``, the body model, and ``garments``, names."""
    about = dict(
        model="onefit",
        version=VERSION,
        shape=network.shape,
        body=model.kind,
        garments=list(garments),
    )
    tensors = {}
    for name, tensor in network.state_dict().items():
        if tensor.ndim == 2:
            scale = tensor.abs().amax(1, keepdim=True).clamp(min=1e-12) / 127
            tensors[name], tensors[f"{name}{_SCALE}"] = (
                (tensor / scale).round().to(torch.int8),
                scale,
            )
        else:
            tensors[name] = tensor
    write_weights(path, tensors, about)


def load(name: str | os.PathLike[str]) -> Trained:
    """The :class:`Trained` network of a file, or one of :func:`pretrained` by its name. Raises
    InputError.
    """
    from .network import OneFit

    path = Path(as_path(name, "weights"))
    if not path.exists():
        path = FOLDER / f"{name}.safetensors"
        if not path.exists():
            raise InputError(
                f"weights {name}: no such file, nor one of the package's:"
                f" {', '.join(pretrained()) or 'none'}"
            )
    tensors, about = read_weights(path, "onefit", VERSION)
    network = OneFit(**about["shape"])
    values = {
        k: v.float() * tensors.get(f"{k}{_SCALE}", 1.0)
        for k, v in tensors.items()
        if not k.endswith(_SCALE)
    }
    load_into(network, values, path)
    return Trained(network.eval(), about["body"], tuple(about["garments"]))
