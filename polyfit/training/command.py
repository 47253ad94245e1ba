"""What the commands that train have in common: flags of the run, and its end."""

import os

import torch

from .processes import device_of


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
