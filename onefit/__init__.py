"""OneFit: one network that drapes any garment on a moving body (paper, section "OneFit"), in torch,
on PolyFit's patches::

    import onefit

    drape = onefit.load().drape("shirt.obj", onefit.Motion.generate("walk"))
    drape.vertices  # (T, N, 3), metres

A garment goes through these packages in this order: ``body`` and ``motion`` (what it is worn on),
``contact`` (what keeps cloth out of a body), ``garment`` (its mesh, cut into patches), ``network``
(how its patches deform), ``physics`` (steps of cloth), ``draping`` (all frames, by the network or
by steps of cloth); ``objective`` and ``training`` make the network.
Importing the package loads neither torch nor Mitsuba. ``docs/api.md`` lists the public names; other
packages may change without notice.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "body.body": ["AnnyBody", "Body"],
        "body.smpl": ["PlainBody", "SmplBody"],
        "draping.draper": ["Drape", "Draper", "load"],
        "garment.charts.patched": ["PatchedGarment"],
        "garment.garment": ["LOOSE", "TEMPLATES", "Garment"],
        "garment.reading.render_mesh": ["RenderMesh"],
        "motion.motion": ["Motion"],
        "network.network": ["OneFit"],
        "network.weights": ["pretrained"],
        "objective.losses": ["Weights"],
        "physics.material": ["MATERIALS", "Material"],
    },
)
