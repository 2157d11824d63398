"""Text on what to type after a failure: the last part of every message."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

from .errors import AerpawCmpError, CheckError, InputError, OutputError, one_line

_SETTINGS = (".yaml", ".yml")
_OF_LOGS = [["report"], ["explain"], ["calibrate"], ["campaign"], ["predict"], ["plan"]]


def next_step(error: AerpawCmpError, arguments: Sequence[str]) -> str:
    """Return the step that most likely remedies a failure of a command line; empty if there is none.

    Parameters
    ----------
    error : AerpawCmpError
    arguments : sequence of str
        The command line, without the program's name.

    Returns
    -------
    str
    """
    words = [word for word in arguments[:2] if not word.startswith("-")]
    command = " ".join(["aerpaw-cmp", *words[: 2 if words[:1] in (["site"], ["antenna"]) else 1]])
    place = None if error.path is None else Path(error.path)
    if place is not None and not _exists(place):  # as the flight file names it
        candidates = (Path(word).parent / place for word in arguments if word.endswith(_SETTINGS))
        place = next(filter(_exists, candidates), place)
    if "there is no telemetry log" in error.found:
        named = "--map COLUMN=latitude_deg --map COLUMN=longitude_deg names positions in the log"
        return f"'aerpaw-cmp ingest LOG TELEMETRY --draft flight.yaml' drafts it with telemetry; {named}"
    if isinstance(error, CheckError):
        return "read the page, or run without the check"
    if isinstance(error, OutputError) or re.search(r"after -o\b|a new name", error.expected or ""):
        return "the same command with another name after -o"
    if place is not None and (reader := re.search(r"'(aerpaw-cmp [a-z]+) FILE' reads", error.found)):
        return f"'{reader[1]} {one_line(str(place))}'"
    if place is not None and place.suffix in _SETTINGS and _exists(place) and words[:1] != ["ingest"]:
        line = "" if error.line is None else f", line {error.line},"
        return f"mend {one_line(place.name)}{line} and run the same command"
    if place is not None and error.expected == "a YAML file" and _exists(place) and place.is_dir():
        settings = sorted(path for path in place.iterdir() if path.suffix in _SETTINGS)
        if len(settings) == 1:
            return f"the same command with {one_line(str(settings[0]))}"
        if not settings and words[:1] in _OF_LOGS:
            return f"'aerpaw-cmp ingest {one_line(str(place))} --draft flight.yaml' writes one from its logs"
    if place is None or not isinstance(error, InputError):
        return f"'{command} --help' lists the options"
    if not _exists(place):
        return _nearest(place)
    if not place.is_file():
        return f"'ls {one_line(str(place))}' shows what the folder holds"
    if words[:1] == ["ingest"]:
        # a file that is known for what it is, or a hint of columns, leaves nothing else to type
        unknown = "no reader knows" in error.found and "--map" not in (error.cause or "")
        return "'aerpaw-cmp formats' lists what can be read" if unknown else ""
    if "--tower NAME=" in (error.expected or ""):
        return "the same command with --tower NAME=LATITUDE,LONGITUDE,HEIGHT"
    if words[:1] in _OF_LOGS:
        return f"'aerpaw-cmp ingest {one_line(str(place))}' shows what the file holds"
    return f"the same command with another file than {one_line(place.name)}"


def _exists(place: Path) -> bool:
    try:
        return place.exists()
    except (OSError, ValueError):
        return False


def _nearest(place: Path) -> str:
    """A file with a name like it, or the nearest folder that exists."""
    folder = place.parent
    while not _exists(folder) and folder != folder.parent:
        folder = folder.parent
    try:
        names = [item.name for item in folder.iterdir()]
    except OSError:
        names = []
    # nearly alike: a far name would send to another flight
    near = get_close_matches(place.name, names, n=1, cutoff=0.8) if folder == place.parent else []
    if near:
        return f"the same command with {one_line(str(folder / near[0]))}"
    return f"'ls {one_line(str(folder))}' shows the names there"
