"""What all tests share."""

from __future__ import annotations

import os

from hypothesis import settings

# In CI the same examples run every time, so that a red run can be repeated; elsewhere every run looks further.
settings.register_profile("fixed", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("fixed")
