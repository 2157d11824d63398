"""Paths and channel matrices from a site, a link and poses.

The entry point is ``replay.replay(site, link, poses, Search(...), Field(...), Run(...))``. Only ``search.sionna``
loads Sionna.

Each formula has one implementation:

======================================  ==============================================================
Fresnel coefficients of a face          ``field.fresnel.coefficients`` (``half_space``, ``slab``)
slant of an element                     ``field.dyads.slant_rotation``, ``geometry.Array.slant_parts``
field of an element, reflection         ``field.dyads.field_vector``, ``field.dyads.reflected``
diffraction at a wedge                  ``edges.wedge``, and all paths over edges: ``edges``
sum over paths                          ``field.sum.channel_matrices``
mirror images                           ``search.mirror``, and among thousands of faces ``search.beams``
visibility                              ``search.mirror.Occlusion``, for triangles ``search.beams.segment_cut``
legs of a path                          ``geometry.legs``
======================================  ==============================================================

``check`` computes the same values a second time to audit them. ``check.reference`` shares no code with ``search`` and
``field``.
"""
