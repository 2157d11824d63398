"""The samples of a flight or a campaign as files that other programs open, one module per format."""
