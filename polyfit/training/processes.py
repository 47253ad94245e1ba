"""The device of a training, the processes that share it, and what the commands that train have in
common: flags of the run, and its end.
"""

import os
import re
from importlib import import_module

import torch

from polyfit.errors import InputError


class Processes:
    """This process among those of ``torchrun``; alone without it."""

    def __init__(self, device):
        self.count, self.rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
        self.device = torch.device(
            f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
            if device != "cpu" and self.count > 1
            else device
        )
        if self.count > 1:
            # Its functions take the group there is when they are imported as a default, and Adam
            # imports them: after the line below they would keep the group, whose threads then
            # outlive destroy_process_group and now and then abort the ending interpreter.
            import_module("torch.distributed.nn.functional")
            torch.distributed.init_process_group("nccl" if device != "cpu" else "gloo")

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
    """``name``, checked: "cpu", "cuda", or one of several as "cuda:1". Raises InputError for
    others, and for a CUDA device that torch does not see.
    """
    if not re.fullmatch(r"cpu|cuda(:\d+)?", name):
        raise InputError(f"device {name}: cpu or cuda is needed, or one of several as cuda:1")
    if name != "cpu" and int(name[5:] or 0) >= torch.cuda.device_count():
        raise InputError(f"device {name}: this torch sees no such CUDA device")
    return name


def add_run_arguments(parser):
    """Add the flags of checkpoints and of the device."""
    parser.add_argument("--checkpoint-every", type=float, default=120.0, metavar="SECONDS")
    parser.add_argument(
        "--resume", action="store_true", help="continue from OUT/checkpoint.safetensors"
    )
    device = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", default=device, help="cpu or cuda")


def run(train, settings, args, command):
    """Run ``train`` as the flags ``args`` say, and print where the weights are; ``command``: what
    the weights' JSON file says that made them.
    """
    path = train(
        settings,
        args.output,
        device=device_of(args.device),
        resume=args.resume,
        every=args.checkpoint_every,
        command=command,
    )
    if path and int(os.environ.get("RANK", 0)) == 0:
        print(path)
