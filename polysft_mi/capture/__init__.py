"""From a video and a photo to a sequence's folder: the steps of ``python -m polysft_mi.prepare
VIDEO``, a module each.

:mod:`command` is the command line; :mod:`frames` decodes, :mod:`images` reads single images,
:mod:`lens` and :mod:`calibration` know the camera, :mod:`size` reads lengths, :mod:`sheet` makes
the template, :mod:`pose` finds it in the first frame, :mod:`masks` follows its silhouette,
:mod:`pictures` shows what each step found, and :mod:`folder` puts them together.
"""
