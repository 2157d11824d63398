"""Channel models scored on published AERPAW flights with frozen splits (README.md beside this file)."""
