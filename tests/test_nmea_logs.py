"""NMEA logs as people have them: dates, prefixes, garbage, qualities, several receivers."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from rigwake.errors import InputError
from rigwake.readers.gnss_fixes import UNKNOWN_UP_VARIANCE, gnss_stream_of_fixes
from rigwake.readers.nmea import read_nmea
from rigwake.readers.open import open_recording
from rigwake.recording import GnssStream

PERIOD_S = 0.2


def sentence(body: str) -> str:
    value = 0
    for character in body:
        value ^= ord(character)
    return f"${body}*{value:02X}\r\n"


def gga(
    at_s: float,
    k: int,
    talker: str = "GN",
    quality: int = 4,
    hdop: str = "0.6",
    height: str = "12.3,M,45.1,M",
) -> str:
    seconds = at_s % 86400
    time_offset = f"{int(seconds // 3600):02d}{int(seconds // 60 % 60):02d}{seconds % 60:05.2f}"
    return sentence(f"{talker}GGA,{time_offset},{place(k)},{quality},18,{hdop},{height},1.0,0000")


def place(k: int, north_min: float = 0.0) -> str:
    return f"5332.{4000000 + 600 * k + int(1e7 * north_min):07d},N,00958.{8000000 + 1200 * k:07d},E"


def log(count: int = 20, start_s: float = 80000.0, **options: object) -> list[str]:
    return [gga(start_s + PERIOD_S * k, k, **options) for k in range(count)]  # type: ignore[arg-type]


def read(path: Path, content: str | bytes) -> tuple[GnssStream, list[str]]:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    recording = open_recording(path)
    return recording.gnss["gnss"], [finding.message for finding in recording.findings]


def began(stream: GnssStream) -> str:
    return str(datetime.fromtimestamp(int(stream.timestamps_ns[0]) / 1e9, UTC))[:19]


UBX = bytes([0xB5, 0x62, 0x01, 0x07, 0x5C, 0x00, *range(92), 0x24])


@pytest.mark.parametrize(
    "dress",
    [
        lambda s: "45.1,M,1.0,0000*7E\n" + "".join(s),
        lambda s: "# logger started\n\n" + "".join(s),
        lambda s: "\ufeff" + "".join(s),
        lambda s: UBX + "".join(s).encode() + UBX,
        lambda s: b"".join(UBX[: 7 * k % 90] + line.encode() for k, line in enumerate(s)),
        lambda s: "".join("22:13:20.00 " + line for line in s),
        lambda s: "".join("2023-11-14T22:13:20.000Z;GPS;" + line for line in s),
        lambda s: "".join(f'1700000000000,"{line.strip()}"\n' for line in s),
        lambda s: "".join("\\s:GP0001,n:1*11\\" + line for line in s),
        lambda s: "".join(s).replace("\r\n", " "),
        lambda s: "".join(s)[:-20],
        lambda s: "".join(line.split("*")[0] + "\n" for line in s),
    ],
)
def test_sentences_are_found_whatever_is_about_them(tmp_path: Path, dress: object) -> None:
    stream, _ = read(tmp_path / "log.txt", dress(log()))  # type: ignore[operator]
    assert len(stream.timestamps_ns) in (19, 20)  # one log is cut within its last sentence
    k = len(stream.timestamps_ns) - 1
    np.testing.assert_allclose(stream.position_enu[-1, :2], [0.1327 * k, 0.1113 * k], atol=0.01)
    assert began(stream) == "1970-01-01 22:13:20"


def rmc(at_s: float, k: int, day: str, status: str = "A") -> str:
    time_offset = gga(at_s, k).split(",")[1]
    return sentence(f"GNRMC,{time_offset},{status},{place(k)},3.0,45.0,{day},,,R")


@pytest.mark.parametrize("where", ["first", "last", "every", "late at midnight", "not valid", "ZDA", "TAG"])
def test_a_date_belongs_to_its_sentence(tmp_path: Path, where: str) -> None:
    start = 86400 - 2.0
    lines = []
    for k in range(20):
        at = start + PERIOD_S * k
        day = "141123" if at < 86400 else "151123"
        fix = gga(at, k)
        if (where == "first" and k == 0) or (where == "last" and k == 19) or where == "every":
            lines.append(rmc(at, k, day))
        elif where == "late at midnight":
            lines.append(rmc(at, k, "141123" if at < 86400.1 else "151123"))
        elif where == "not valid":
            lines.append(rmc(at, k, "060180" if k < 3 else day, "V" if k < 3 else "A"))
        elif where == "ZDA" and k == 15:
            time_offset = fix.split(",")[1]
            lines.append(sentence(f"GNZDA,{time_offset},15,11,2023,00,00"))
        elif where == "TAG":
            fix = f"\\c:{1_700_006_398 + int(PERIOD_S * k)}*11\\" + fix
        lines.append(fix)
    stream, said = read(tmp_path / "log.nmea", "".join(lines))
    assert began(stream) == "2023-11-14 23:59:58"
    assert len(stream.timestamps_ns) == 20
    assert np.ptp(np.diff(stream.timestamps_ns)) < 1000
    assert said == []


def test_days_between_two_recordings_in_one_log(tmp_path: Path) -> None:
    lines = [rmc(1000 + k, k, "141123") + gga(1000 + k, k) for k in range(5)]
    lines += [rmc(2000 + k, k, "181123") + gga(2000 + k, k) for k in range(5)]
    (tmp_path / "log.nmea").write_text("".join(lines))
    stream = read_nmea(tmp_path / "log.nmea", "log")[0]
    assert np.diff(stream.timestamps_ns)[4] == (4 * 86400 + 1000 - 4) * 10**9


@pytest.mark.parametrize(
    ("quality", "hdop", "low", "high"),
    [
        (4, "0.6", 0.005, 0.05),
        (5, "0.8", 0.1, 0.6),
        (2, "0.9", 0.5, 2.0),
        (1, "0.9", 1.5, 4.0),
        (1, "-0.01", 4.9, 5.1),
        (1, "99.9", 4.9, 5.1),
        (1, "", 4.9, 5.1),
        (1, "nan", 4.9, 5.1),
    ],
)
def test_quality_and_dilution_are_what_they_are(
    tmp_path: Path, quality: int, hdop: str, low: float, high: float
) -> None:
    stream, _ = read(tmp_path / "log.nmea", "".join(log(quality=quality, hdop=hdop)))
    std = np.sqrt(stream.covariances[:, 0, 0])
    assert (std > low).all()
    assert (std < high).all()


def test_standard_deviations_of_gst_are_believed_where_they_are_some(tmp_path: Path) -> None:
    lines = []
    for k, fix in enumerate(log(4)):
        stated = ("0.4,0.5,0.9", "0,0,0", "-1,2,3", "nan,inf,1")[k]
        lines.append(fix + sentence(f"GNGST,{fix.split(',')[1]},1.0,,,,{stated}"))
    stream, _ = read(tmp_path / "log.nmea", "".join(lines))
    np.testing.assert_allclose(np.sqrt(np.diagonal(stream.covariances[0])), [0.5, 0.4, 0.9])
    np.testing.assert_allclose(np.sqrt(stream.covariances[1:, 0, 0]), 0.012)


@pytest.mark.parametrize(("quality", "word"), [(6, "dead reckoning"), (7, "by hand")])
def test_what_no_satellite_said_is_left_out(tmp_path: Path, quality: int, word: str) -> None:
    lines = log()
    lines[5:8] = [gga(80000 + PERIOD_S * k, 10_000 + k, quality=quality) for k in range(5, 8)]
    stream, said = read(tmp_path / "log.nmea", "".join(lines))
    assert len(stream.timestamps_ns) == 17
    assert np.abs(stream.position_enu).max() < 5
    assert any(word in message and message.startswith("3 ") for message in said)


@pytest.mark.parametrize("second", [("II", 0.05), ("GP", 0.0), ("HE", 0.1)])
def test_one_of_two_receivers_is_taken(tmp_path: Path, second: tuple[str, float]) -> None:
    talker, delay = second
    lines = []
    for k, fix in enumerate(log(talker="GN")):
        other = fix.replace("$GNGGA", f"${talker}GGA").split("*")[0]
        fields = other[1:].split(",")
        seconds = 80000 + PERIOD_S * k + delay
        fields[1] = gga(seconds, k).split(",")[1]
        fields[2] = f"5332.{4180000 + 600 * k:07d}"
        fields[8] = "1.5"
        lines += [fix, sentence(",".join(fields))]
    stream, said = read(tmp_path / "log.nmea", "".join(lines))
    assert len(stream.timestamps_ns) == 20
    assert np.abs(np.diff(stream.position_enu[:, 1])).max() < 1
    assert any("2 receivers" in message and "20 others" in message for message in said)


def test_a_receiver_may_change_its_talker(tmp_path: Path) -> None:
    lines = [gga(80000 + PERIOD_S * k, k, talker="GP" if k % 7 < 3 else "GN") for k in range(20)]
    stream, said = read(tmp_path / "log.nmea", "".join(lines))
    assert len(stream.timestamps_ns) == 20
    assert not any("receivers" in message for message in said)


@pytest.mark.parametrize("kind", ["RMC", "GLL", "GNS"])
def test_positions_of_other_sentences(tmp_path: Path, kind: str) -> None:
    lines = []
    for k, fix in enumerate(log()):
        time_offset = fix.split(",")[1]
        body = {
            "RMC": f"GPRMC,{time_offset},A,{place(k)},3.0,45.0,141123,,,A",
            "GLL": f"GPGLL,{place(k)},{time_offset},A,A",
            "GNS": f"GNGNS,{time_offset},{place(k)},RR,18,0.6,12.3,45.1,,",
        }[kind]
        lines.append(sentence(body))
    stream, _ = read(tmp_path / "log.nmea", "".join(lines))
    np.testing.assert_allclose(stream.position_enu[-1, :2], [2.52, 2.11], atol=0.01)
    assert (stream.covariances[0, 2, 2] == UNKNOWN_UP_VARIANCE) == (kind != "GNS")


def test_a_log_without_a_position_is_refused(tmp_path: Path) -> None:
    for lines in ([gga(80000, 0, quality=0)], [sentence("GNZDA,235958.00,14,11,2023,00,00")], log(quality=6)):
        (tmp_path / "log.nmea").write_text("".join(lines))
        with pytest.raises(InputError, match="no position"):
            read_nmea(tmp_path / "log.nmea")


def fixes(count: int = 30) -> np.ndarray:
    return np.column_stack([53.54 + 1e-5 * np.arange(count), np.full(count, 9.98), np.full(count, 40.0)])


@pytest.mark.parametrize("bad", [slice(0, 5), slice(10, 12), slice(25, 30)])
@pytest.mark.parametrize(
    "value", [(0.0, 0.0, 0.0), (20.0, 9.98, 40.0), (np.nan, 9.98, 40.0), (53.5, 1e8, 40.0)]
)
def test_fixes_that_are_none_are_left_out(bad: slice, value: tuple[float, float, float]) -> None:
    lla = fixes()
    lla[bad] = value
    kept = np.delete(np.arange(30), np.arange(30)[bad])
    stream, findings = gnss_stream_of_fixes("gnss", np.arange(30) * 10**9, lla, np.zeros((30, 3, 3)))
    assert np.array_equal(stream.timestamps_ns, kept * 10**9)
    assert stream.origin_lla == tuple(fixes()[kept[0]])
    assert np.abs(stream.position_enu).max() < 50
    assert findings


def test_positions_at_zero_are_kept_where_all_are(tmp_path: Path) -> None:
    """Simulators sail about latitude 0, longitude 0."""
    lla = fixes() - [53.54, 9.98, 0.0]
    stream, findings = gnss_stream_of_fixes("gnss", np.arange(30) * 10**9, lla, np.zeros((30, 3, 3)))
    assert len(stream.timestamps_ns) == 30
    assert findings == ()
    with pytest.raises(InputError, match="no valid fix"):
        gnss_stream_of_fixes("gnss", np.arange(30) * 10**9, 0 * lla, np.zeros((30, 3, 3)))


@pytest.mark.parametrize("lost", [slice(0, 30), slice(0, 10), slice(20, 30)])
def test_heights_that_are_not_there_are_unknown(lost: slice) -> None:
    lla = fixes()
    lla[lost, 2] = np.nan
    stream, findings = gnss_stream_of_fixes(
        "gnss", np.arange(30) * 10**9, lla, np.tile(np.eye(3), (30, 1, 1))
    )
    assert len(stream.timestamps_ns) == 30
    unknown = stream.covariances[:, 2, 2] == UNKNOWN_UP_VARIANCE
    assert np.array_equal(np.flatnonzero(unknown), np.arange(30)[lost])
    assert "no height" in findings[0].message


@pytest.mark.parametrize(
    "bad", [-np.eye(3), np.full((3, 3), np.nan), np.diag([1.0, 1.0, np.inf]), np.ones((3, 3)) * 9]
)
def test_covariances_that_are_none_are_replaced_and_said(bad: np.ndarray) -> None:
    spread = np.tile(np.eye(3), (30, 1, 1))
    spread[4:6] = bad
    stream, findings = gnss_stream_of_fixes("gnss", np.arange(30) * 10**9, fixes(), spread)
    np.testing.assert_allclose(stream.covariances[4:6], np.tile(25 * np.eye(3), (2, 1, 1)))
    assert findings[0].message.startswith("2 of 30 covariances")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8-sig"])
def test_logs_that_a_shell_redirected(tmp_path: Path, encoding: str) -> None:
    stream, _ = read(tmp_path / "a.nmea", "".join(log()).encode(encoding))
    assert len(stream.timestamps_ns) == 20


@pytest.mark.parametrize("sentinel", [-9999.0, 99999.0, -1e6, float("inf")])
def test_heights_that_stand_for_none(sentinel: float) -> None:
    lla = fixes()
    lla[:5, 2] = sentinel
    stream, findings = gnss_stream_of_fixes("gnss", np.arange(30) * 10**9, lla, np.zeros((30, 3, 3)))
    assert ((stream.covariances[:, 2, 2] == UNKNOWN_UP_VARIANCE) == (np.arange(30) < 5)).all()
    assert np.abs(stream.position_enu[:, 2]).max() < 1.0
    assert "5 fixes have no altitude" in findings[0].message
