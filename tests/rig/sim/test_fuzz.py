"""No input makes a simulated instrument fall over, and it still answers afterwards."""

from __future__ import annotations

import numpy as np
import pytest

SEEDS = {
    "stage": [b"/1 1 07 move abs 100:", b"/1 get pos\n", b"set maxspeed -1\r\n", b"/1 1 -- home\n", b":FF\n", b"\\"],
    "force": [bytes.fromhex(x) for x in ("AA902385", "AA948B42C8000085", "AA9181", "AA9F15", "AA92A3", "AA95", "85")],
    "displacement": [b"M1\r", b"SW,OF,1,+", b"Q0\r", b"R0\r", b"SR,HA,M,1\r", b"V9\r", b",,,\r", b"AO,1\r", b"ER"],
}
PROBE = {"stage": b"\n/1 1 42\n", "force": bytes(20) + bytes.fromhex("AA902385"), "displacement": b"\rPR\r"}


@pytest.mark.parametrize("role", SEEDS)
def test_bytes(make_host, role):
    rng = np.random.default_rng(11)
    host = make_host(role)
    for _ in range(3000):
        piece = SEEDS[role][rng.integers(len(SEEDS[role]))]
        noise = rng.integers(0, 256, rng.integers(0, 6), dtype=np.uint8).tobytes()
        cut = rng.integers(0, len(piece) + 1)
        host.ask(role, piece[:cut] + noise + piece[cut:], 0.001)
    host.wait(3.0)
    answer = b"".join(host.ask(role, PROBE[role], 0.1) for _ in range(2))
    assert answer


def test_frames(make_host):
    rng = np.random.default_rng(12)
    host = make_host("hv")
    opcodes = [0x1000, 0x1001, 0x1002, 0x1100, 0x4000, 0x4001, 0x4002, 0x4005, 0x4006, 0x4100, 0x4101, 0x6000, 0xD801]
    identifiers = [0x200, 0x201, 0x004, 0x208, 0x7FF]
    for _ in range(5000):
        body = rng.integers(0, 256, rng.integers(0, 7), dtype=np.uint8).tobytes()
        head = int(opcodes[rng.integers(len(opcodes))]).to_bytes(2, "big")
        data = (head + body)[: rng.integers(0, 9)]
        host.bench.wire("hv").host_write((identifiers[rng.integers(len(identifiers))], data), host.t)
        host.wait(0.005)
        voltage = host.bench.world.output.at(host.t)[0]
        assert 0 <= voltage <= 6000 * (1 + 1e-6)
    host.wait(1.0)
    assert host.can("201#1208", 0.1) == ["200#120801"]
