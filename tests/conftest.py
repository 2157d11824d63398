"""What all tests share."""

from __future__ import annotations

import os
import tempfile

from hypothesis import settings

# In CI the same examples run every time, so that a red run can be repeated; elsewhere every run looks further.
# No deadlines: a busy machine is no fault.
settings.register_profile("further", deadline=None)
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed" if os.environ.get("CI") else "further")

# Nothing kept on this machine decides a test, and no test leaves anything in the user's cache.
os.environ["AERPAW_CMP_CACHE"] = tempfile.mkdtemp(prefix="aerpaw-cmp-tests-")
