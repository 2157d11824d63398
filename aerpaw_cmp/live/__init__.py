"""The live tap of a modem: framing, commands, durable log."""
