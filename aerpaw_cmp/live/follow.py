"""The present pose from a telemetry log that is still being written."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ..common.errors import InputError
from ..logs.readers import Reader, ReadOptions, identify
from .predict import Predict, Prediction

_MAX_AGE_S = 2.0
# Of a log that is long already, only its end is read.
_TAIL_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class TelemetrySample:
    """Position and attitude of the UAV at ``utc_ns``; angles as in the telemetry record."""

    utc_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    fix: float = math.nan


_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "roll_deg", "pitch_deg", "yaw_deg", "fix")
# Looks at the log over which its least delay is taken: a line may wait some time before it is written.
_DELAYS = 20


class TelemetryFollower:
    """Reads what was appended to a telemetry log since the last look.

    For formats whose lines stand alone (``vehicleOut``). A torn last line waits for its rest; a file that was
    replaced or cut is read anew.

    Parameters
    ----------
    path : Path
        May not exist yet.
    options : ReadOptions
        Zone of the log's clock and so on.
    reader : Reader, optional
        None: told by the content.
    keep_s : float
        History kept in memory [s].
    """

    def __init__(
        self, path: Path, *, options: ReadOptions | None = None, reader: Reader | None = None, keep_s: float = 120.0
    ) -> None:
        self.path = path
        self.rejected = 0
        self._options = options or ReadOptions()
        self._reader = reader
        self._keep_ns = int(keep_s * 1e9)
        self._samples: deque[TelemetrySample] = deque()
        self._delays: deque[float] = deque(maxlen=_DELAYS)
        self._position = 0
        self._identity: tuple[int, int] | None = None

    def poll(self) -> int:
        """Take in what is new.

        Returns
        -------
        int
            Number of new samples.

        Raises
        ------
        InputError
            If the content is no telemetry.
        """
        from ..logs import limits  # loads pandas, as any reader does

        data = self._new_lines()
        if not data.strip():
            return 0
        reader = self._reader = self._reader or identify(data, path=str(self.path))
        result = limits.check(reader.read(data, self._options))
        self.rejected += result.rejected_count
        streams = [stream for stream in result.streams if stream.kind == "telemetry"]
        if not streams:
            if result.streams:
                raise InputError(
                    f"the log holds {result.streams[0].kind} records",
                    expected="telemetry",
                    cause="another log was named to be followed",
                    path=self.path,
                )
            return 0
        frame = streams[0].frame
        times = frame["time"].to_numpy().astype("datetime64[ns]").astype("int64")
        columns = [frame[name].to_numpy(dtype="float64") for name in _COLUMNS]
        self._samples.extend(
            TelemetrySample(int(row[0]), *(float(v) for v in row[1:])) for row in zip(times, *columns, strict=True)
        )
        while self._samples[-1].utc_ns - self._samples[0].utc_ns > self._keep_ns:
            self._samples.popleft()
        self._delays.append((time.time_ns() - self._samples[-1].utc_ns) / 1e9)
        return len(frame)

    @property
    def delay_s(self) -> float | None:
        """Least delay between the time in a line and its arrival, lately; negative: the log's clock is ahead."""
        return min(self._delays) if self._delays else None

    def latest(self) -> TelemetrySample | None:
        """The last sample."""
        return self._samples[-1] if self._samples else None

    def at(self, utc_ns: int) -> TelemetrySample | None:
        """The sample nearest in time, None if it is further away than :data:`_MAX_AGE_S`."""
        if not self._samples:
            return None
        samples = list(self._samples)
        index = bisect_left(samples, utc_ns, key=lambda sample: sample.utc_ns)
        near = min(samples[max(0, index - 1) : index + 1], key=lambda sample: abs(sample.utc_ns - utc_ns))
        return near if abs(near.utc_ns - utc_ns) <= _MAX_AGE_S * 1e9 else None

    def _new_lines(self) -> bytes:
        """Complete lines since the last call."""
        try:
            with self.path.open("rb") as file:
                self._find_place(file)
                file.seek(self._position)
                data = file.read(16 * 2**20)
        except FileNotFoundError:
            return b""
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", expected="a telemetry log", path=self.path) from None
        # the last line may be half written: it waits for its rest
        end = data.rfind(b"\n") + 1
        self._position += end
        return data[:end]

    def _find_place(self, file: BinaryIO) -> None:
        """Begin anew in a file that was replaced or cut."""
        state = os.fstat(file.fileno())
        identity = (state.st_dev, state.st_ino)
        if identity == self._identity and state.st_size >= self._position:
            return
        self._identity, self._position = identity, max(0, state.st_size - _TAIL_BYTES)
        if self._position:
            file.seek(self._position)
            self._position += len(file.readline())


def predict_along(follower: TelemetryFollower, replay_at: Callable[[TelemetrySample], Prediction]) -> Predict:
    """``predict`` for :func:`~aerpaw_cmp.live.tap.Tap`: the prediction at the pose of the followed log.

    Parameters
    ----------
    follower : TelemetryFollower
    replay_at : callable
        Prediction of the replay at a pose.
    """

    def predict(utc_ns: int) -> Prediction | None:
        follower.poll()
        latest, sample = follower.latest(), follower.at(utc_ns)
        if latest is None:
            return None
        now = Prediction() if sample is None else replay_at(sample)
        return dataclasses.replace(
            now,
            fix=None if sample is None else sample.fix,
            telemetry_age_s=(utc_ns - latest.utc_ns) / 1e9,
            telemetry_delay_s=follower.delay_s,
        )

    return predict
