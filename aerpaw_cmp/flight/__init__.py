"""A flight: its checked flight.yaml, its logs as series, its poses and its clocks."""
