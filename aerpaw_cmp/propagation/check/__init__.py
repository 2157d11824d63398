"""Checks of a replay: an independent reference, the audit by the other engine, and explanations of paths."""
