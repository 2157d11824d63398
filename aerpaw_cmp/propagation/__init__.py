"""Paths and channel matrices from a site, a link and poses.

The entry point is ``replay.replay(site, link, poses, Search(...), Field(...), Run(...))``. Only ``search.sionna``
loads Sionna.

Each formula has one implementation:

======================================  ==============================================================
Fresnel coefficients of a face          ``field.fresnel.coefficients`` (``half_space``, ``slab``)
slant of an element                     ``field.dyads.slant_rotation``; its parts ``arrays.Array.slant_parts``
field of an element, dyad of a bounce   ``field.dyads.field_vector``, ``field.dyads.reflected``
diffraction at a wedge                  ``field.wedge.wedge``; paths over edges, one file: ``edges``
sum over paths                          ``field.sum.channel_matrices``
mirror images                           ``search.mirror``; among thousands of faces ``search.beams``
visibility                              ``search.occlusion.Occlusion``; of triangles ``search.beams.segment_cut``
legs of a path                          ``paths.legs``
======================================  ==============================================================

``check`` holds the second ways that judge them; ``check.reference`` shares nothing with ``search`` and ``field``.
"""
