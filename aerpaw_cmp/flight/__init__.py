"""A checked flight.yaml, its logs as series, pose and clock."""
