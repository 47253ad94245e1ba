"""The scene and the vertices of the surface go in; an image, what each pixel sees, and their
gradients come out. :mod:`stage` draws any mesh for pictures. Importing a name needs a Mitsuba
variant.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["device", "pinhole", "silhouette", "stage", "topology", "video", "view"],
    submod_attrs={
        "crop": ["Crop"],
        "device": ["frozen", "interruptible", "on_device", "threads"],
        "pinhole": ["MIN_DEPTH", "Pinhole"],
        "occluder": ["Occluder"],
        "placed": ["PlacedMesh"],
        "raster": ["RasterIntegrator"],
        "silhouette": ["blend"],
        "stage": ["SideView", "Triangles"],
        "topology": ["Topology"],
        "video": ["read_video", "write_video"],
        "view": ["Seen", "View", "point2"],
    },
)
