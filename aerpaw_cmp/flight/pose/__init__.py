"""Place and time of the UAV: track, heights, clock, routes."""
