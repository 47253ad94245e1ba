"""PolySfT on Mitsuba 3: the surface of a textured template in every frame of a video, by
differentiable rendering.

Run as ``python -m polysft_mi.run scene.xml -o OUT``. Importing the package imports neither Mitsuba
nor Dr.Jit and sets no variant: :func:`polysft_mi.backend.set_variant` does both, once, in an entry
point.
"""

__version__ = "0.1.0"
