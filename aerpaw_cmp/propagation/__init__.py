"""From a site, a link and poses to paths and channel matrices.

``replay.replay(site, link, poses, Search(...), Field(...), Run(...))`` is the door; only ``sionna.py`` loads Sionna.

Where each law stands: Fresnel coefficients in ``field.fresnel``, the slant rotation and the dyad of a reflection in
``field.dyads``, the wedge in ``field.wedge``, the sum over paths in ``field.sum``; what hides in ``search.occlusion``,
mirror images in ``search.mirror``; the second ways that judge them in ``check``.
"""
