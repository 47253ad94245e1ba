"""What the paper says, in its order, and where this project does it: docs/paper.md's entries."""

from collections.abc import Callable
from dataclasses import dataclass

import paper_figures as figures


@dataclass(frozen=True)
class Entry:
    """``where`` in the paper; what it ``says``; the ``commands`` that do it here; ``figures``, a
    function of the JSON files to a table or a line, "" where nothing was measured; ``why`` these
    differ from the paper's.
    """

    where: str
    says: str
    commands: tuple[str, ...] = ()
    figures: Callable[[dict], str] | None = None
    why: str = ""


GARMENTS = "DATA/garments_snug/tshirt.obj DATA/garments_snug/tank.obj"
RECONSTRUCTION = f"python benchmarks/polyfit_reconstruction.py {GARMENTS} ... -o docs"
ACCURACY = "python benchmarks/polyfit_accuracy.py DATA --runs RUNS --train -o docs"
ONEFIT = "python benchmarks/onefit_paper.py RUNS -o docs"

SECTIONS = {
    "PolyFit": (
        Entry(
            "Section 3, patches",
            "A surface is one function, or is cut into patches by ACVD.",
            (
                "python -m polyfit garment.obj -o surface.ply --cuts acvd",
                f"{RECONSTRUCTION} --tables ways",
            ),
            figures.ways,
            "ACVD's patches are round, and go around a sleeve. Our default cut looks at normals, "
            "too, and its boundaries move to where jets fit; the paper's is `--cuts acvd`.",
        ),
        Entry(
            "Section 3, orientation",
            "PCA, then a rigid spatial transformer of unit quaternions, so that a patch is a "
            "height graph (figure 2a, and figure 1 of the supplement).",
            (
                "python -m polyfit garment.obj -o surface.ply --frames stn",
                f"{RECONSTRUCTION} --tables ways",
            ),
            figures.turned,
            "With our cut PCA is right already, so the transformer is off by default; with plain "
            "ACVD it brings more (the table above). OneFit's tank top comes out alike by both "
            "(table 6), and so do most tracked sheets; the demo is better with it "
            "([tracker.md](tracker.md#the-frame-of-a-sheets-jet)). PCA is the default there, for a "
            "plain install has no torch. All presets take it, the one of the paper's training.",
        ),
        Entry(
            "Section 3, jets",
            "z(u, v) is a polynomial of order n, fitted by least squares; order 4 throughout.",
            ("python -m polyfit garment.obj -o surface.ply --order 4",),
            None,
            "They do not: `polyfit.jets` fits the same jets, in Chebyshev polynomials.",
        ),
    ),
    "PolySfT": (
        Entry(
            "Section 4, model",
            "A single patch, moved by Δα, (Δu, Δv), R_c and T_c (figure 2b), rendered "
            "differentiably, compared in colour and silhouette as in φ-SfT.",
            ("python -m polysft_mi.run scenes/demo.xml -D preset=paper -o OUT",),
            None,
            "The default moves more: jets of order 8, a relief over them, several patches where "
            "one cannot hold the template ([tracker.md](tracker.md)).",
        ),
        Entry(
            "Equations 1 and 2",
            "Edges keep their lengths, k_mi = 0.1; Δα and Δuv change little from frame to frame of "
            "a window, k_tc = 0.05.",
            ("python -m polysft_mi.run scenes/demo.xml -D k_mi=0.1 -D k_tc=0.05 -o OUT",),
            None,
            "They do not; [conventions.md](conventions.md#the-objective) has the formulas and what "
            "the paper leaves open.",
        ),
    ),
    "OneFit": (
        Entry(
            "Section 5, network",
            "Patch encoder, static and dynamic body encoder, decoder with heads for jet "
            "coefficients, translation and scale (figure 3, supplement).",
            (
                "python -m onefit.train -o RUNS/six --preset paper",
                "python -m onefit.train -o RUNS/ours --extras drift looseness held",
            ),
            None,
            "By default the network has more inputs and one more output, each a switch of "
            "`--extras` ([onefit.md](onefit.md#how-it-works)); the preset has none.",
        ),
        Entry(
            "Section 5, losses",
            "Collision, inextensibility, boundary, mesh inextensibility, gravity, inertia; k_b = "
            "5e3, k_mi = 2, k_g = 1, k_c = 1, k_i = 0.5.",
            ("python -m onefit.train -o RUNS/six --preset paper --k-c 1 --k-i 0.5",),
            None,
            "The paper leaves normalisations open; [onefit.md](onefit.md#the-objective) lists how "
            "each was decided.",
        ),
        Entry(
            "Limitations",
            "Seams at patch boundaries are smoothed by a light Laplacian.",
            ("python -m polyfit garment.obj -o surface.ply --smoothing 2",),
            None,
            "A garment's charts are blended by a partition of unity, so no seam opens and nothing "
            "is smoothed.",
        ),
    ),
    "Experiments: PolyFit": (
        Entry(
            "Training",
            "Analytic functions and patches of CLOTH3D, about two hours.",
            ("python -m polyfit.train MESH ... -o RUNS/paper --preset paper",),
            figures.polyfit_training,
            "CLOTH3D may not be used here; six free garments are trained on. Ours has five "
            "quaternions and a table of axes ([polyfit.md](polyfit.md#training)).",
        ),
        Entry(
            "Table 1, and of the supplement",
            "Chamfer distance × 1e3 of six garments, AtlasNet against PolyFit, for 5, 25 and 125 "
            "charts.",
            (f"{RECONSTRUCTION} --tables paper", ACCURACY),
            figures.chamfer,
            "PolyFit is at the floor of the measure, two samplings of the same garment, here and "
            "in the paper. Our AtlasNet is no rival: minutes of training on six "
            "garments, against 5,000 in the paper ([polyfit.md](polyfit.md#training)). The dress "
            "is not among the templates that SNUG publishes.",
        ),
    ),
    "Experiments: PolySfT": (
        Entry(
            "Settings",
            "W = 3, patience 100, period 500; Adam with 1e-3 for (Δu, Δv), 1e-2 for Δα, 1e-4 for "
            "R_c and T_c.",
            ("python -m polysft_mi.run scenes/kinect_paper.xml -D preset=paper -o OUT",),
            None,
            "They do not.",
        ),
        Entry(
            "Table 2",
            "Kinect-Paper, 193 frames: depth RMSE 2.59 mm.",
            (
                "python benchmarks/sft.py --only kinect_paper",
                "python -m polysft_mi.prepare 'DATA/kinect_paper/frame_*.png' "
                "--texture first-frame --corners 228,99 514,120 503,366 207,343 "
                "--size 297mm 251mm --camera camera.json --inset 1.3 -o OUT/masked",
                "python benchmarks/sft.py --only kinect_paper --methods adam-reweighted "
                "--masks OUT/masked/masks",
            ),
            figures.kinect_paper,
            "The paper does not say over what its RMSE is taken. Over all 640×480 pixels, those "
            "beyond the sheet count as zero; over the surface alone the same run has about twice "
            "that. Compare either with itself only. The preset follows the sheet until it is fast, "
            "in frame 114, and falls behind, as told next. Its solver, losses and steps hold the "
            "sheet by *other weights*: lengths ten times as heavy beside the images, for which the "
            "paper has no weight; ties between frames a thousandth, as if a mean over the vertices "
            "in place of a sum; and masks a tenth, which the sequence does not have and `prepare` "
            "makes, drawn in by the 1.3 pixels by which they pass its template in the first frame. "
            "These weights were chosen on frames 70 to 76, 113 to 118 and 125 to 131, with the "
            "default's surface in view, and the whole video was run once. From frame 170 on it is "
            "10 to 30 mm off. On `flag`, which nothing was chosen by, these weights are no better "
            "than the preset's (e3d 0.0073 for 0.0063).",
        ),
        Entry(
            "RGB and silhouette loss",
            "As defined in φ-SfT.",
            (
                "python -m polysft_mi.run scenes/kinect_paper.xml -D data=DATA/kinect_paper -o RUN",
                "python benchmarks/readings.py RUN -o docs",
                "python -m polysft_mi.prepare 'DATA/kinect_paper/frame_*.png' "
                "--texture first-frame --corners 228,99 514,120 503,366 207,343 "
                "--size 297mm 251mm --camera camera.json -o OUT/kinect",
                "python -m polysft_mi.run scenes/kinect_paper.xml -D data=DATA/kinect_paper "
                "-D preset=paper -D masks=OUT/kinect/masks -o OUT/run",
                "python -m polysft_mi.run scenes/kinect_paper.xml -D data=DATA/kinect_paper "
                "-D order=4 -D patches=1 -D canonical_frame=stn -D k_relief=0 -o OUT/jet",
                "python benchmarks/stretch.py OUT/jet --first 3 --last 43 "
                "--only preset 'preset, lengths in mm' 'means over the sheet' -o docs",
                "python benchmarks/stretch.py OUT/jet --masks OUT/kinect/masks -o docs",
                "python benchmarks/stretch.py OUT/jet --first 70 --last 93 --only preset -o docs",
                "python benchmarks/stretch.py OUT/jet --first 119 --last 134 "
                "--only 'other weights' -o docs",
                "python benchmarks/stretch.py OUT/jet --last 115 --only 'weights and contrast, "
                "right masks' -o docs",
            ),
            figures.readings,
            "The preset takes both losses as φ-SfT's program does: absolute differences of stored "
            "pixel values, and of blurred masks, means over the image; colours within the rendered "
            "sheet where there are no masks, as here. The tables say what was tried to hold this "
            "sheet. Norm, colour space, blur (first): no reading falls by more than a tenth in a "
            "third of the way to the next frame. Means over the sheet weigh five times as much; it "
            "stretches and is lost. Lengths in millimetres, as in github.com/dvttran/nsft, are too "
            "stiff. Masks, even the right ones, and residuals weighed and compared nearly as that "
            "program does, do not hold it where it is fast (third, fourth). The descent ends too "
            "early: from frame 70 on the right surface has the lower loss (fifth), and 500 steps "
            "of 1e-4 carry T_c 10 mm where the sheet goes 16. Other weights (Table 2) hold the "
            "fastest frames to 1.1 mm without masks, lose it in frame 131 (last), and hold it with "
            "them.",
        ),
        Entry(
            "Table 3",
            "φ-SfT's synthetic sequences S1 to S4: e3d 0.0234, 0.0298, 0.0266, 0.0026; e_n 6.3°, "
            "4.8°, 10.2°, 0.5°.",
            (
                "python -m polysft_mi.prepare DATA/S1 -o OUT/S1",
                "python -m polysft_mi.run OUT/S1/scene.xml -D preset=paper -o OUT/run",
                "python -m polysft_mi.evaluate OUT/run DATA/S1",
            ),
            figures.simulated,
            "The sequences cannot be had here. A folder of φ-SfT's form (`rgbs/`, `masks/`, an OBJ "
            "file, a texture, `camera.json`) runs as it is, and a test runs a small one; the truth "
            "is a `gt.npz` with `vertices` (T, N, 3) and `faces` (F, 3). The table has sheets of "
            "our own instead.",
        ),
        Entry(
            "Time",
            "About 10 s a frame on a V100.",
            ("python benchmarks/sft.py --only kinect_paper --methods adam",),
            figures.seconds,
            "Two cores of a CPU, no GPU; the default solver needs 15 iterations where Adam needs "
            "hundreds.",
        ),
        Entry(
            "Figure 4",
            "Where the errors of Kinect-Paper are.",
            ("python -m polysft_mi.compare OUT/run DATA/kinect_paper -o OUT/errors",),
            figures.kinect_frames,
            "The command draws the errors in false colours. The twelve frames are those that have "
            "a truth.",
        ),
        Entry(
            "Stability, and figure of the supplement",
            "The surface stays where it is from 300 to 1000 and 5000 iterations.",
            (
                "python benchmarks/stability.py -o docs",
                "python benchmarks/stability.py scenes/kinect_paper.xml -D data=DATA/kinect_paper "
                "-D last=11 -o docs",
            ),
            figures.stability,
            "The newest frame of a window of three, frame 11 of each. Kinect-Paper stays within a "
            "millimetre. Of the demo the image hardly changes from 50 iterations on; its distance "
            "goes on, slowly, towards the truth, for the steps of T_c are small, and its shape "
            "comes no nearer (e3d after alignment 0.020 to 0.021). The time is the processor's, of "
            "the whole window.",
        ),
    ),
    "Experiments: OneFit": (
        Entry(
            "Training",
            "Six garments, 60 sequences of AMASS; batches of 20,000 / K frames; 1e-3 for ten "
            "epochs, then 1e-4; 8 hours on four A100.",
            (
                "python -m onefit.train --motions AMASS/a.npz -o RUNS/six --preset paper",
                "python benchmarks/onefit_paper.py RUNS --short 60 --train six",
                "python benchmarks/onefit_paper.py RUNS --short 240 --train tank-longer "
                "tank-no-mesh-inext-longer tank-no-inext-longer tank-no-col-longer "
                "tank-no-boundary-longer tank-pca-longer",
                "python benchmarks/onefit_paper.py RUNS-LONGER --short 600 --train six",
                "python benchmarks/onefit_paper.py RUNS --commands",
            ),
            figures.onefit_trainings,
            "Each is `python -m onefit.train`, what it asks for, and `-o RUNS/NETWORK --preset "
            "paper --epochs 12 --batch 2000 --epoch-steps` a twelfth of its steps; the lines are "
            "in `docs/onefit_paper.json`. The full trainings are not done: on two cores each "
            "takes five to ten hours. The short ones (`--short 60`) have 720 steps of a tenth of "
            "the batch, on one core of a busy machine; they show what each loss and each garment "
            "of the training brings; all rows of Table 6 but one were trained four times as long, "
            "too. "
            "*package* has ten times as many: it is the network `paper` of the package, which "
            "`python -m onefit.drape --preset paper` takes. A whole one has as many steps of ten "
            "times the batch.",
        ),
        Entry(
            "Figure 5",
            "Trained on a tank top, OneFit drapes tank tops of other styles.",
            (f"{ONEFIT} --tables styles",),
            figures.styles,
            "Of 2,880 steps of training (`tank-longer`). *As trained* is the same pattern, sewn "
            "again.",
        ),
        Entry(
            "Table 4, and figure 6",
            "ε_c of six garments, trained on the dress, and on all six.",
            (
                "python benchmarks/onefit_paper.py RUNS --short 60 --train dress six",
                "python benchmarks/onefit_paper.py RUNS --short 600 --train dress-longer",
                f"{ONEFIT} --tables collisions",
            ),
            figures.collisions,
            "Bodies, motions and garments are others. What a dress alone has taught goes through "
            "other garments' bodies here, too, the more the longer it has learned; what six have "
            "taught does not. The package's other weights, by more inputs, k_c = 4 and cuts, are "
            "in [onefit.md](onefit.md#figures).",
        ),
        Entry(
            "Figures 7 and 8",
            "Loose and tight garments, beside other methods.",
            (
                "python -m onefit.drape dress dance -o OUT --preset paper",
                "python -m onefit.drape dress dance -o OUT --preset paper --post",
            ),
            None,
            "No other method is part of this project; a simulation stands beside ours "
            "([onefit_reference.md](onefit_reference.md)).",
        ),
        Entry(
            "Figure 9",
            "Extreme poses: a high kick in a dress, a cobra in a tank top.",
            (
                "python -m onefit.drape dress kick -o OUT --preset paper",
                f"{ONEFIT} --tables poses",
            ),
            figures.poses,
            "ε_c in motions of our own that are as extreme, of seeds that no training uses; by the "
            "package's network.",
        ),
        Entry(
            "Table 5",
            "Jumpsuit: 2.397 % as it is, 1.982 after an hour of fine-tuning, 1.845 from scratch.",
            (
                "python -m onefit.train jumpsuit --from RUNS/six/weights.safetensors "
                "-o RUNS/jumpsuit-tuned --preset paper --epochs 12",
                "python -m onefit.train jumpsuit -o RUNS/jumpsuit --preset paper",
                "python benchmarks/onefit_paper.py RUNS --short 60 --train jumpsuit jumpsuit-tuned",
                f"{ONEFIT} --tables jumpsuit",
            ),
            figures.jumpsuit,
            "Short trainings, on our motions, which are tamer than AMASS.",
        ),
        Entry(
            "Table 6",
            "Each loss left out, on the tank top.",
            (
                "python benchmarks/onefit_paper.py RUNS --short 60 --train tank tank-no-mesh-inext "
                "tank-no-inext tank-no-col tank-no-boundary tank-pca tank-ours",
                "python benchmarks/onefit_paper.py RUNS --short 240 --train tank-longer "
                "tank-no-mesh-inext-longer tank-no-inext-longer tank-no-col-longer "
                "tank-no-boundary-longer tank-pca-longer",
                f"{ONEFIT} --tables losses losses_longer",
            ),
            figures.losses,
            "Trained for minutes, or half an hour. Mesh inextensibility does what it does in the "
            "paper, the longer the more: without it edges change 1.4 times as much after 720 "
            "steps, 1.9 times after 2,880, in the paper 1.7 times. Collision does far more than "
            "there; without inextensibility edges change more, collisions do not. The last rows "
            "are not the paper's: the boundary loss left out, our inputs and patches, and frames "
            "by PCA alone, which do as well as those of the spatial transformer.",
        ),
        Entry(
            "Table 7",
            "0.48 ms a frame, 3 to 4 ms with the optional pushes.",
            ("python benchmarks/onefit_speed.py -o docs",),
            figures.speed,
            "A CPU of two cores; the last row by `python benchmarks/gpu.py --only drape`."
            " *Network alone* has the vertices, and no ease.",
        ),
    ),
    "Supplement": (
        Entry(
            "Training dataset",
            "Jets, trigonometric functions, Gaussians and Bessel functions, summed, with the "
            "ranges given; K = max(100, min(400, ⌊A / 0.008⌋)); meshes subdivided four times; "
            "100,000 patches; batches of 512, 1e-3.",
            (
                "python -m polyfit.train MESH ... -o OUT --cuts paper --subdivided 4 --acvd "
                "--no-deformed --turns 1 --no-pca --loss height --no-decay",
                "python -m polyfit.train -o OUT --families gaussian",
            ),
            None,
            "By the preset they do not; the centres of the functions, which the paper leaves open, "
            "are uniform in the square.",
        ),
        Entry(
            "Fine-tuning (section 1)",
            "A small number of samples of an object's kind improves accuracy.",
            (
                "python -m polyfit.train MESH ... -o OUT --from polyfit",
                "python benchmarks/polyfit_accuracy.py DATA --runs RUNS --train --only sources "
                "-o docs",
            ),
            figures.tuned,
        ),
        Entry(
            "Figure, orders 1 to 8",
            "Height and normals by the order of the jets.",
            (ACCURACY,),
            figures.orders,
            "Other garments: the paper's are of CLOTH3D.",
        ),
        Entry(
            "Table, with and without the transformer",
            "Height 0.0201 against 0.0259, normals 5.3° against 5.5°.",
            (ACCURACY,),
            figures.transformer,
            "On patches as our cut makes them a transformer has little to mend; on folded ones it "
            "mends a third.",
        ),
        Entry(
            "Table, backbones",
            "PointNet and DGCNN that regress α.",
            (ACCURACY,),
            figures.networks,
            "Minutes of training each. The times are of two cores of a CPU that others used, too; "
            "on idle ones a fifth ([polyfit.md](polyfit.md#training)).",
        ),
        Entry(
            "Table, families",
            "Gaussians alone; four families; and garments' patches.",
            (ACCURACY,),
            figures.families,
        ),
        Entry(
            "Adaptive window",
            "A window moves on when patience or period is over.",
            ("python -m polysft_mi.run scenes/demo.xml -D preset=paper -o OUT",),
            None,
            "They do not ([conventions.md](conventions.md#solver-and-window)). Twelve frames of "
            "the demo take 1 min 41 s on two cores and end 7.6 mm RMSE from the truth (`polysft "
            "evaluate OUT scenes/demo`); by default 17 s and 1.1 mm.",
        ),
        Entry(
            "Figure, Paper-Bend",
            "71 images without truth.",
            (
                "python -m polysft_mi.prepare IMAGES --texture first-frame --corners 212,80 "
                "431,95 420,260 200,241 --size A4 --camera camera.json --no-masks -o OUT/bend",
                "python -m polysft_mi.run OUT/bend/scene.xml -D preset=paper -o OUT/run",
            ),
            None,
            "The images cannot be had here; a folder of images, its camera and the sheet's corners "
            "in the first of them are enough.",
        ),
        Entry(
            "OneFit, garment preprocessing",
            "Garments of CLOTH3D are aligned with the average body in the T-pose: each vertex goes "
            "with the nearest body vertex, then one Laplacian iteration; loose ones by shape only.",
            (
                "python -m onefit.align Tshirt.obj -o tshirt.ply --body SMPL.pkl --shape beta0=1.2",
                "python -m onefit.align Dress.obj -o dress.ply --body SMPL.pkl --loose",
                "python -m onefit.drape tshirt.ply walk -o OUT --made-for T-pose",
            ),
            None,
            "They do not, up to the average body, which is Anny's. From the T-pose a garment is "
            "brought to the stand with lowered arms by skinning.",
        ),
        Entry(
            "OneFit, resolutions",
            "Meshes of any resolution take about the same time.",
            (f"{ONEFIT} --tables resolutions",),
            figures.resolutions,
            "The network's time is the same; the vertices, which someone wants to see, are not. "
            "The cut into patches is another at each resolution, and with it what lies inside. By "
            "the package's network, the T-shirt walking.",
        ),
    ),
}
