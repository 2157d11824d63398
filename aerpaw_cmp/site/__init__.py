"""Model of the site: towers, ground, buildings, trees, materials, antennas. No ray tracer here."""
