"""Each bad input of the tap: one message, the right exit code, within the promised time."""

import contextlib
import os
import pty
import shutil
import subprocess
import sys
import time
import tty
from pathlib import Path
from types import SimpleNamespace

import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.live.modem import QUERIES
from aerpaw_cmp.live.ports import PortGoneError, Roots, SerialPort, TapSettings, find_candidates, find_port, holders
from benchmarks.simulated_modem import Faults
from tests.live.terminals import held, until
from tests.long.tap_common import run_tap


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("gps", "it is a GPS port"),
        ("diag", "it is a DIAG port"),
        ("silent", "nothing answers on the port"),
        ("rubbish", "no answer|DIAG"),
    ],
)
def test_wrong_device_within_two_probes(modem, tmp_path, kind, message):
    sim = modem(kind=kind)
    settings = TapSettings(tmp_path / "log", str(sim.port))
    assert 2 * settings.probe_timeout_s < 3.0  # the default recognises it within 3 s
    settings = TapSettings(tmp_path / "log", str(sim.port), probe_timeout_s=0.3)
    with pytest.raises(InputError, match=message) as caught:
        run_tap(settings)
    assert "expected an answer to 'AT'" in str(caught.value)
    assert caught.value.exit_code == 3
    assert not (tmp_path / "log").exists()


def test_no_port(tmp_path):
    with pytest.raises(InputError, match="is not there; expected the modem's AT port"):
        run_tap(TapSettings(tmp_path / "log", str(tmp_path / "ttyUSB9")))
    roots = Roots(tmp_path, list)
    with pytest.raises(InputError, match="no AT port of a Quectel modem"):
        run_tap(TapSettings(tmp_path / "log", roots=roots))


@pytest.mark.parametrize("content", ["a file", "a folder", "/dev/null", "/dev/zero"])
def test_not_a_serial_port(tmp_path, content):
    path = tmp_path / "port"
    if content.startswith("/"):
        path = Path(content)
    elif content == "a file":
        path.write_text("x")
    else:
        path.mkdir()
    with pytest.raises(InputError, match="cannot be opened as a serial port"):
        run_tap(TapSettings(tmp_path / "log", str(path)))


def opened_by_nobody(node):
    """Return the message for a user without permission who opens a port."""
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom aerpaw_cmp.live.ports import SerialPort\n"
        "from aerpaw_cmp.common.errors import InputError\nos.setgroups([])\nos.setuid(65534)\n"
        "try:\n SerialPort.open(Path(sys.argv[1]))\nexcept InputError as error:\n print(error); sys.exit(error.exit_code)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", code, node], env=environment, text=True, capture_output=True, check=False
    )
    assert done.returncode == 3, done.stderr
    return done.stdout


@pytest.mark.skipif(os.geteuid() != 0, reason="dropping privileges needs root")
def test_no_permission_names_the_group(modem, tmp_path):
    import grp

    sim = modem()
    sim.node.chmod(0o660)
    os.chown(sim.node, 0, grp.getgrnam("dialout").gr_gid)
    said = opened_by_nobody(sim.node)
    assert "no permission to open the port (owner root, group dialout, mode 660)" in said
    assert "usermod -aG dialout" in said
    sim.node.chmod(0o600)
    said = opened_by_nobody(sim.node)
    assert f"run 'sudo chown $USER {sim.node}'" in said
    assert "usermod" not in said


def test_the_port_vanishes_during_open(monkeypatch):
    # between open() and the terminal settings: the master is closed there, as an unplugged cable does
    master, slave = pty.openpty()
    path = Path(os.ttyname(slave))
    os.close(slave)
    from aerpaw_cmp.live import ports

    real = ports.make_raw
    monkeypatch.setattr(ports, "make_raw", lambda fd, baud: (os.close(master), real(fd, baud)))
    with pytest.raises(PortGoneError, match="is gone"):
        SerialPort.open(path)
    with pytest.raises(PortGoneError):
        SerialPort.open(path)


@contextlib.contextmanager
def line(waiting=b""):
    """A serial line: our port, opened with bytes that wait there, and the file of its other end."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.write(master, waiting)
    port = SerialPort.open(Path(os.ttyname(slave)))
    os.close(slave)
    yield port, master
    port.close()
    port.close()
    with contextlib.suppress(OSError):
        os.close(master)


def test_reading_and_writing_a_gone_port():
    with line() as (port, master):
        assert port.read() == b""
        os.write(master, b"abc")
        time.sleep(0.05)
        assert port.read() == b"abc"
        os.close(master)
        with pytest.raises(PortGoneError):
            port.read()
        with pytest.raises(PortGoneError):
            port.write(b"AT\r")


def test_a_port_that_takes_no_bytes():
    with line() as (port, _), pytest.raises(PortGoneError, match="does not accept bytes"):
        port.write(b"x" * 10_000_000, timeout_s=0.1)


def test_what_waits_in_the_queue_at_open_is_not_lost():
    with line(b"\r\nRDY\r\n") as (port, _):
        time.sleep(0.05)
        assert port.read() == b"\r\nRDY\r\n"


def test_two_taps_on_one_port(modem, child, tmp_path):
    sim = modem(faults=Faults(latency_s=0.005))
    first = child(sim.port)
    until(lambda: len(sim.journal) >= 5)
    second = child(sim.port, folder=str(tmp_path / "second"))
    _, err = second.communicate(timeout=20)
    assert second.returncode == 3
    assert f"process {first.pid}" in err
    assert "Traceback" not in err
    assert first.poll() is None
    count = len(sim.journal)
    until(lambda: len(sim.journal) >= count + 5, 10.0)


def test_two_taps_in_one_process(modem, tap, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port)
    session.wait(lambda: len(sim.journal) > 5)
    with pytest.raises(InputError, match="the port is in use"):
        run_tap(TapSettings(tmp_path / "second", str(sim.port), duration_s=3.0))
    session.end()


def modem_manager(node):
    """A process that holds a port, under the name by which the kernel shows it."""
    code = "import time\nopen('/proc/self/comm', 'w').write('ModemManager')\nprint(1, flush=True)\ntime.sleep(30)"
    process = subprocess.Popen([sys.executable, "-W", "ignore", "-c", code], stdin=node, stdout=subprocess.PIPE)
    with process.stdout as said:
        assert said.readline() == b"1\n"
    return process


def test_modem_manager_is_named_with_the_line_that_frees_the_port(modem, tmp_path):
    sim = modem()
    with held(sim.node) as node:
        process = modem_manager(node)
    try:
        until(lambda: any(h.pid == process.pid and h.name == "ModemManager" for h in holders(sim.node)), 10.0)
        with pytest.raises(InputError, match="systemctl stop ModemManager") as caught:
            run_tap(TapSettings(tmp_path / "log", str(sim.port)))
        assert "ID_MM_DEVICE_IGNORE" in str(caught.value)
        assert f"process {process.pid}" in str(caught.value)
    finally:
        process.kill()
        process.wait()


@pytest.mark.skipif(os.geteuid() != 0, reason="dropping privileges needs root")
def test_modem_manager_is_named_to_a_user_who_may_not_see_its_files(modem):
    import fcntl
    import termios

    sim = modem()
    sim.node.chmod(0o666)
    with held(sim.node) as node:
        fcntl.ioctl(node, termios.TIOCEXCL)  # as ModemManager does
        process = modem_manager(node)
        try:
            said = opened_by_nobody(sim.node)
        finally:
            process.kill()
            process.wait()
    assert "a process of another user" in said
    assert "systemctl stop ModemManager" in said


def test_ten_megabyte_line(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0, huge_line_every=20))
    session = tap(sim.port, answer_timeout_s=5.0)
    session.wait(lambda: len(sim.journal) >= 25, timeout=30)
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    huge = [r for r in records if r["kind"] == "unsolicited" and r["dropped_bytes"]]
    assert [r["dropped_bytes"] + len(r["lines"][0]) for r in huge] == [10_000_000] * len(huge)
    assert huge
    assert len(huge[0]["lines"][0]) <= 65_536
    assert tools.all_kept(sim, tmp_path / "log")


def test_rubbish_without_end_is_counted_not_kept(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    session = tap(sim.port)
    session.wait(lambda: len(sim.journal) >= 5)
    sim._write(b"junk\r\n" * 5000)
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 5)
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    logged = sum(r["kind"] == "unsolicited" and r["lines"] == ["junk"] for r in records)
    counted = sum(r["count"] for r in records if r["kind"] == "noise")
    assert logged <= 200
    assert logged + counted == 5000


def test_a_modem_of_another_make(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0, error_every=1))
    session = tap(sim.port)
    said = "the modem answers +CME ERROR: 14 to nr5g_csi: the SIM card is busy"
    session.wait(lambda: said in session.said)
    session.end()
    assert all(r["code"] == "14" for r in tools.exchanges(tmp_path / "log", "nr5g_csi"))


def test_an_output_folder_that_is_a_file(modem, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    (tmp_path / "log").write_text("x")
    with pytest.raises(InputError, match="cannot write a log here"):
        run_tap(TapSettings(tmp_path / "log", str(sim.port)))
    # and the port is free again
    assert run_tap(TapSettings(tmp_path / "log2", str(sim.port), duration_s=0.2, status_s=0.1)).exit_code == 0


def test_a_folder_with_an_earlier_log(modem, tap, tools, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0))
    (tmp_path / "log").mkdir()
    old = tmp_path / "log" / "tap_20200101T000000Z_1_0001.jsonl"
    old.write_bytes(b"old\n")
    session = tap(sim.port)
    session.wait(lambda: len(sim.journal) > 5)
    session.end()
    assert old.read_bytes() == b"old\n"
    assert len(list((tmp_path / "log").iterdir())) == 2


# finding the port, in a simulated /dev and list of ports ---------------------------------------------------------------


# Ports by their folder: they may change while a tap runs.
WIRED = {}


def wire(root, wires):
    """The ttys of one modem, as pyserial lists them: ``{number: (interface, where it leads or None)}``."""
    dev = root / "dev"
    shutil.rmtree(dev, ignore_errors=True)
    dev.mkdir(parents=True)
    ports = []
    for number, (interface, node) in wires.items():
        name = dev / f"ttyUSB{number}"
        name.touch() if node is None else name.symlink_to(node)
        ports.append(
            SimpleNamespace(device=f"/dev/ttyUSB{number}", vid=0x2C7C, pid=0x0800, location=f"1-1:1.{interface}")
        )
    WIRED[dev] = ports
    return Roots(dev, lambda: WIRED[dev])


def test_the_at_port_is_found_by_interface_not_by_number(tmp_path):
    roots = wire(tmp_path, {number: (i, None) for i, number in enumerate([7, 3, 5, 11])})
    assert [(p.path.name, p.how, p.interface, p.product) for p in find_candidates(roots)] == [
        ("ttyUSB5", "usb", "02", "2c7c:0800"),
        ("ttyUSB11", "usb", "03", "2c7c:0800"),
    ]


def test_the_by_id_name_comes_first_and_is_followed(tmp_path):
    roots = wire(tmp_path, {i: (i, None) for i in range(4)})
    by_id = tmp_path / "dev/serial/by-id"
    by_id.mkdir(parents=True)
    for interface in range(4):
        (by_id / f"usb-Quectel_RM502Q-AE-if0{interface}-port0").symlink_to(tmp_path / f"dev/ttyUSB{interface}")
    first = find_candidates(roots)[0]
    assert (first.path.name, first.device.name, first.how) == ("usb-Quectel_RM502Q-AE-if02-port0", "ttyUSB2", "by-id")
    given = find_port(tmp_path / "dev/ttyUSB2", roots)
    assert given.path == first.path


def test_the_second_at_port_is_taken_when_the_first_is_held(modem, tap, tmp_path):
    sim = modem(faults=Faults(latency_s=0.0), link=tmp_path / "dev/serial/by-id/usb-Quectel_X-if03-port0")
    other = modem(link=tmp_path / "dev/serial/by-id/usb-Quectel_X-if02-port0")
    with held(other.node) as node:
        process = subprocess.Popen(["sleep", "60"], stdin=node)
    try:
        session = tap(None, roots=Roots(tmp_path / "dev", list))
        command = QUERIES["nr5g_csi"].text
        # wait for answers and not for a time: on a busy machine the search for holders of the port takes seconds
        session.wait(lambda: sum(served.command == command for served in sim.journal) > 3)
        assert session.end().answers["nr5g_csi"]["ok"] >= 3
    finally:
        process.kill()
        process.wait()


def test_numbers_that_swap_are_followed_by_the_interface(modem, tap, tools, tmp_path):
    # without by-id names: ttyUSB2 was the AT port and comes back as the GPS port, the AT port as ttyUSB5
    sim = modem(link=None, faults=Faults(latency_s=0.0))
    gps = modem(link=None, kind="gps")
    roots = wire(tmp_path, {1: (1, gps.node), 2: (2, sim.node)})
    session = tap(roots.dev / "ttyUSB2", roots=roots, reconnect_min_s=0.02, reconnect_max_s=0.05)
    session.wait(lambda: len(sim.journal) > 20)
    sim.unplug()
    gps.unplug()
    gps.replug()
    sim.replug()
    wire(tmp_path, {2: (1, gps.node), 5: (2, sim.node)})
    count = len(sim.journal)
    session.wait(lambda: len(sim.journal) > count + 20)
    session.end()
    records, _ = tools.records_of(tmp_path / "log")
    (closed,) = [r for r in records if r["kind"] == "gap" and r["state"] == "closed"]
    assert closed["port"]["path"] == str(roots.dev / "ttyUSB5")
    assert not [h for r in records for h in r.get("lines", []) if isinstance(h, str) and h.startswith("$GP")]


@pytest.mark.parametrize("command", ["tap", "modem-sim"])
@pytest.mark.parametrize("module", ["fcntl", "termios"])
def test_a_system_without_fcntl_is_told_what_is_supported(command, module):
    code = (
        "import sys\n"
        f"sys.modules[{module!r}] = None\n"
        "from aerpaw_cmp.__main__ import main\n"
        f"sys.exit(main([{command!r}]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert f"'{command}' needs Python's {module}, which this system does not have; expected Linux" in done.stderr
    assert "Traceback" not in done.stderr
