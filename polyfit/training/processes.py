"""The device of a training, and the processes that share it."""

import os
from importlib import import_module

import torch

from polyfit.errors import InputError


class Processes:
    """This process among those of ``torchrun``; alone without it."""

    def __init__(self, device):
        self.count, self.rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
        self.device = torch.device(
            f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
            if device == "cuda" and self.count > 1
            else device
        )
        if self.count > 1:
            # Its functions take the group there is when they are imported as a default, and Adam
            # imports them: after the line below they would keep the group, whose threads then
            # outlive destroy_process_group and now and then abort the ending interpreter.
            import_module("torch.distributed.nn.functional")
            torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")

    def wait(self):
        if self.count > 1:
            torch.distributed.barrier()

    def average(self, network):
        """The mean of all processes' gradients of ``network``."""
        if self.count > 1:
            flat = torch.cat([p.grad.flatten() for p in network.parameters()])
            torch.distributed.all_reduce(flat)
            for p, g in zip(
                network.parameters(),
                (flat / self.count).split([p.numel() for p in network.parameters()]),
            ):
                p.grad.copy_(g.view_as(p))

    def mean(self, figures):
        """The mean over all processes of each number of a dict; all have the same names."""
        if self.count == 1:
            return figures
        values = torch.tensor(list(figures.values()), dtype=torch.float64, device=self.device)
        torch.distributed.all_reduce(values)
        return dict(zip(figures, (values / self.count).tolist()))

    def close(self):
        if self.count > 1:
            torch.distributed.destroy_process_group()


def device_of(name):
    """``name``, checked. Raises InputError for a CUDA device that torch does not see."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: this torch sees no CUDA device")
    return name
