"""The serial port: framing, modem, ports, simulator."""
