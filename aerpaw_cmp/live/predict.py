"""The rank that the replay predicts now, computed beside the polling.

The tap passes a time and gets records back; how a time becomes a pose and a pose a rank is the caller's:
:class:`TelemetryFollower` gives the pose from a telemetry log that still grows.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

Predict = Callable[[int], "int | None"]
"""``predict(utc_ns) -> rank``; None: no pose for that time, or out of coverage."""


class PredictionWorker:
    """Runs ``predict`` in one thread; while it is busy, further requests are let go and counted.

    Parameters
    ----------
    predict : callable
    """

    def __init__(self, predict: Predict) -> None:
        self._predict = predict
        self._wanted: queue.Queue[tuple[int, int, int | None] | None] = queue.Queue(maxsize=1)
        self._done: deque[dict[str, Any]] = deque(maxlen=1000)
        self.skipped = 0
        self._thread = threading.Thread(target=self._run, name="tap-prediction", daemon=True)
        self._thread.start()

    def ask(self, utc_ns: int, sent_utc_ns: int, measured: int | None) -> None:
        """Want the prediction for the answer to the command sent then."""
        try:
            self._wanted.put_nowait((utc_ns, sent_utc_ns, measured))
        except queue.Full:
            self.skipped += 1

    def results(self) -> list[dict[str, Any]]:
        """Finished predictions, each with measured rank and residual (measured - predicted)."""
        done = []
        while self._done:
            done.append(self._done.popleft())
        return done

    def close(self) -> None:
        """Finish what is asked for, at most 2 s long."""
        try:
            self._wanted.put(None, timeout=2.0)
        except queue.Full:
            return
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while (item := self._wanted.get()) is not None:
            utc_ns, sent_utc_ns, measured = item
            result: dict[str, Any] = {
                "for_sent_utc_ns": sent_utc_ns,
                "at_utc_ns": utc_ns,
                "measured": measured,
                "predicted": None,
            }
            try:
                predicted = self._predict(utc_ns)
                result["predicted"] = None if predicted is None else int(predicted)
            except Exception as error:  # a fault of the replay must not end the log
                result["error"] = f"{type(error).__name__}: {error}"[:300]
            if measured is not None and result["predicted"] is not None:
                result["residual"] = measured - result["predicted"]
            self._done.append(result)
