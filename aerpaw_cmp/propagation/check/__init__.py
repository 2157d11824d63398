"""Second ways: an independent reference, the audit by the other engine, explanations. Nothing above imports it."""
