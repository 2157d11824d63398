"""Model of the site: towers, ground, buildings, trees, materials, antennas. This package does not trace rays."""
