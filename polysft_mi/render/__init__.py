"""The scene and the vertices of the surface go in; an image, what each pixel sees, and their
gradients come out. Importing a name needs a Mitsuba variant.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["device", "pinhole", "silhouette", "topology", "view"],
    submod_attrs={
        "crop": ["Crop"],
        "device": ["frozen", "interruptible", "threads"],
        "pinhole": ["MIN_DEPTH", "Pinhole"],
        "occluder": ["Occluder"],
        "placed": ["PlacedMesh"],
        "raster": ["RasterIntegrator"],
        "silhouette": ["blend"],
        "topology": ["Topology"],
        "view": ["Seen", "View", "point2"],
    },
)
