"""The tap beside a replay."""
