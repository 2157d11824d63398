"""Every sniffer over every sample: the matrix of docs/sniffers.md. ``python -m tests.parsers.confusion`` prints it."""

from __future__ import annotations

from aerpaw_cmp.logs.readers import catalogue
from tests.parsers.samples import NO_LOGS, SAMPLES


def claims() -> dict[str, dict[str, int]]:
    """By format: how many of its samples each sniffer claims (own format first in the order of the catalogue)."""
    samples = {name: [data for data, _, _ in of.values()] for name, of in SAMPLES.items()}
    samples |= {name: [data] for name, data in NO_LOGS.items()}
    names = [reader.name for reader in catalogue() if reader.name in samples]
    sniff = {reader.name: reader.sniff for reader in catalogue()}
    return {name: {other: sum(map(sniff[other], samples[name])) for other in sniff} for name in names}


def table() -> str:
    """One line per format: how many samples, and a character per sniffer: its claims, ``.`` for none."""
    found = claims()
    counts = {name: len(SAMPLES.get(name, ())) or 1 for name in found}
    width = max(map(len, found)) + 1
    lines = [f"{'format':<{width}} samples  claimed by the sniffer of (in the order of the lines)"]
    for name, row in found.items():
        marks = "".join(str(row[other]) if row[other] else "." for other in found)
        lines.append(f"{name:<{width}} {counts[name]:>7}  {marks}")
    own = sum(row[name] for name, row in found.items())
    false = sum(count for name, row in found.items() for other, count in row.items() if other != name)
    lines.append(f"{sum(counts.values())} samples, {own} claimed by their own sniffer, {false} false claims")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())  # noqa: T201
