"""Lines, rows and clocks of text logs."""
