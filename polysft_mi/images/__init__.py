"""What the images say of a surface: frames and the template's texture in; how well a surface
explains a frame, to second order at its vertices, out. The solver asks one object,
:class:`polysft_mi.images.registration.Registration`. Import only after a Mitsuba variant is set.
"""
