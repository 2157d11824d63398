"""The commands and their one-line help, for ``--help`` without loading anything and for the command line itself."""

from __future__ import annotations

COMMANDS: dict[str, str] = {
    "ingest": "Read logs of any known format, account for every line, write a flight file.",
    "formats": "List the log formats that can be read, with a sample line of each.",
    "report": "Replay a flight, calibrate, compare with the measurement, write the report.",
    "campaign": "Many flights and settings: pooled offsets, held-out flights, repeatability.",
    "explain": "Every path of a link at an instant: faces, angles, each loss, the sum.",
    "diff": "Differences between two reports of a flight: settings, inputs, numbers with intervals.",
    "calibrate": "Learn antennas from several flights; score them on what was left out.",
    "tap": "Log the rank indicator live from the modem's serial port.",
    "modem-sim": "A pseudo-terminal that behaves like the modem, to try the tap without hardware.",
    "predict": "Level and rank with error bars on a route, a grid or points, before a flight.",
    "plan": "Which flight next: candidate routes by the standard deviation they would leave.",
    "locate": "Where an unknown transmitter or receiver on the ground stands, by levels of a flight.",
    "channel": "The channel along a flight or a route as files: paths, H, Doppler, levels.",
    "map": "Coverage and rank maps of a site, Kriging of rank and its baselines.",
    "simulate": "Write the logs of a planned flight in the real formats, with their truth.",
    "sample": "Copy the sample flight, logs and flight.yaml, into a folder of your own.",
    "site": "Make a site of maps or of a Mitsuba scene (import), look at it (show), export it.",
    "antenna": "An antenna pattern in the formats of other programs (export).",
    "bench": "Speed against error of the replay on this machine.",
    "doctor": "Is this machine ready? LLVM, Sionna RT, memory, serial ports, with remedies.",
}
