"""The commands of the program, in one module per topic."""
