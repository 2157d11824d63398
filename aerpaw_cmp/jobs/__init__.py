"""The jobs of the commands, each divided into named stages."""
