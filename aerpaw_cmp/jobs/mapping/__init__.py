"""Coverage and rank maps of a site, and scenes of other programs."""
