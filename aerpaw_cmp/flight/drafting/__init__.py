"""A first flight.yaml, drafted from logs alone."""
