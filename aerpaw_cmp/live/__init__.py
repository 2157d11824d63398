"""The live tap of a modem: commands, parsing of answers, and the durable log."""
