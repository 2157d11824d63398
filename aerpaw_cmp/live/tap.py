"""The tap: it polls the modem, records every answer, and survives field conditions.

There is one polling thread and one command in flight. A record is in the kernel before the next command is sent, unless
the disk stalls (:class:`~aerpaw_cmp.live.log.TapLog`). The port may vanish and come back under another number, the disk
may fill, the clock may step, signals may come. Each of these events is recorded, and the polling continues.
"""

from __future__ import annotations

import contextlib
import re
import select
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..common.errors import InputError
from ..common.versions import tool_version
from ..logs.files import SCHEMA, Record
from . import modem, ports
from .log import Clock, TapLog, boot_id, clock_synchronised
from .predict import Predict, PredictionWorker, Query

# A jump of the wall clock relative to the monotonic clock is recorded if it exceeds this.
_CLOCK_STEP_NS = 50_000_000
# The two clocks are not compared if more than this passed between reading them, because the process was paused.
_PAUSE_NS = 5_000_000
# A function that receives each logged record and each status in the polling thread. It must neither wait nor raise.
Watch = Callable[["Record | ports.TapStatus"], None]

RATE_WINDOW_S = 10.0
# Settings that the header of the log contains.
_IN_HEADER = ("ri_hz", "other_hz", "pause_s", "answer_timeout_s", "enable_csi")
_NOISE_LINES_PER_S = 50
# Causes of +CME ERROR codes (3GPP TS 27.007, clause 9.2) that a healthy RM5xxQ may send.
_CME_CAUSES = {
    "10": "no SIM card is inserted",
    "11": "the SIM card asks for its PIN",
    "12": "the SIM card asks for its PUK",
    "13": "the SIM card failed",
    "14": "the SIM card is busy",
    "15": "this is the wrong SIM card",
    "30": "there is no network service",
}


_NMEA = re.compile(rb"\$[A-Z]{4,5},[^\r\n]*\*[0-9A-F]{2}")


def _not_a_modem(path: Path, received: bytes) -> InputError:
    """Return the error for a port that does not answer ``AT``. The likely cause depends on the received bytes."""
    expected = "an answer to 'AT' (interface 02 or 03 of the modem)"
    if _NMEA.search(received):
        sign, cause = "the port speaks NMEA: it is a GPS port", "interface 01 was given, or the port numbers changed"
    elif received.count(0x7E) >= 1 and sum(b < 9 or b > 126 for b in received) > len(received) // 10:
        sign, cause = (
            "the port speaks HDLC frames: it is a DIAG port",
            "interface 00 was given, or the port numbers changed",
        )
    elif received:
        excerpt = ascii(modem.Redactor().clean(received[:40].decode("latin-1"), cut=True))
        sign, cause = f"the port sends {excerpt} but no answer", "another device, or another baud rate than 115200"
    else:
        sign, cause = "nothing answers on the port", "the modem is off or still starting, or this is not its AT port"
    return InputError(sign, expected=expected, cause=cause, path=path)


class Tap:
    """One session of the tap, which polls the modem until ``stop`` or the set time ends it.

    Parameters
    ----------
    settings : TapSettings
    stop : Stop
        Ends the session when called (from any thread, or by a signal).
    on_status : callable, optional
        Called about once per ``settings.status_s``, and immediately with a message. :func:`format_status` formats the
        status as a line.
    watch : callable, optional
        Receives each logged record and each status. It must neither wait nor raise.
    predict : callable, optional
        ``predict(utc_ns)`` returns the Prediction for the pose at that time, or None. The function runs in a separate
        thread.
    clock : Clock, optional
    """

    def __init__(
        self,
        settings: ports.TapSettings,
        stop: ports.Stop,
        *,
        on_status: Callable[[ports.TapStatus], None] | None = None,
        watch: Watch | None = None,
        predict: Predict | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._settings = settings
        self._watch = watch
        self._notifier = None if on_status is None else ports.StatusNotifier(on_status)
        self._stop = stop
        self._clock = clock or Clock()
        self._worker = None if predict is None else PredictionWorker(predict)
        self._session = uuid.uuid4().hex
        self._framer = modem.Framer()
        self._redactor = modem.Redactor()
        self._log = TapLog(settings.folder, self._header, settings.log, self._clock)
        periods = {modem.RI_QUERY: int(1e9 / settings.ri_hz)}
        if settings.other_hz > 0:
            periods |= {name: int(1e9 / settings.other_hz) for name in modem.OTHER_QUERIES}
        self._schedule = ports.Schedule(periods)
        self._port: ports.SerialPort | None = None
        self._info: ports.PortInfo | None = None
        self._first_bytes: bytearray | None = None
        # records that precede the opening of the log; None once it is open
        self._early: list[Record] | None = []
        self._received = 0
        self._in_step = True
        self._initialise_again = False
        self._csi_before: tuple[int, int] | None = None
        self._csi_changed = False
        self._answers: dict[str, Counter[str]] = {}
        self._ri_times: deque[int] = deque()
        self._last: dict[str, Any] = dict.fromkeys(("rank", "rsrp_dbm", "sinr_db", "predicted_rank"))
        self._gap_open: tuple[int, int, str] | None = None
        self._gaps, self._gap_ns, self._alarms, self._alarm = 0, 0, 0, False
        self._noise = Counter[str]()
        self._said: set[str] = set()
        now = self._clock.mono_ns()
        self._level_ns = 0
        self._start_ns = self._last_final_ns = self._last_csi_ns = self._status_ns = self._rest_until_ns = now
        self._noise_ns = now
        self._offset_ns: int | None = None

    # the session ------------------------------------------------------------------------------------------

    def run(self) -> ports.TapSummary:
        """Connect, poll until a stop is requested, and end cleanly.

        Returns
        -------
        TapSummary

        Raises
        ------
        InputError
            If the port cannot be used or the folder cannot be written to, at the start.
        """
        try:
            try:
                self._connect()
            except ports.PortGoneError as error:
                raise InputError(
                    str(error),
                    expected="the modem's AT port, e.g. /dev/serial/by-id/usb-Quectel*-if02-port0",
                    cause="the modem is not plugged in or is still starting; see 'aerpaw-cmp doctor'",
                ) from None
            if not self._stop.count:
                self._log.open()
                if self._watch is not None:
                    self._watch(self._header())
                early, self._early = self._early or [], None
                for record in early:
                    self._append(record)
                if clock_synchronised() is False:
                    self._say("the clock is not synchronised (NTP or GPS): times may not fit the telemetry")
                if ports.modem_manager() and self._info is not None and self._info.how != "given":
                    self._say("ModemManager runs and may take the port when the modem comes back; see docs/tap.md")
                self._poll_until_stopped()
        finally:
            summary = self._finish()
        return summary

    def _poll_until_stopped(self) -> None:
        while not self._stop.count:
            try:
                if self._port is None:
                    self._reconnect()
                else:
                    self._initialise()
                    self._schedule.reset(self._clock.mono_ns())
                while not self._stop.count:
                    self._poll_once()
            except ports.PortGoneError as gone:
                self._lost(str(gone))

    def _poll_once(self) -> None:
        now = self._clock.mono_ns()
        if now - self._last_final_ns > self._settings.silent_s * 1e9:
            raise ports.PortGoneError(f"the modem has not answered for {self._settings.silent_s:g} s")
        if not self._in_step:
            self._probe()
            return
        if self._initialise_again:
            self._initialise()
        name, due = self._schedule.next(now)
        start = max(due, self._rest_until_ns)
        if start > now:
            self._wait((start - now) / 1e9)
            return
        self._schedule.started(name, now)
        if self._exchange(name)["decoded"].get("rank") is not None and name == modem.RI_QUERY:
            self._last_csi_ns = self._clock.mono_ns()
            self._alarm = False

    def _finish(self) -> ports.TapSummary:
        restored = self._restore_csi()
        self._close_port()
        if self._gap_open is not None:
            self._close_gap("the session ended during the gap")
        if self._worker is not None:
            self._worker.close()
            self._log_predictions()
        self._flush_noise()
        self._leave_framer()
        duration_s = (self._clock.mono_ns() - self._start_ns) / 1e9
        said: dict[str, Any] = {
            "reason": self._stop.reason or "error",
            "answers": {name: dict(counts) for name, counts in self._answers.items()},
            "rates_hz": {n: round(counts["ok"] / max(duration_s, 1e-9), 4) for n, counts in self._answers.items()},
            "missed": dict(self._schedule.missed),
            "gaps": self._gaps,
            "gap_s": self._gap_ns / 1e9,
            "duration_s": duration_s,
            "redacted": self._redactor.count,
        }
        if self._early is None:
            received = {"received_bytes": self._received, "csi_restored": restored}
            self._append({"kind": "end", **said, **received, **self._now()})
            self._log.close()
            for text in self._log.messages():
                self._say(text)
        if self._notifier is not None:
            self._notifier.close()
        return ports.TapSummary(
            **said,
            exit_code=1 if self._log.lost else 0,
            segments=tuple(self._log.paths),
            records=self._log.records,
            lost_records=self._log.lost,
            alarms=self._alarms,
        )

    def _restore_csi(self) -> bool | None:
        """Restore the former state of CSI reporting. None if the state was not changed."""
        if not self._csi_changed:
            return None
        if self._port is not None and self._csi_before is not None and self._stop.count < 2:
            with contextlib.suppress(ports.PortGoneError):
                if self._exchange("csi_ctrl", modem.csi_write(*self._csi_before))["status"] == "ok":
                    return True
        self._say("CSI reporting stays on: the command to restore it did not reach the modem or failed")
        return False

    # the port ---------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        """Open and probe the first port that answers."""
        first_error: ports.PortGoneError | InputError | None = None
        for info in self._ports_to_try():
            try:
                self._open_and_probe(info)
                return
            except (ports.PortGoneError, InputError) as error:
                self._close_port()
                first_error = first_error or error
        assert first_error is not None
        raise first_error

    def _ports_to_try(self) -> list[ports.PortInfo]:
        """Return the ports to try: first the named port or all AT ports, later ports of the same interface first."""
        roots, last = self._settings.roots, self._info
        if last is None:
            if self._settings.port is not None:
                return [ports.find_port(Path(self._settings.port), roots)]
            if candidates := ports.find_candidates(roots):
                return candidates
            raise ports.PortGoneError("no AT port of a Quectel modem (USB 2c7c, interface 02 or 03) is there")
        found = []
        with contextlib.suppress(ports.PortGoneError):
            now = ports.find_port(last.path, roots)
            if now.interface == last.interface:  # otherwise it is another port of the modem
                found.append(now)
        if last.product is not None:
            known = {port.device for port in found}
            others = [p for p in ports.find_candidates(roots) if p.product == last.product and p.device not in known]
            found += sorted(others, key=lambda port: port.interface != last.interface)
        if not found:
            raise ports.PortGoneError(f"{last.path} is not there")
        return found

    def _open_and_probe(self, info: ports.PortInfo) -> None:
        self._leave_framer()
        self._framer = modem.Framer()
        self._port = ports.SerialPort.open(info.path)
        self._first_bytes = bytearray()
        try:
            # probe again only if the first probe gets no answer
            if not any(self._probe() for _ in range(2)):
                raise _not_a_modem(info.path, bytes(self._first_bytes))
        finally:
            self._first_bytes = None
        self._info = info
        self._last_final_ns = self._last_csi_ns = self._clock.mono_ns()

    def _probe(self) -> bool:
        """Send a bare ``AT``. An answer shows that no answer to an earlier command is pending."""
        if self._exchange("sync", timeout_s=self._settings.probe_timeout_s)["status"] in ("timeout", "lost"):
            return False
        self._in_step = True
        for event in self._framer.settle():
            self._other(event)
        return True

    def _close_port(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _leave_framer(self) -> None:
        """Record lines and a partial line that do not belong to an answer, before the framer is replaced."""
        lines, partial = self._left()
        if lines or partial:
            self._event("unsolicited", lines=lines, partial=partial, dropped_bytes=0)

    def _left(self) -> tuple[list[str], str]:
        lines, partial = self._framer.leave()
        return [self._redactor.clean(line) for line in lines], self._redactor.clean(partial, cut=True)

    def _lost(self, reason: str) -> None:
        with contextlib.suppress(ports.PortGoneError):
            self._drain()  # read what is still in the port before it is closed
        self._close_port()
        if self._gap_open is not None:
            return
        lines, partial = self._left()
        self._gaps += 1
        self._gap_open = (self._clock.utc_ns(), self._clock.mono_ns(), reason)
        received = {"lines": lines, "partial": partial, "received_bytes": self._received}
        self._event("gap", state="open", reason=self._redactor.clean(reason), **received)
        self._log.sync()
        self._say(f"lost: {reason}; looking for it")

    def _reconnect(self) -> None:
        """Look for the port with back-off until it answers, then set the modem up again."""
        pause, last_message = self._settings.reconnect_min_s, ""
        while not self._stop.count:
            self._wait(pause)
            pause = min(2 * pause, self._settings.reconnect_max_s)
            try:
                self._connect()
                break
            except (ports.PortGoneError, InputError) as error:
                if isinstance(error, InputError) and str(error) != last_message:
                    last_message = str(error)
                    self._say(last_message)
        if self._port is None:
            return
        self._initialise()
        self._close_gap(f"the port is back as {self._info.device if self._info else '?'}")
        self._schedule.reset(self._clock.mono_ns())

    def _close_gap(self, text: str) -> None:
        if self._gap_open is None:
            return
        (from_utc, from_mono, reason), self._gap_open = self._gap_open, None
        to_utc, duration_ns = self._clock.utc_ns(), self._clock.mono_ns() - from_mono
        self._gap_ns += duration_ns
        self._event(
            "gap",
            state="closed",
            reason=self._redactor.clean(reason),
            from_utc_ns=from_utc,
            to_utc_ns=to_utc,
            duration_ns=duration_ns,
            missed=self._schedule.slots(duration_ns),
            port=self._port_record(),
        )
        self._log.sync()
        self._say(text)

    # the modem --------------------------------------------------------------------------------------------

    def _initialise(self) -> None:
        """Query identity and CSI switch, at the start and whenever the modem comes back."""
        self._initialise_again = False
        self._exchange("identity")
        self._exchange("firmware")
        decoded = self._exchange("csi_ctrl")["decoded"]
        state = decoded.get("lte"), decoded.get("nr5g")
        if self._settings.enable_csi and state != (1, 1):
            # keep the state from the first connection, because the modem may lose it when it is plugged in again
            if None not in state and self._csi_before is None:
                self._csi_before = (int(state[0] or 0), int(state[1] or 0))
            self._csi_changed = self._exchange("csi_ctrl", modem.csi_write(1, 1))["status"] == "ok"
            if not self._csi_changed:
                self._say("the modem refused to switch CSI reporting on")
            elif self._csi_before is None:
                self._say("CSI reporting was switched on; its old state is unknown and will not be restored")
        elif state[1] == 0:
            self._say("CSI reporting is off, so no rank will be reported: run with --enable-csi")

    # one exchange -----------------------------------------------------------------------------------------

    def _exchange(self, name: str, command: str | None = None, *, timeout_s: float | None = None) -> Record:
        """Send one command and wait for its end. Return its record, which has been passed to the log.

        Raises
        ------
        PortGoneError
            If the port disappears. The received bytes are recorded first.
        """
        assert self._port is not None
        query = modem.QUERIES[name]
        text = command or query.text
        data = modem.encode(text, allow_csi=self._settings.enable_csi)
        # read unsolicited lines first: they must not be taken for a part of the answer
        self._drain()
        sent_utc, sent = self._clock.utc_ns(), self._clock.mono_ns()
        timeout_ns = int((timeout_s or self._settings.answer_timeout_s) * 1e9)
        self._framer.send(text, query.prefixes if command is None else ())
        loss: ports.PortGoneError | None = None
        try:
            self._port.write(data)
            answer, last = self._await(sent + timeout_ns)
        except ports.PortGoneError as error:
            loss, answer, last = error, self._framer.give_up("lost"), self._clock.mono_ns()
        record = self._record_exchange(name, command is None, answer, sent_utc, sent, last)
        if loss is not None:
            raise loss
        return record

    def _await(self, deadline: int) -> tuple[modem.Answer, int]:
        """Return the answer to the command in flight, and the monotonic time of its last byte."""
        stopped_at = 0
        while True:
            now = self._clock.mono_ns()
            if self._stop.count and not stopped_at:
                stopped_at = now
                # wait one second for the pending answer, so that its record is complete. A second stop request ends
                # this wait.
                deadline = min(deadline, now + 1_000_000_000)
            if now >= deadline or self._stop.count > 1:
                # the answer may still arrive: send no other query until a bare AT is answered
                self._in_step = False
                return self._framer.give_up(), now
            if self._select((deadline - now) / 1e9):
                last = self._clock.mono_ns()
                answer = self._read()
                if answer is not None:
                    self._last_final_ns = last
                    return answer, last
            self._tick()

    def _read(self) -> modem.Answer | None:
        """Read the available bytes. Record everything except the answer in flight."""
        assert self._port is not None
        data = self._port.read()
        self._received += len(data)
        if self._first_bytes is not None:
            # keep enough bytes to distinguish NMEA from DIAG, but not everything that a wrong port sends
            self._first_bytes += data[: 4096 - len(self._first_bytes)]
        answer = None
        for event in self._framer.feed(data):
            if isinstance(event, modem.Answer):
                answer = event
            else:
                self._other(event)
        return answer

    def _drain(self) -> None:
        """Read bytes that arrived without a command in flight, because they do not belong to the next answer."""
        while self._select(0.0) and self._port is not None:
            self._read()

    def _record_exchange(
        self, name: str, query: bool, answer: modem.Answer, sent_utc: int, sent: int, last: int
    ) -> Record:
        lines = [self._redactor.clean(line) for line in answer.lines]
        decoded = modem.decode(name, lines) if query and lines else modem.Decoded()
        pause = int(self._settings.pause_s * 1e9)
        self._rest_until_ns = last + pause
        record: Record = {
            "kind": "exchange",
            "query": name,
            "command": answer.command,
            "sent_utc_ns": sent_utc,
            "sent_mono_ns": sent,
            "last_utc_ns": sent_utc + last - sent,  # a clock step within an exchange has its own record
            "last_mono_ns": last,
            "status": answer.status,
            "lines": lines,
            "decoded": decoded.values,
            "flags": [*answer.flags, *decoded.flags],
        }
        if answer.code is not None:
            record["code"] = self._redactor.clean(answer.code)
        if answer.partial:
            record["partial"] = self._redactor.clean(answer.partial, cut=True)
        self._record(record)
        self._answers.setdefault(name, Counter())[answer.status] += 1
        self._note(record)
        return record

    def _note(self, record: Record) -> None:
        """Store the values of the status line, and request a prediction."""
        name, status, decoded = record["query"], record["status"], record["decoded"]
        if name == modem.RI_QUERY:
            self._last["rank"] = decoded.get("rank")
            if record["sent_mono_ns"] - self._level_ns > ports.stale_after_s(1 / self._settings.ri_hz) * 1e9:
                self._last["rsrp_dbm"] = self._last["sinr_db"] = None
            if status == "ok":
                self._ri_times.append(record["last_mono_ns"])
                if self._worker is not None:
                    # use the pose at the middle of the exchange, because it is unknown when the modem determined the
                    # rank
                    middle = (record["sent_utc_ns"] + record["last_utc_ns"]) // 2
                    self._worker.ask(Query(middle, record["sent_utc_ns"], decoded.get("rank"), self._last["rsrp_dbm"]))
            elif status in ("error", "cme"):
                code = record.get("code", "")
                said = f"+CME ERROR: {code}" if status == "cme" else "ERROR"
                self._say_once(f"the modem answers {said} to {name}: {_CME_CAUSES.get(code, 'is it an RM5xxQ?')}")
        elif name == "servingcell":
            nr = decoded.get("nr") or {}
            self._last["rsrp_dbm"], self._last["sinr_db"] = nr.get("rsrp_dbm"), nr.get("sinr_db")
            self._level_ns = record["last_mono_ns"]

    def _other(self, event: modem.Event) -> None:
        """Record a line or an answer that does not belong to the command in flight."""
        if isinstance(event, modem.Late):
            lines = [self._redactor.clean(line) for line in event.lines]
            self._event("late", lines=lines, status=event.status, code=event.code)
        elif isinstance(event, modem.Unsolicited):
            self._noise["lines"] += 1
            # above this rate, log only lines of kinds that a modem sends: a wrong port could fill the disk
            if self._noise["lines"] > _NOISE_LINES_PER_S and not modem.is_unsolicited(event.text):
                self._noise["bytes"] += len(event.text) + event.dropped
                self._noise["not_kept"] += 1
                return
            text = self._redactor.clean(event.text, cut=event.dropped > 0)
            self._event("unsolicited", lines=[text], dropped_bytes=event.dropped)
            # the modem restarted behind the same port, so its CSI switch has the state after power-on
            if event.text in ("RDY", "APP RDY"):
                self._initialise_again = True

    # waiting ----------------------------------------------------------------------------------------------

    def _select(self, timeout_s: float) -> bool:
        """Check whether the port has bytes, waiting at most ``timeout_s``. A stop request ends the wait."""
        poller = select.poll()
        if not self._stop.count:
            poller.register(self._stop.fileno(), select.POLLIN)
        if self._port is not None:
            poller.register(self._port.fileno(), select.POLLIN)
        # return in time for the periodic tasks
        ready = poller.poll(max(0.0, min(timeout_s, self._settings.status_s)) * 1e3)
        return any(fd != self._stop.fileno() for fd, _ in ready)

    def _wait(self, duration_s: float) -> None:
        """Wait. Record unsolicited lines of the modem that arrive in this time."""
        deadline = self._clock.mono_ns() + int(duration_s * 1e9)
        while not self._stop.count:
            remaining_ns = deadline - self._clock.mono_ns()
            if remaining_ns <= 0:
                return
            if self._select(remaining_ns / 1e9):
                self._read()
            self._tick()

    def _tick(self) -> None:
        """Do the periodic tasks: clock, disk, alarm, status, end of the set time."""
        now = self._clock.mono_ns()
        if self._early is None:
            for text in self._log.messages():
                self._say(text)
            self._log_predictions()
        self._check_clock()
        if now - self._noise_ns > 1_000_000_000:
            self._noise_ns = now
            self._flush_noise()
        if now - self._status_ns >= self._settings.status_s * 1e9:
            self._status_ns = now
            self._check_alarm(now)
            self._show("")
        duration_s = self._settings.duration_s
        if duration_s is not None and now - self._start_ns > duration_s * 1e9 and not self._stop.count:
            self._stop("duration")

    def _check_clock(self) -> None:
        before, utc, after = self._clock.mono_ns(), self._clock.utc_ns(), self._clock.mono_ns()
        if after - before > _PAUSE_NS:
            return
        step, self._offset_ns = utc - before - (self._offset_ns or utc - before), utc - before
        if abs(step) > _CLOCK_STEP_NS:
            self._event("clock", step_ns=step)

    def _check_alarm(self, now: int) -> None:
        limit = self._settings.no_csi_alarm_s
        if limit is None or now - self._last_csi_ns <= limit * 1e9:
            return
        if not self._alarm:
            self._alarm = True
            self._alarms += 1
            self._event("alarm", reason=f"no CSI for {limit:g} s")
            self._say(f"no CSI for {limit:g} s: is data flowing, and CSI reporting on (--enable-csi)?")

    def _flush_noise(self) -> None:
        if self._noise["not_kept"]:
            self._event("noise", count=self._noise["not_kept"], bytes=self._noise["bytes"])
        self._noise.clear()

    def _log_predictions(self) -> None:
        if self._worker is None:
            return
        for result in self._worker.results():
            self._last["predicted_rank"] = result.get("predicted")
            if result.get("error"):
                self._say_once(f"the prediction failed: {result['error']}")
            self._record({"kind": "prediction", **result})

    # messages ---------------------------------------------------------------------------------------------

    def _say_once(self, text: str) -> None:
        # limit the number, because messages of other programs may differ every time
        if text not in self._said and len(self._said) < 100:
            self._said.add(text)
            self._say(text)

    def _say(self, text: str) -> None:
        self._show(self._redactor.clean(text))

    def _show(self, message: str) -> None:
        if self._notifier is None and self._watch is None:
            return
        now = self._clock.mono_ns()
        while self._ri_times and now - self._ri_times[0] > RATE_WINDOW_S * 1e9:
            self._ri_times.popleft()
        window_s = min(RATE_WINDOW_S, max(1.0, (now - self._start_ns) / 1e9))
        status = ports.TapStatus(
            connected=self._port is not None,
            **self._last,
            ri_rate_hz=len(self._ri_times) / window_s,
            gaps=self._gaps,
            records=self._log.records,
            bytes_written=self._log.bytes_written,
            disk_free_bytes=self._log.free_bytes,
            disk_fault=self._log.fault,
            missed=sum(self._schedule.missed.values()),
            predicts=self._worker is not None,
            alarm=self._alarm,
            message=message,
        )
        if self._notifier is not None:
            self._notifier.notify(status)
        if self._watch is not None:
            self._watch(status)

    def _event(self, kind: str, **fields: Any) -> None:
        """Record an event with the present time."""
        self._record({"kind": kind, **fields, **self._now()})

    def _record(self, record: Record) -> None:
        if self._early is None:
            self._append(record)
        # limit the number: a port that sends without end must not fill the memory
        elif len(self._early) < 10_000:
            self._early.append(record)

    def _append(self, record: Record) -> None:
        self._log.append(record)
        if self._watch is not None:
            self._watch(record)

    def _now(self) -> Record:
        return {"utc_ns": self._clock.utc_ns(), "mono_ns": self._clock.mono_ns()}

    def _port_record(self) -> Record:
        if self._info is None:
            return {}
        return asdict(self._info) | {
            "path": self._redactor.clean(str(self._info.path)),
            "device": str(self._info.device),
        }

    def _header(self) -> Record:
        settings = self._settings
        return {
            "kind": "header",
            "schema": SCHEMA,
            "session": self._session,
            "tool": f"aerpaw-cmp {tool_version()}",
            "boot_id": boot_id(),
            "clock_synchronised": clock_synchronised(),
            "ri_base": "one",
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(self._clock.utc_ns() / 1e9)),
            "port": self._port_record(),
            "settings": {
                **{name: getattr(settings, name) for name in _IN_HEADER},
                "queries": list(modem.OTHER_QUERIES),
                "sync_interval_s": settings.log.sync_interval_s,
            },
            **self._now(),
        }
