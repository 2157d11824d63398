"""Channel models scored on published AERPAW flights with fixed splits (see README.md in this folder)."""
