"""Channel matrices and levels from paths: Fresnel coefficients, dyads, sum over paths, foliage and baselines."""
