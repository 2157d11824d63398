"""No sniffer claims what belongs to another, and docs/sniffers.md says so truly."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.parsers.confusion import claims, table

PAGE = Path(__file__).parents[2] / "docs" / "sniffers.md"


def test_no_false_claim() -> None:
    false = [(name, other) for name, row in claims().items() for other, count in row.items() if count and other != name]
    assert false == []


def test_the_page_is_what_the_code_does() -> None:
    assert table() in PAGE.read_text()


def test_a_greedy_sniffer_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    from aerpaw_cmp.logs.readers import catalogue
    from tests.parsers import confusion

    greedy = tuple(replace(r, sniff=lambda head: b"," in head) if r.name == "aadm_snr" else r for r in catalogue())
    monkeypatch.setattr(confusion, "catalogue", lambda: greedy)
    assert "0 false claims" not in confusion.table()
