"""From a site, a link and poses to paths and channel matrices.

``tracer.replay(site, link, poses, engine=...)`` is the whole of it; only ``sionna.py`` loads Sionna.
"""
