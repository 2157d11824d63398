"""Every message of the command line, once per command and kind of fault: found, expected, likely cause, what to type.

python -m tests.test_messages        writes docs/reference/messages.md, the table of all of them
"""

import contextlib
import io
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from aerpaw_cmp.__main__ import main
from tests.test_cli_bad_input import FLIGHT, GOOD_POWER, GOOD_TELEMETRY

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "messages.md"
FILES = {
    "flight.yaml": FLIGHT,
    "vehicleOut.txt": GOOD_TELEMETRY,
    "power_log.txt": GOOD_POWER,
    "syntax.yaml": "flight: [a\nsite: lake_wheeler\n",
    "key.yaml": FLIGHT.replace("site:", "sight:"),
    "type.yaml": FLIGHT.replace("audit_links: 0", "audit_links: many"),
    "no_log.yaml": FLIGHT.replace("power_log.txt", "gone.txt"),
    "zone.yaml": FLIGHT.replace("America/New_York", "America/New_Pork"),
    "damaged.yaml": FLIGHT.replace("power_log.txt", "damaged.txt"),
    "damaged.txt": "\x00\x01 no log at all \x02\n" * 40,
    "empty.txt": "",
    "campaign_key.yaml": "campaign: a\nflights: [flight.yaml]\nsetings: {}\n",
    "campaign.yaml": "campaign: a\nflights: [gone.yaml]\n",
    "calibration_key.yaml": "calibration: a\nflights: [flight.yaml]\nfitt: {}\n",
    "calibration.yaml": "calibration: a\nflights: [gone.yaml]\n",
    "notes.txt": "keep me\n",
    "page/notes.txt": "keep me\n",
    "route.kml": "<kml></kml>\n",
    "scores.csv": "a,b\n1,2\n",
}
# Commands of each kind of fault that the page shows.
ON_PAGE = 3

# Command lines that meet each kind of fault.
KINDS: dict[str, list[str]] = yaml.safe_load(Path(__file__).with_name("messages.yaml").read_text(encoding="utf-8"))


@contextlib.contextmanager
def place(folder: Path) -> Iterator[None]:
    """A folder with the files, as the working folder."""
    for name, text in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def said(line: str) -> tuple[int, str]:
    """Exit code and message of a command line."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(line.split())
    _, mark, message = err.getvalue().partition("aerpaw-cmp: ")
    return code, f"{mark}{message}".strip()


def table() -> str:
    """All messages in a page."""
    lines = [
        "# Messages of the command line",
        "",
        "Each kind of fault, some commands that can meet it, and what they say: found, expected, likely cause. The next step, with",
        "which a message ends if there is one, is not shown here.",
        "Made by the program `tests/test_messages.py`. Commands stand without `aerpaw-cmp`. `exit` is the exit code: 2 wrong usage or configuration, 3 an input",
        "that cannot be read or an output that cannot be written.",
    ]
    with tempfile.TemporaryDirectory() as folder, place(Path(folder)):
        for kind, commands in KINDS.items():
            lines += ["", f"## {kind.capitalize()}", "", "| command | exit | message |", "| --- | --- | --- |"]
            for line in commands[:ON_PAGE]:
                code, text = said(line)
                shown = text.replace(folder, "...").replace("|", "\\|").replace("\n", "<br>").replace("<kml", "&lt;kml")
                sentences = re.split(r"[.?]? Next: ", shown.removeprefix("aerpaw-cmp: "))[0]
                lines.append(f"| `{line}` | {code} | {sentences} |")
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module", autouse=True)
def files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with place(tmp_path_factory.mktemp("messages")):
        yield


@pytest.mark.parametrize(("kind", "line"), [(kind, line) for kind, lines in KINDS.items() for line in lines])
def test_a_message_says_what_was_found_what_is_expected_and_what_to_type(kind: str, line: str) -> None:
    code, text = said(line)
    assert code in (2, 3)
    assert text.startswith("aerpaw-cmp: ")
    assert "Traceback" not in text
    assert "Errno" not in text
    parts = re.split(r"; expected |\. Likely cause: |[.?] Next: |; did you mean ", text)
    assert len(parts[0].split()) >= 3
    assert re.search(r"expected |Likely cause: |did you mean |problems\n", text), "neither expected nor likely cause"
    # a log that is known for what it is leaves nothing to type
    assert re.search(r"Next: \S|did you mean ", text) or line.startswith("ingest "), "nothing to type next"
    assert len(text.splitlines()[0]) < 420


def test_every_message_stands_in_the_page() -> None:
    """The page lists the first commands that are tried, kind by kind."""
    listed = re.findall(r"^\| `(.*?)` \| \d", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert listed == [line for lines in KINDS.values() for line in lines[:ON_PAGE]]


if __name__ == "__main__":
    PAGE.write_text(table(), encoding="utf-8")


def test_a_folder_in_place_of_its_settings_is_answered_by_the_file_or_by_how_to_write_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logs").mkdir()
    assert main(["report", "logs"]) == 2
    assert "Next: 'aerpaw-cmp ingest logs --draft flight.yaml' writes one from its logs" in capsys.readouterr().err
    (tmp_path / "logs/mine.yaml").write_text("flight: a\n")
    assert main(["report", "logs"]) == 2
    assert "Next: the same command with logs/mine.yaml" in capsys.readouterr().err
