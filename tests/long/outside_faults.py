"""Inject faults into a copy of the sources: which do the checks from raw bytes detect, and which the tests?

Each fault changes one line between the bytes of a log and a number of the report. The audit uses the flight of
tests/jobs/test_audit_raw.py (an attitude that rotates all the time, antennas with lobes, a take-off point above the
origin, a radio clock that is ahead). The tests are listed with each fault and need no field data. If the audit need not
detect a fault, the reason is given.

    python -m tests.long.outside_faults [--only TEXT] [--stale] [--no-tests] [--json]
"""

import argparse
import json
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RAW = "tests/jobs/test_audit_raw.py::test_a_right_flight_is_recomputed_to_rounding"
NO_LEVEL = "it moves no pose and no level"


@dataclass(frozen=True)
class Fault:
    """A fault that replaces ``old`` by ``new`` in a file, so that ``tests`` fail.

    ``unseen`` is the reason why the audit need not detect it.
    """

    name: str
    file: str
    old: str
    new: str
    tests: str
    unseen: str = ""


FAULTS = (
    Fault("take-off ground not added to the track", "aerpaw_cmp/flight/data.py", "takeoff_m = site.takeoff_ground_m  #", "takeoff_m = 0.0  #", RAW),
    Fault("take-off ground not added to ranks", "aerpaw_cmp/flight/data.py", "takeoff_m = site.takeoff_ground_m  # altitude_m", "takeoff_m = 0.0  # altitude_m", RAW),
    Fault("attitude held between rows", "aerpaw_cmp/flight/track.py", "Rotation.from_matrix(matrices))(t).as_matrix())", "Rotation.from_matrix(matrices))(at[np.searchsorted(at, t, side='right') - 1]).as_matrix())", "tests/flight/test_track.py"),
    Fault("attitude late by half a second", "aerpaw_cmp/flight/track.py", "Rotation.from_matrix(matrices))(t).as_matrix())", "Rotation.from_matrix(matrices))(np.maximum(t - 0.5, at[0])).as_matrix())", "tests/flight/test_track.py"),
    Fault("positions late by a row", "aerpaw_cmp/flight/track.py", "interpolated(t[valid], self._time_s, self._position)", "interpolated(t[valid] - 1.0, self._time_s, self._position)", "tests/flight/test_track.py"),
    Fault("altitude in feet", "aerpaw_cmp/flight/track.py", "altitude[rows] + self.ground_m", "altitude[rows] * 0.3048 + self.ground_m", "tests/flight/test_track.py"),
    Fault("yaw counter-clockwise", "aerpaw_cmp/propagation/geometry.py", "np.pi / 2 - np.radians(yaw_deg)", "np.pi / 2 + np.radians(yaw_deg)", "tests/flight/test_track.py"),
    Fault("nose up taken for nose down", "aerpaw_cmp/propagation/geometry.py", "-np.radians(pitch_deg)", "np.radians(pitch_deg)", "tests/flight/test_track.py tests/propagation/test_attitude_chain.py"),
    Fault("attitude left in radians", "parsers/aerpaw_parsers/vehicle_out.py", "np.degrees(number[name]) for name in (\"roll\", \"pitch\", \"yaw\")", "number[name] for name in (\"roll\", \"pitch\", \"yaw\")", "tests/parsers/test_formats.py"),
    Fault("pitch, yaw, roll read as roll, pitch, yaw", "parsers/aerpaw_parsers/vehicle_out.py", "_cells(b\"pitch\", b\"yaw\", b\"roll\")", "_cells(b\"roll\", b\"pitch\", b\"yaw\")", "tests/parsers/test_formats.py"),
    Fault("longitude and latitude exchanged in the frame", "aerpaw_cmp/common/geodesy.py", "in_shape(self._projection, longitude, latitude)", "in_shape(self._projection, latitude, longitude)", "tests/common/test_geodesy.py"),
    Fault("local time read as UTC", "aerpaw_cmp/logs/text.py", "return local_to_utc(wall_ns, options.timezone, needed_by=needed_by)", "return local_to_utc(wall_ns, 'UTC', needed_by=needed_by)", "tests/parsers/test_time.py"),
    Fault("radio clock added in place of taken off", "aerpaw_cmp/flight/replay.py", "time - np.timedelta64(round(clock", "time + np.timedelta64(round(clock", RAW),
    Fault("estimated clock with the wrong sign", "aerpaw_cmp/flight/clock.py", "<= 0.0 <= high else self.radio_minus_telemetry_s", "<= 0.0 <= high else -self.radio_minus_telemetry_s", "tests/flight/test_clock.py tests/jobs/test_clock_applied.py", "this flight's clock is given"),
    Fault("patterns of tower and UAV exchanged", "aerpaw_cmp/flight/settings.py", "arrays = {name: self.towers.get(name, self.tower).build(", "self = self.model_copy(update={\"tower\": self.uav, \"uav\": self.tower})\n        arrays = {name: self.towers.get(name, self.tower).build(", RAW),
    Fault("roll of an array missed", "aerpaw_cmp/flight/settings.py", "np.radians(self.roll_deg)", "0.0 * np.radians(self.roll_deg)", "tests/jobs/test_audit_flight.py"),
    Fault("yaw of a mount clockwise", "aerpaw_cmp/propagation/geometry.py", "ca, sa = np.cos(yaw), np.sin(yaw)", "ca, sa = np.cos(yaw), -np.sin(yaw)", "tests/jobs/test_audit_flight.py"),
    Fault("antenna table read clockwise", "aerpaw_cmp/site/antennas.py", "(phi % full).ravel()", "(-phi % full).ravel()", "tests/jobs/test_audit_raw.py"),
    Fault("antenna table upside down", "aerpaw_cmp/site/antennas.py", "at = np.stack([(theta % full)", "at = np.stack([((np.pi - theta) % full)", "tests/jobs/test_audit_raw.py"),
    Fault("two towers exchanged", "aerpaw_cmp/flight/data.py", "_known_tower(_home(log, stream) or", "_known_tower({\"T1\": \"T2\", \"T2\": \"T1\", \"LW1\": \"LW2\", \"LW2\": \"LW1\"}.get(log.node or \"\") or", RAW),
    Fault("antenna 0.3 m higher", "aerpaw_cmp/site/site.py", "self.ground_m + self.antenna_height_m])", "self.ground_m + self.antenna_height_m + 0.3])", "tests/site/test_siteyaml.py"),
    Fault("lowest height 5 m", "aerpaw_cmp/common/units.py", "MINIMUM_HEIGHT_M = 0.5", "MINIMUM_HEIGHT_M = 5.0", "tests/flight/test_track.py", "no sample of this flight is below 5 m"),
    Fault("readings one line late", "aerpaw_cmp/flight/data.py", "measured_db=frame[\"rss_db\"].to_numpy(np.float64)", "measured_db=np.roll(frame[\"rss_db\"].to_numpy(np.float64), 1)", RAW),
    Fault("speed of light 3e8 m/s", "aerpaw_cmp/common/units.py", "SPEED_OF_LIGHT_MPS / frequency_hz", "3e8 / frequency_hz", "tests/common/test_units.py tests/propagation/test_reference.py"),
    Fault("H not transposed where the UAV transmits", "aerpaw_cmp/propagation/field/sum.py", "if link.uav_transmits else matrices", "if not link.uav_transmits else matrices", "tests/propagation/test_reference.py tests/propagation/test_channel.py", "single elements: H is one number"),
    Fault("offset subtracted in place of added", "aerpaw_cmp/compare/level.py", "measured + fit.offset_db - simulated", "measured - fit.offset_db - simulated", "tests/compare/test_rss.py", "residuals are drawn, offset and RMSE stay right"),
    Fault("RMSE about zero in place of the offset", "aerpaw_cmp/compare/offset.py", "return np.asarray(np.hypot(np.sqrt(self.variance_db2), self.mean_db - offset_db))", "return np.asarray(np.hypot(np.sqrt(self.variance_db2), self.mean_db + 0.0 * offset_db))", "tests/compare/test_offset.py"),
    Fault("95 % interval made 90 %", "aerpaw_cmp/compare/statistics.py", "np.nanquantile(drawn, [0.025, 0.975])", "np.nanquantile(drawn, [0.05, 0.95])", "tests/compare/test_statistics.py", "the audit computes no interval"),
    Fault("95 % interval of a pair made 90 %", "aerpaw_cmp/compare/statistics.py", "drawn = square - other_square + mean_draws(", "drawn = square - other_square + 0.84 * mean_draws(", "tests/compare/test_statistics.py", "the audit computes no interval"),
    Fault("a part left out gets an offset from inside", "aerpaw_cmp/compare/calibration.py", "error = (o.samples.residual_db - gain)[outside]", "error = (o.samples.residual_db - gain)[inside]", "tests/compare/test_calibration.py", NO_LEVEL),
    Fault("noise figure with the wrong sign", "aerpaw_cmp/common/units.py", "np.log10(bandwidth_hz)) + noise_figure_db", "np.log10(bandwidth_hz)) - noise_figure_db", "tests/common/test_units.py", NO_LEVEL),
    Fault("K compared with powers", "aerpaw_cmp/compare/rank.py", "(1.0 / k + margin)", "(1.0 / k**2 + margin)", "tests/compare/test_rank.py", "single elements; the audit of links compares ranks"),
)  # fmt: skip


def stale() -> list[str]:
    """Faults whose line is not in the code any more, or not once."""
    counts = [(fault, (ROOT / fault.file).read_text(encoding="utf-8").count(fault.old)) for fault in FAULTS]
    return [f"{fault.name}: '{fault.old}' is {count} times in {fault.file}" for fault, count in counts if count != 1]


def audited() -> list[str]:
    """Failures of the audit from raw bytes, and of the attitude, on the flight of its test."""
    test = runpy.run_path(str(ROOT / "tests/jobs/test_audit_raw.py"))
    with tempfile.TemporaryDirectory() as place:
        try:
            return list(test["checked"](test["write_flight"](Path(place))).failures)
        except Exception as error:  # the flight is refused: that is loud enough
            return [f"refused: {type(error).__name__}: {str(error).splitlines()[0][:100]}"]


def python(copy: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """This interpreter on the copy, without field data and with caches of its own."""
    environment = {key: value for key, value in os.environ.items() if key != "AERPAW_CMP_FIELD_DATA"}
    environment |= {"PYTHONPATH": f"{copy}:{copy / 'parsers'}", "CI": "1", "AERPAW_CMP_CACHE": str(copy / "cache")}
    return subprocess.run([sys.executable, *arguments], cwd=copy, env=environment, capture_output=True, text=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="faults whose name contains this")
    parser.add_argument("--no-tests", action="store_true", help="the audit alone")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--stale", action="store_true", help="only say which faults are not in the code any more")
    parser.add_argument("--audit-here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.audit_here:
        print(json.dumps(audited()))
        return 0
    if lines := stale():
        raise SystemExit("\n".join(lines))
    if options.stale:
        return 0
    rows = []
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "copy"
        for name in ("aerpaw_cmp", "parsers", "tests", "sample_logs", "benchmarks", "docs"):
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        clean = json.loads(python(copy, "tests/long/outside_faults.py", "--audit-here").stdout)
        for fault in (entry for entry in FAULTS if options.only in entry.name):
            file = copy / fault.file
            right = file.read_text(encoding="utf-8")
            file.write_text(right.replace(fault.old, fault.new), encoding="utf-8")
            audit = json.loads(python(copy, "tests/long/outside_faults.py", "--audit-here").stdout)
            failed = None
            if not options.no_tests:
                tests = python(copy, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *fault.tests.split())
                failed = tests.returncode == 1
            file.write_text(right, encoding="utf-8")
            rows.append({"fault": fault.name, "audit": audit[:1], "tests": failed, "unseen": fault.unseen})
            print(
                f"{fault.name:50s} audit: {audit[0][:70] if audit else fault.unseen or 'NOT SEEN':70s} tests: {failed}",
                file=sys.stderr,
                flush=True,
            )
    movers = [row for row in rows if not row["unseen"]]
    result = {
        "clean": clean, "faults": len(rows), "caught_by_tests": sum(row["tests"] is True for row in rows),
        "audit_must_see": len(movers), "caught_by_audit": sum(bool(row["audit"]) for row in movers), "rows": rows,
    }  # fmt: skip
    print(
        json.dumps(result)
        if options.json
        else f"tests {result['caught_by_tests']} of {len(rows)}; audit {result['caught_by_audit']} of {len(movers)} that it must see; clean: {clean or 'no failure'}"
    )
    return int(
        bool(clean)
        or result["caught_by_audit"] < len(movers)
        or (not options.no_tests and result["caught_by_tests"] < len(rows))
    )


if __name__ == "__main__":
    sys.exit(main())
