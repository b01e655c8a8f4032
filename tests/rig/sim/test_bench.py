"""The bench as a whole: one seed gives one stream of bytes, however it is polled."""

from __future__ import annotations

import random

import pytest

COMMANDS = [
    (0.031, "stage", b"/1 1 01 home\n"),
    (0.04, "force", bytes.fromhex("AA9023 85")),
    (0.06, "force", bytes.fromhex("AA948B43FA0000 85")),  # 500 Hz
    (0.08, "force", bytes.fromhex("AA9024 85")),
    (0.1, "hv", (0x200, bytes.fromhex("D801"))),
    (0.2, "hv", (0x200, bytes.fromhex("41000044BB8000"))),
    (0.3, "hv", (0x200, bytes.fromhex("1100 41A00000"))),
    (1.8, "stage", b"/1 1 02 move abs 95000\n"),
    (2.0, "hv", (0x200, bytes.fromhex("4001000008"))),
    (3.3333, "stage", b"/1 1 03 move abs 88000\n"),
    (4.0, "displacement", b"M1\r"),
    (5.1, "hv", (0x201, bytes.fromhex("410200"))),
    (5.2, "stage", b"/1 1 04 get pos\n"),
    (5.5, "displacement", b"M0\r"),
]
ROLES = ("stage", "force", "displacement", "hv")
SETTINGS = {
    "force": {"clock_drift_ppm": 37.0},
    "film": {"maxwell": [{"modulus_ratio": 0.2, "time_s": 0.7}]},
    "fault": [
        {"role": "force", "kind": "corrupt", "at_s": 1.0, "duration_s": 2.0, "probability": 0.05},
        {"role": "force", "kind": "drop", "at_s": 2.0, "duration_s": 1.0, "probability": 0.1},
        {"role": "displacement", "kind": "alert", "at_s": 3.0, "duration_s": 1.0},
    ],
}


def streams(make_host, times: list[float], seed: int = 7) -> dict[str, list]:
    """Everything each instrument sent when the bench is asked at ``times``, the commands sent at theirs."""
    bench = make_host(*ROLES, **SETTINGS, seed=seed).bench
    out: dict[str, list] = {role: [] for role in ROLES}
    pending = list(COMMANDS)
    for t in sorted({*times, *(c[0] for c in COMMANDS), 6.0}):
        bench.advance(t)
        while pending and pending[0][0] == t:
            _, role, message = pending.pop(0)
            bench.wire(role).host_write(message, t)
        for role in ROLES:
            out[role] += bench.wire(role).host_read(t)
    return out


def test_the_same_bytes_whatever_the_polling(make_host):
    chance = random.Random(3)
    reference = streams(make_host, [k * 0.01 for k in range(600)])
    assert len(reference["force"]) > 5 * 500 * 36
    for times in (
        [k * 0.001 for k in range(6000)],
        [k * 0.25 for k in range(24)],
        sorted(chance.uniform(0, 6) for _ in range(700)),
    ):
        assert streams(make_host, times) == reference


def test_another_seed_is_another_noise(make_host):
    times = [k * 0.1 for k in range(60)]
    one, two = streams(make_host, times, seed=7), streams(make_host, times, seed=8)
    assert one["force"] != two["force"]
    assert one["stage"] == two["stage"]


def test_noise_of_one_instrument_does_not_depend_on_the_others(make_host):
    alone = make_host("force").ask("force", b"", 1.0)
    assert make_host("force", "displacement", "hv", "stage").ask("force", b"", 1.0) == alone


def test_only_what_is_named_exists(make_host):
    bench = make_host("stage", "force").bench
    assert set(bench.instruments) == {"stage", "force"}
    with pytest.raises(KeyError):
        bench.wire("hv")


def test_next_time_is_never_late(make_host):
    """Polling only when the bench says so misses nothing."""
    bench = make_host("force", "stage").bench
    bench.wire("stage").host_write(b"/1 1 01 home\n", 0.0)
    seen, t = b"", 0.0
    while t < 2.0:
        t = max(bench.next_time(), t + 1e-9)
        bench.advance(t)
        seen += bench.wire("stage").host_read(t)
        bench.wire("force").host_read(t)
    assert seen == b"@01 1 01 OK BUSY WR 0\r\n"
