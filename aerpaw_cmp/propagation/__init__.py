"""From a site, a link and poses to paths and channel matrices.

``replay.replay(site, link, poses, Search(...), Field(...), Run(...))`` is the door; only ``sionna.py`` loads Sionna.
"""
