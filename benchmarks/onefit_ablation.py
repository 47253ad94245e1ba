"""What each loss is for: a network trained on one garment with all losses, and without one of them
after the other (the paper's ablation).

    python benchmarks/onefit_ablation.py -o RUNS [--garment tank] [--epoch-steps 30]

Each training has twelve epochs, ten at the full rate; a run that RUNS holds already is not made
again. Measured as by onefit_accuracy.py, without post-processing and without ease: what the network
alone makes.
"""

import argparse
from pathlib import Path

import onefit_accuracy as accuracy

import onefit
from onefit import training
from onefit.objective import Weights
from polyfit.errors import cli

CASES = {
    "all losses": {},
    "no mesh inextensibility": dict(k_mi=0.0),
    "no inextensibility": dict(k_i=0.0),
    "no collision": dict(k_c=0.0),
    "no boundary": dict(k_b=0.0, k_bn=0.0),
    "no gravity": dict(k_g=0.0),
    "no inertia": dict(k_in=0.0),
}


def line(case, found):
    return (
        f"| {case} | {found['collision']:.2f} | {found['edge']:.1f} | {found['area']:.1f} |"
        f" {found['energy']:.3f} |"
    )


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", required=True, help="folder of the runs")
    parser.add_argument("--garment", default="tank")
    parser.add_argument("--epoch-steps", type=int, default=30)
    parser.add_argument("--batch", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each motion (default: 2)")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    args = parser.parse_args(argv)
    print("| trained with | ε_c % | ε_e % | ε_a % | energy J |\n|---|---|---|---|---|")
    for case in args.cases:
        folder = Path(args.output) / case.replace(" ", "-")
        weights = Weights(**CASES[case])
        settings = training.Settings(
            garments=(args.garment,),
            batch=args.batch,
            epochs=12,
            epoch_steps=args.epoch_steps,
            objective="paper",
            weights=weights,
        )
        if not (folder / "weights.safetensors").exists():
            training.train(
                settings,
                folder,
                resume=(folder / "checkpoint.safetensors").exists(),
                command="benchmarks/onefit_ablation.py",
            )
        draper = onefit.load(folder / "weights.safetensors")
        garment = draper.garment(args.garment)
        if case == args.cases[0]:
            print(
                line(
                    "plain skinning",
                    accuracy.row(draper, garment, args.seconds, 4, skinning_only=True),
                ),
                flush=True,
            )
        print(line(case, accuracy.row(draper, garment, args.seconds, 4, eased=False)), flush=True)
    return 0


if __name__ == "__main__":
    cli(main)
