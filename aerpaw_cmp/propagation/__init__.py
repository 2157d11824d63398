"""From a site, a link and poses to paths and channel matrices.

``aerpaw_cmp.propagation.tracer(site, link, poses, engine=...)`` is the whole of it; Sionna is loaded only by its engine.
"""

from .audit import Audit, audit
from .tracer import Replay, replay

# the functions hide the modules of the same name on purpose: the modules stay importable by their dotted names
__all__ = ["Audit", "Replay", "audit", "replay"]
