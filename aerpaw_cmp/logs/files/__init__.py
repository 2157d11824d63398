"""Files of logs: archives, pieces, limits, kinds."""
