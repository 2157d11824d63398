"""The rank and level that the replay predicts for the present pose, computed in parallel with the polling.

The tap passes a time and gets records back. Functions of the caller convert a time to a pose, and a pose to a rank.
:class:`~aerpaw_cmp.live.predict.TelemetryFollower` returns the pose from a telemetry log that is still being written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import queue
import threading
import time
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..common.errors import InputError
from ..common.files import opened
from ..logs.readers import Reader, ReadOptions

RANKS = (1, 4)


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """The prediction for the pose at one time, and the state of the telemetry at that time.

    Parameters
    ----------
    rank : int or None
        Predicted rank. None: no pose, or out of coverage.
    level_dbm : float or None
        Predicted level before any offset [dBm].
    east_m, north_m, up_m : float or None
        Position in the site frame. None if there is no pose at that time.
    fix : float or None
        Kind of the GPS fix. A kind below 3 means that there is no position.
    telemetry_age_s : float or None
        Age of the newest line of the telemetry log. None if there is no line yet.
    telemetry_delay_s : float or None
        Smallest recent delay of the telemetry lines. Negative if the clock of the telemetry is ahead of the clock of
        this computer.
    """

    rank: int | None = None
    level_dbm: float | None = None
    east_m: float | None = None
    north_m: float | None = None
    up_m: float | None = None
    fix: float | None = None
    telemetry_age_s: float | None = None
    telemetry_delay_s: float | None = None


# ``predict(utc_ns)`` returns None if the pose at that time is unknown.
Predict = Callable[[int], "Prediction | None"]


class RunningInterval:
    """An interval for the next residual, computed from the residuals before it.

    Parameters
    ----------
    share : float
        Share of residuals that the interval should contain.
    least : int
        Smallest number of residuals for an interval.
    keep : int
        Number of stored residuals.

    Notes
    -----
    The bounds are order statistics of the last ``keep`` residuals. Neighbours in time are correlated, so quantiles
    alone would cover less than ``share``. Therefore, after each residual, the tail share ``a`` is changed by
    ``a += step (1 - share - outside)`` (Gibbs and Candes 2021, doi 10.48550/arXiv.2106.00170). This update makes the
    long-run share correct for any sequence.

    Examples
    --------
    >>> interval = RunningInterval(least=3)
    >>> for residual in (1.0, 2.0, 3.0):
    ...     interval.add(residual)
    >>> interval.middle, interval.bounds()
    (2.0, (1.0, 3.0))
    """

    STEP = 0.02

    def __init__(self, share: float = 0.9, least: int = 20, keep: int = 1200) -> None:
        self._share, self._least = share, least
        self._recent: deque[float] = deque(maxlen=keep)
        self._sorted: list[float] = []
        self._tails = 1.0 - share
        self.given = self.inside = 0

    @property
    def middle(self) -> float | None:
        """Median of the residuals so far: the offset between prediction and measurement."""
        return self._sorted[len(self._sorted) // 2] if self._sorted else None

    def bounds(self) -> tuple[float, float] | None:
        """Return bounds of the next residual. None if there are too few residuals, or if the interval is unbounded."""
        n = len(self._sorted)
        if n < self._least or self._tails <= 0.0:
            return None
        # the two order statistics must not cross, even for wide tails
        beyond = min((n - 1) // 2, max(0, math.floor(0.5 * self._tails * (n + 1)) - 1))
        return self._sorted[beyond], self._sorted[n - 1 - beyond]

    def add(self, residual: float) -> None:
        """Add a residual. Read the interval for this residual before, because the residual changes later intervals."""
        bounds = self.bounds()
        outside = bounds is not None and not bounds[0] <= residual <= bounds[1]
        if bounds is not None:
            self.given += 1
            # count before adding the residual, because an interval must not depend on the value that tests it
            self.inside += not outside
        if len(self._sorted) >= self._least:
            self._tails += self.STEP * (1.0 - self._share - outside)
        if len(self._recent) == self._recent.maxlen:
            del self._sorted[bisect_left(self._sorted, self._recent[0])]
        self._recent.append(residual)
        insort(self._sorted, residual)


@dataclass(frozen=True, slots=True)
class Query:
    """A request for the prediction at an answer of the modem, with the times of answer and command and the values."""

    utc_ns: int
    sent_utc_ns: int
    rank: int | None
    rsrp_dbm: float | None = None


class PredictionWorker:
    """A thread that runs ``predict``. While it is busy, further requests are dropped.

    Parameters
    ----------
    predict : callable
    """

    def __init__(self, predict: Predict) -> None:
        self._predict = predict
        # only one request may wait, because a prediction for an earlier time would be too late for the pilot
        self._wanted: queue.Queue[Query | None] = queue.Queue(maxsize=1)
        self._done: deque[dict[str, Any]] = deque(maxlen=1000)
        self._rank, self._level = RunningInterval(), RunningInterval()
        self._thread = threading.Thread(target=self._run, name="tap-prediction", daemon=True)
        self._thread.start()

    def ask(self, request: Query) -> None:
        """Request the prediction for an answer, unless another request is waiting."""
        with contextlib.suppress(queue.Full):
            self._wanted.put_nowait(request)

    def results(self) -> list[dict[str, Any]]:
        """Return finished predictions, each with measured rank and residual (measured minus predicted)."""
        return [self._done.popleft() for _ in range(len(self._done))]

    def close(self) -> None:
        """Finish the pending request, and wait for it at most 2 s."""
        try:
            self._wanted.put(None, timeout=2.0)
        except queue.Full:
            return
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while (request := self._wanted.get()) is not None:
            result: dict[str, Any] = {
                "for_sent_utc_ns": request.sent_utc_ns,
                "at_utc_ns": request.utc_ns,
                "measured": request.rank,
                "predicted": None,
            }
            try:
                prediction = self._predict(request.utc_ns)
                if prediction is not None:
                    result |= self._compared(request, prediction)
            except Exception as error:  # an error of the replay must not end the log
                result["error"] = f"{type(error).__name__}: {error}"[:300]
            self._done.append(result)

    def _compared(self, request: Query, now: Prediction) -> dict[str, Any]:
        """Return prediction, interval and residual for the record. The measurement affects only later intervals."""
        places = ("east_m", "north_m", "up_m", "fix", "telemetry_age_s", "telemetry_delay_s")
        fields: dict[str, Any] = {"predicted": now.rank}
        fields |= {name: _rounded(getattr(now, name)) for name in places}
        if now.rank is not None:
            if (bounds := self._rank.bounds()) is not None:
                low, high = (min(max(now.rank + round(bound), RANKS[0]), RANKS[1]) for bound in bounds)
                fields["rank_interval"] = [low, high]
            if request.rank is not None:
                fields["residual"] = request.rank - now.rank
                self._rank.add(fields["residual"])
        if now.level_dbm is not None and math.isfinite(now.level_dbm):
            fields |= {"level_dbm": _rounded(now.level_dbm), "rsrp_dbm": request.rsrp_dbm}
            fields["offset_db"] = _rounded(self._level.middle)
            if (bounds := self._level.bounds()) is not None:
                fields["level_interval_dbm"] = [_rounded(now.level_dbm + bound) for bound in bounds]
            if request.rsrp_dbm is not None:
                self._level.add(request.rsrp_dbm - now.level_dbm)
        fields["inside"] = [self._rank.inside, self._rank.given, self._level.inside, self._level.given]
        return fields


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, 3)


_MAX_AGE_S = 2.0
# Size of the end of the telemetry log that is read: more than a hundred lines of vehicleOut [bytes].
_TAIL_BYTES = 16_384


@dataclass(frozen=True, slots=True)
class TelemetrySample:
    """Position and attitude of the UAV at ``utc_ns``, with angles as in the telemetry record."""

    utc_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    fix: float = math.nan


_COLUMNS = ("latitude_deg", "longitude_deg", "altitude_m", "roll_deg", "pitch_deg", "yaw_deg", "fix")
# Number of reads of the log from which the smallest delay is taken, because lines may be written late.
_DELAYS = 20


class TelemetryFollower:
    """A reader of the last lines of a telemetry log that is still being written.

    Only formats with independent lines (``vehicleOut``) are supported.

    Parameters
    ----------
    path : Path
        Telemetry log, which may not exist yet.
    reader : Reader
        Reader of the log.
    options : ReadOptions
        Options such as the time zone of the log's clock.

    Attributes
    ----------
    samples : list of TelemetrySample
        The samples of the last lines.
    """

    def __init__(self, path: Path, reader: Reader, options: ReadOptions) -> None:
        self.path, self._reader, self._options = path, reader, options
        self.samples: list[TelemetrySample] = []
        self._delays: deque[float] = deque(maxlen=_DELAYS)

    def poll(self) -> None:
        """Read the end of the log.

        Raises
        ------
        InputError
            If the content is not telemetry.
        """
        from ..logs import limits  # import here, because it loads pandas

        result = limits.check(self._reader.read(self._last_lines(), self._options))
        streams = [stream for stream in result.streams if stream.kind == "telemetry"]
        if result.streams and not streams:
            raise InputError(
                f"the log contains {result.streams[0].kind} records",
                expected="telemetry",
                cause="another log was named as telemetry",
                path=self.path,
            )
        newest_ns = self.samples[-1].utc_ns if self.samples else None
        self.samples = []
        for stream in streams:
            times = stream.frame["time"].to_numpy().astype("datetime64[ns]").astype("int64").tolist()
            rows = stream.frame[list(_COLUMNS)].to_numpy(dtype="float64").tolist()
            self.samples += [TelemetrySample(time_ns, *row) for time_ns, row in zip(times, rows, strict=True)]
        if self.samples and self.samples[-1].utc_ns != newest_ns:
            self._delays.append((time.time_ns() - self.samples[-1].utc_ns) / 1e9)

    @property
    def delay_s(self) -> float | None:
        """The smallest recent delay from the time in a line to its arrival. Negative if the log's clock is ahead."""
        return min(self._delays, default=None)

    def at(self, utc_ns: int) -> TelemetrySample | None:
        """Return the sample nearest in time. None if the nearest sample is farther away than :data:`_MAX_AGE_S`."""
        near = min(self.samples, key=lambda sample: abs(sample.utc_ns - utc_ns), default=None)
        return None if near is None or abs(near.utc_ns - utc_ns) > _MAX_AGE_S * 1e9 else near

    def _last_lines(self) -> bytes:
        """Return the last complete lines."""
        try:
            with opened(self.path, "a telemetry log") as file:
                start = max(0, file.seek(0, os.SEEK_END) - _TAIL_BYTES)
                file.seek(start)
                data = file.read()
        except FileNotFoundError:
            return b""
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", expected="a telemetry log", path=self.path) from None
        # the first and the last line may be incomplete
        return data[data.find(b"\n") + 1 if start else 0 : data.rfind(b"\n") + 1]


def predict_along(follower: TelemetryFollower, replay_at: Callable[[TelemetrySample], Prediction]) -> Predict:
    """Return the function ``predict`` of a tap: the prediction at the pose of the followed log.

    Parameters
    ----------
    follower : TelemetryFollower
    replay_at : callable
        Prediction of the replay at a pose.
    """

    def predict(utc_ns: int) -> Prediction | None:
        follower.poll()
        if not follower.samples:
            return None
        sample = follower.at(utc_ns)
        return dataclasses.replace(
            Prediction() if sample is None else replay_at(sample),
            fix=None if sample is None else sample.fix,
            telemetry_age_s=(utc_ns - follower.samples[-1].utc_ns) / 1e9,
            telemetry_delay_s=follower.delay_s,
        )

    return predict
