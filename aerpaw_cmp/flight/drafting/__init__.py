"""A first flight.yaml from logs alone."""
