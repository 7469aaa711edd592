"""Frames against the manual's vectors, and emulator against driver."""

import os
import struct
import threading
from contextlib import closing

import numpy as np
import pytest
from base_ports import EmulatorPort, opener
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.protocol import (
    MOTORS_OFF,
    Command,
    ProtocolError,
    decode_reply,
    describe_status,
    encode_reply,
    read_request,
    write_frame,
)
from instant_ic.base.roboclaw import LinkError, Roboclaw
from instant_ic.sim.roboclaw_emulator import RoboclawEmulator


@pytest.mark.parametrize(
    ("command", "data", "frame"),
    [
        (Command.DUTY_ACCELERATION_BOTH, MOTORS_OFF, "80 36 00 00 00 09 ff ff 00 00 00 09 ff ff 93 b5"),
        (Command.SPEED_BOTH, struct.pack(">ii", 0, 0), "80 25 00 00 00 00 00 00 00 00 34 04"),
        (Command.SPEED_BOTH, struct.pack(">ii", 1000, -1000), "80 25 00 00 03 e8 ff ff fc 18 82 90"),
        (Command.SET_TIMEOUT, bytes((5,)), "80 0e 05 48 f0"),
    ],
)
def test_frames_are_those_of_the_manual(command: int, data: bytes, frame: str) -> None:
    assert write_frame(0x80, command, data) == bytes.fromhex(frame)


def test_replies_are_those_of_the_manual() -> None:
    battery = decode_reply(0x80, Command.READ_MAIN_BATTERY, bytes.fromhex("00 f1 c8 c4"))
    assert int.from_bytes(battery, "big") == 241  # 24.1 V
    encoders = decode_reply(0x80, Command.READ_ENCODERS, bytes.fromhex("00 00 03 e8 ff ff ff 00 b8 64"))
    assert struct.unpack(">ii", encoders) == (1000, -256)


@given(st.binary(max_size=20), st.integers(0, 255), st.integers(0x80, 0x87), st.data())
def test_any_damaged_bit_of_a_reply_is_found(data: bytes, command: int, address: int, draw: st.DataObject) -> None:
    reply = encode_reply(address, command, data)
    assert decode_reply(address, command, reply) == data
    bit = draw.draw(st.integers(0, len(reply) * 8 - 1))
    damaged = bytearray(reply)
    damaged[bit // 8] ^= 1 << bit % 8
    with pytest.raises(ProtocolError):
        decode_reply(address, command, bytes(damaged))


def test_status_bits_differ_between_old_and_new_firmware() -> None:
    assert describe_status(0x0001, 4) == (["emergency stop"], [])
    assert describe_status(0x0001, 2) == ([], ["over-current warning M1"])
    assert describe_status(0x2000 | 0x10000, 4) == (["over-current M2"], ["warning bits 0x00010000"])
    assert describe_status(0, 4) == ([], [])


def test_emulator_waits_for_a_whole_frame_and_drops_it_after_a_gap() -> None:
    emulator = RoboclawEmulator()
    frame = write_frame(0x80, Command.SPEED_BOTH, struct.pack(">ii", 100, 200))
    assert emulator.feed(frame[:5]) == b""
    emulator.advance(0.009)
    assert emulator.feed(frame[5:]) == b"\xff"
    assert emulator.target_speed_pps.tolist() == [100.0, 200.0]
    assert emulator.feed(frame[:5]) == b""
    emulator.advance(0.011)
    assert emulator.bad_packets == 1
    assert emulator.feed(read_request(0x80, Command.READ_MAIN_BATTERY)) == bytes.fromhex("00 f1 c8 c4")


def test_emulator_ramps_counts_and_stops_by_its_watchdog() -> None:
    emulator = RoboclawEmulator()
    emulator.feed(write_frame(0x80, Command.SET_TIMEOUT, bytes((5,))))
    emulator.feed(write_frame(0x80, Command.SPEED_ACCELERATION_BOTH, struct.pack(">Iii", 1000, 200, -200)))
    emulator.advance(0.1)
    np.testing.assert_allclose(emulator.speed_pps, [100.0, -100.0])
    np.testing.assert_allclose(emulator.encoder, [5.0, -5.0])  # 100 pps/s/s ramp: a t^2 / 2
    emulator.advance(0.3)
    np.testing.assert_allclose(emulator.speed_pps, [200.0, -200.0])
    emulator.advance(0.2)
    assert emulator.watchdog_fired
    np.testing.assert_allclose(emulator.speed_pps, 0.0)
    emulator.feed(read_request(0x80, Command.READ_STATUS))
    emulator.advance(0.1)
    np.testing.assert_allclose(emulator.target_speed_pps, 0.0)  # a read wakes no motor


def connected(emulator: RoboclawEmulator, damage=None, **changes) -> tuple[Roboclaw, EmulatorPort]:  # type: ignore[no-untyped-def]
    port = EmulatorPort(emulator, damage)
    roboclaw = Roboclaw(RoboclawConfig(port="memory", **changes), opener(port))
    roboclaw.connect()
    return roboclaw, port


def test_driver_reads_and_writes_what_the_emulator_holds() -> None:
    emulator = RoboclawEmulator()
    roboclaw, port = connected(emulator)
    assert emulator.timeout_s == pytest.approx(0.3)
    assert roboclaw.watchdog_s() == pytest.approx(0.3)
    assert roboclaw.version() == "USB Roboclaw 2x15a v4.2.4"
    emulator.encoder[:] = (1000.0, -256.0)
    assert roboclaw.encoders().tolist() == [1000, 2**32 - 256]
    roboclaw.drive([300.4, -700.6], 4000.0)
    assert port.written[-1] == write_frame(0x80, 40, struct.pack(">Iii", 4000, 300, -701))
    emulator.advance(0.3)
    assert emulator.speed_pps.tolist() == [300.0, -701.0]
    assert roboclaw.battery_v() == pytest.approx(24.1)
    emulator.status = 0x1
    assert roboclaw.status().faults == ["emergency stop"]
    with closing(roboclaw):
        roboclaw.drive([500.0, 500.0], 0.0)
    assert port.closed
    assert emulator.target_speed_pps.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("limit_bytes", [0, 2, 4])
def test_the_speed_error_limit_is_set_and_read_back_in_each_firmwares_form(limit_bytes: int) -> None:
    emulator = RoboclawEmulator()
    emulator.limit_bytes = limit_bytes
    roboclaw, _ = connected(emulator)
    for limit_pps, kept in ((3840.0, 3840), (1e6, 65535 if limit_bytes == 2 else 1_000_000)):
        assert roboclaw.limit_speed_error(limit_pps) is bool(limit_bytes)
        assert emulator.speed_error_limits == ([kept, kept] if limit_bytes else [0, 0])


def test_driver_repeats_damaged_replies_and_counts_them() -> None:
    emulator = RoboclawEmulator()
    damages = iter([True, True, False])

    def damage(reply: bytes) -> bytes:
        return bytes((reply[0] ^ 1,)) + reply[1:] if next(damages) else reply

    roboclaw, port = connected(emulator)
    port.damage = damage
    assert roboclaw.battery_v() == pytest.approx(24.1)
    assert (roboclaw.counters.retries, roboclaw.counters.crc_errors) == (2, 2)


def test_driver_gives_up_in_words_after_its_retries() -> None:
    emulator = RoboclawEmulator()
    roboclaw, port = connected(emulator, retries=1)
    port.damage = lambda reply: b""
    with pytest.raises(LinkError, match=r"no valid reply in 2 attempts .*0 of 4 bytes"):
        roboclaw.battery_v()
    assert roboclaw.counters.timeouts == 2
    port.unplugged = True
    with pytest.raises(LinkError, match="Input/output error"):
        roboclaw.battery_v()
    assert not roboclaw.connected


class PtyController:
    """The emulator behind a pseudo-terminal, as real serial software sees it."""

    def __init__(self) -> None:
        self.emulator = RoboclawEmulator()
        self.master, slave = os.openpty()
        import tty

        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self._end_read, self._end_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        import select

        while True:
            ready, _, _ = select.select([self.master, self._end_read], [], [], 10.0)
            if self._end_read in ready or not ready:
                return
            os.write(self.master, self.emulator.feed(os.read(self.master, 256)))

    def close(self) -> None:
        os.write(self._end_write, b"x")
        self._thread.join(5.0)
        for descriptor in (self.master, self._slave, self._end_read, self._end_write):
            os.close(descriptor)


@pytest.fixture
def pty_controller():  # type: ignore[no-untyped-def]
    controller = PtyController()
    yield controller
    controller.close()


def test_driver_over_a_real_pseudo_terminal(pty_controller: PtyController) -> None:
    with closing(Roboclaw(RoboclawConfig(port=pty_controller.path, reply_timeout_s=0.5))) as roboclaw:
        roboclaw.connect()
        roboclaw.drive([1000.0, -1000.0], 0.0)
        assert pty_controller.emulator.target_speed_pps.tolist() == [1000.0, -1000.0]
        assert roboclaw.battery_v() == pytest.approx(24.1)
        roboclaw.stop()
    assert pty_controller.emulator.target_speed_pps.tolist() == [0.0, 0.0]


def test_vendors_library_understands_the_emulator(pty_controller: PtyController) -> None:
    """The emulator judged by Basicmicro's own client, not by ours."""
    import basicmicro

    vendor = basicmicro.Basicmicro(pty_controller.path, 115200, timeout=1.0)
    assert vendor.Open()
    try:
        assert vendor.ReadMainBatteryVoltage(0x80) == (True, 241)
        pty_controller.emulator.encoder[:] = (1000.0, 2000.0)
        assert vendor.GetEncoders(0x80) == (True, 1000, 2000)
        assert vendor.SpeedAccelM1M2(0x80, 4000, 300, -700)
        assert pty_controller.emulator.target_speed_pps.tolist() == [300.0, -700.0]
        assert pty_controller.emulator.acceleration_pps2 == 4000.0
        assert vendor.SetTimeout(0x80, 0.5)
        assert pty_controller.emulator.timeout_s == pytest.approx(0.5)
        emulator = pty_controller.emulator
        emulator.power[:], emulator.currents_a[:] = (0.5, -1.0), (1.5, -0.02)
        assert vendor.ReadPWMs(0x80) == (True, 16384, -32767)
        assert vendor.ReadCurrents(0x80) == (True, 150, -2)
        assert vendor.ReadPinFunctions(0x80) == (True, 0, 0, 0, 0, 0)
        assert vendor.DutyAccelM1M2(0x80, 655359, 0, 655359, 0)
        assert not emulator.closed_loop and emulator.target_speed_pps.tolist() == [0.0, 0.0]
        emulator.limit_bytes = 2
        assert vendor.SetSpeedErrorLimit(0x80, 3840, 3840)
        assert vendor.GetSpeedErrorLimit(0x80) == (True, 3840, 3840)
    finally:
        vendor.close()
