"""Problems of the tracker from folders that :mod:`synthetic` makes. Import only where a Mitsuba variant is set."""

from polysft_mi import prepare, scene
from polysft_mi.problem import Problem
from polysft_mi.sequence import Sequence


def problem_of(folder, **settings):
    prepare.main([str(folder), "--overwrite"])
    experiment = scene.load(str(folder / "scene.xml"), settings)
    s = experiment.settings
    return Problem(experiment, Sequence.open(experiment.frames, experiment.masks, first=s.first, last=s.last, size=experiment.size))
