"""Scene files, loaded and compared with the first frame of their video."""

import numpy as np


def loaded(path, **overrides):
    from polysft_mi.scene import experiment as scene

    return scene.load(path, overrides)


def difference(experiment, spp=1):
    """Mean absolute difference, inside the silhouette, of the rendered template and frame 0; and
    the same for the two mirror images. ``spp``: samples a pixel.
    """
    import mitsuba as mi

    frame = experiment.sequence().frame(0)
    image = np.array(mi.render(experiment.scene, sensor=experiment.sensor, spp=spp))
    inside = image[..., 3] > 0.999
    rgb = image[..., :3]
    assert 0.02 < inside.mean() < 0.9
    return [np.abs(x - frame)[inside].mean() for x in (rgb, rgb[::-1], rgb[:, ::-1])]
