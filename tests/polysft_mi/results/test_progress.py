"""What a run says of where it is."""

import re

from polysft_mi.results import Progress
from polysft_mi.scene.settings import Settings


def test_frames_that_are_gone_over_again_count(capsys):
    """Four frames, then two backward and three forward."""
    order = [0, 1, 2, 3, 2, 1, 1, 2, 3]
    with Progress(4, Settings(sweeps=1), quiet=False) as progress:
        assert progress.total == len(order)
        for done, frame in enumerate(order):
            progress(done, frame, 0, 0.5, {"rgb": 0.5})
    lines = capsys.readouterr().err.splitlines()
    assert [re.match("(again )?frame [1-4]/4 loss 0.5", line).group(1) for line in lines] == (
        4 * [None] + 5 * ["again "]
    )
    assert [int(line.split("/")[0][-1]) - 1 for line in lines] == order


def test_a_second_pass_counts_as_soon_as_it_begins(capsys):
    with Progress(3, Settings(), quiet=False) as progress:
        for done, frame in enumerate((0, 1, 2, 1, 2)):
            progress(done, frame, 0, 0.5, {})
    lines = capsys.readouterr().err.splitlines()
    assert progress.total == 6 and all("-" not in line for line in lines)
    assert lines[3].startswith("again frame 2/3")
