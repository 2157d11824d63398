"""From paths to channel matrices and levels: Fresnel, dyads, the sum over paths, foliage, baselines."""
