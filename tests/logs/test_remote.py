"""Logs that lie elsewhere: read by ranges, as few bytes as need be, the same scans as from the file beside."""

import json
import zlib
from contextlib import suppress
from time import sleep

import msgspec
import numpy as np
import pytest

from scanchain.__main__ import main
from scanchain.config import LogConfig
from scanchain.errors import InputError, MissingExtraError
from scanchain.files import Address, source_of
from scanchain.logs import files, open_log, writer
from scanchain.logs.formats.mcap import Walk, empty_index
from scanchain.logs.opening import index_files
from scanchain.logs.stream import complete
from scanchain.runs.provenance import Provenance, identity_of
from scanchain.simulation import simulate
from tests.support.sensor_files import flaser, save
from tests.support.web_server import serving

pytest.importorskip("fsspec", reason="the extra remote is not installed")


@pytest.fixture(scope="module")
def log_file(tmp_path_factory):
    """A simulated office in many chunks: laser scans, wheels, a mounting, ground truth."""
    path = tmp_path_factory.mktemp("remote") / "office.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "CHUNK_BYTES", 100_000)
        simulate("office", path, duration_s=80.0, seed=3)
    return path


@pytest.fixture
def site(log_file):
    with serving({"/logs/office.mcap": log_file.read_bytes()}) as served:
        served.log = f"{served.url}/logs/office.mcap"
        yield served


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(files, "_PAUSE_S", 0.01)


def same_scans(first, second):
    pairs = list(zip(first.scans(), second.scans(), strict=True))
    return len(pairs) > 0 and all(
        a.stamp_ns == b.stamp_ns
        and a.log_time_ns == b.log_time_ns
        and np.array_equal(a.points, b.points)
        and str(a.T_odom_base) == str(b.T_odom_base)
        for a, b in pairs
    )


def test_an_index_by_the_summary_is_that_of_walking_the_file(site, log_file):
    (local,), (asked,) = index_files([log_file]), index_files([Address(site.log)])
    assert len(site.asked) == 2 and site.sent <= 65_537  # the last byte, and the tail
    walk = empty_index(log_file, 0, log_file.read_bytes())
    Walk(walk).walk()
    complete(walk)
    assert asked.blocks == walk.blocks and all(block.head for block in asked.blocks)
    assert asked.channels == local.channels == walk.channels and asked.counts == local.counts == walk.counts
    assert local.blocks == asked.blocks and not walk.damage


def test_of_a_twentieth_of_the_time_little_more_than_a_twentieth_is_read(site, log_file):
    part = LogConfig(start_s=40.0, end_s=44.0)
    log = open_log(site.log, part)
    assert same_scans(log, open_log(log_file, part)) and log.scan_count == open_log(log_file, part).scan_count
    assert site.sent < 0.15 * log_file.stat().st_size


def test_chunks_are_asked_for_several_at_a_time_and_each_once(site, log_file):
    log, beside = open_log(site.log), open_log(log_file)
    assert len(log.indexes[0].blocks) > 50
    site.asked.clear()
    site.sent = 0
    waiting, most = [], []
    answer = site.answer

    def slow(handler, *, is_head):
        waiting.append(1)
        most.append(len(waiting))
        sleep(0.02)
        waiting.pop()
        return answer(handler, is_head=is_head)

    site.answer = slow
    assert same_scans(log, beside)
    assert len(site.asked) <= len(log.indexes[0].blocks) and 4 <= max(most) <= 9
    assert site.sent < 1.05 * log_file.stat().st_size
    site.answer = answer
    assert np.array_equal(open_log(site.log).ground_truth().poses, beside.ground_truth().poses)


def test_a_run_has_the_same_poses_says_which_version_it_read_and_writes_no_password(
    site, log_file, tmp_path, capfd
):
    signed = site.log.replace("http://", "http://me:secret@") + "?signature=secret"
    site.files["/logs/office.mcap?signature=secret"] = site.files["/logs/office.mcap"]
    for source, name in ((signed, "remote"), (str(log_file), "local")):
        assert main(["run", f"{source}", "--out", str(tmp_path / name), "--rerun", "off", "--end", "2"]) == 0
    remote_tum, local_tum = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("remote", "local"))
    assert remote_tum == local_tum
    made = msgspec.json.decode((tmp_path / "remote" / "run.json").read_bytes(), type=Provenance)
    (told,) = made.logs
    assert (told.path, told.sha256, told.version) == (site.log, "", '"one"')
    assert told.size_bytes == log_file.stat().st_size
    written = [file.read_bytes() for file in (tmp_path / "remote").rglob("*") if file.is_file()]
    assert not any(b"secret" in content for content in written) and "secret" not in "".join(capfd.readouterr())


def test_info_and_doctor_take_addresses(site, log_file, capfd):
    assert main(["info", site.log, "--json"]) == 0
    told = json.loads(capfd.readouterr()[0])
    assert main(["info", str(log_file), "--json"]) == 0
    assert told == json.loads(capfd.readouterr()[0]) | {"files": [site.log]}
    assert main(["doctor", site.log]) == 0 and "/scan" in capfd.readouterr()[0]


def test_a_server_without_ranges_sends_it_all_and_that_is_said(site, log_file):
    site.has_ranges = False
    log = open_log(site.log, LogConfig(end_s=1.0))
    assert same_scans(log, open_log(log_file, LogConfig(end_s=1.0)))
    assert "is on a server without byte ranges, so all" in log.notes[0]


@pytest.mark.parametrize("spoilt", ["no summary", "cut off", "summary with a flipped bit", "chunk"])
def test_damage_is_told_of_the_address_and_a_log_without_an_index_is_fetched_whole(
    site, tmp_path, log_file, spoilt
):
    data = bytearray(log_file.read_bytes())
    if spoilt == "no summary":
        begin = int.from_bytes(data[-28:-20], "little")
        data = data[:begin] + b"\x02" + (20).to_bytes(8, "little") + bytes(20) + data[-8:]
    elif spoilt == "cut off":
        data = data[: len(data) // 2]
    elif spoilt == "chunk":
        block = open_log(log_file).indexes[0].blocks[3]
        data[block.offset + block.size // 2] ^= 1
    else:
        data[int.from_bytes(data[-28:-20], "little") + 40] ^= 1
    site.files["/logs/office.mcap"] = bytes(data)
    (tmp_path / "beside.mcap").write_bytes(data)
    log, beside = open_log(site.log), open_log(tmp_path / "beside.mcap")
    assert same_scans(log, beside)
    assert ("has no complete index, so all" in " ".join(log.notes)) == (spoilt != "chunk")
    assert log.damage == [line.replace(str(tmp_path / "beside.mcap"), site.log) for line in beside.damage]
    assert bool(log.damage) == (spoilt != "no summary")


@pytest.mark.parametrize("place", ["chunk offset", "size", "statistics"])
def test_a_summary_that_lies_is_not_believed(site, log_file, place):
    data = bytearray(log_file.read_bytes())
    begin = int.from_bytes(data[-28:-20], "little")
    opcode = b"\x0b" if place == "statistics" else b"\x08"
    at = begin
    while data[at : at + 1] != opcode:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    field = {"chunk offset": 9 + 16, "size": 9 + 24, "statistics": 9}[place]
    data[at + field + 5] ^= 64
    data[-12:-8] = zlib.crc32(data[begin:-12]).to_bytes(4, "little")
    site.files["/logs/office.mcap"] = bytes(data)
    log = open_log(site.log)
    assert len(list(log.scans())) == len(list(open_log(log_file).scans()))


def test_other_formats_are_fetched_whole(tmp_path):
    save(tmp_path / "log.clf", *map(flaser, range(4)))
    with serving({"/log.clf": (tmp_path / "log.clf").read_bytes()}) as site:
        assert same_scans(open_log(f"{site.url}/log.clf"), open_log(tmp_path / "log.clf"))
        assert main(["convert", f"{site.url}/log.clf", str(tmp_path / "log.mcap")]) == 0
        assert same_scans(open_log(tmp_path / "log.mcap"), open_log(tmp_path / "log.clf"))


def test_a_line_that_stays_broken_is_an_error_that_names_the_byte_and_what_there_is_can_be_gone_on_with(
    site, log_file, tmp_path, impatient, capfd
):
    words = f"run {site.log} --out {tmp_path / 'run'} --rerun off --end 20 --checkpoint 0.1".split()
    answer = site.answer
    allowed = log_file.stat().st_size // 8

    def breaking(handler, *, is_head):
        if not is_head and site.sent > allowed:
            return handler.send_error(503)
        return answer(handler, is_head=is_head)

    site.answer = breaking
    assert main(words) == 2
    error = capfd.readouterr()[1].splitlines()[-1]
    assert (
        error.startswith(f"error: {site.log}: byte ") and "(503 Service Unavailable); requested 4 times" in error
    )
    site.answer, site.failures = answer, [0, 503, 429]  # those pass
    assert main([*words, "--resume"]) == 0 and not site.failures
    assert main(["run", str(log_file), *words[2:3], str(tmp_path / "local"), *words[4:]]) == 0
    resumed, local = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("run", "local"))
    assert resumed == local


@pytest.mark.parametrize(
    ("path", "complaint"),
    [
        ("{url}/logs/none.mcap", r"none\.mcap: no such file; check the address \(404"),
        ("{url}/forbidden.mcap", r"forbidden\.mcap: may not be read; .*\(403"),
        ("http://nowhere.invalid/log.mcap", r"log\.mcap: cannot be read \(.*nowhere\.invalid.*requested 4 times"),
        ("http://127.0.0.1:9/log.mcap", r"cannot be read \(.*refused|Connect call failed"),
        ("foo://bucket/log.mcap", r"log\.mcap: Protocol not known: foo; give a path, s3:// or https://"),
        ("gs://bucket/log.mcap", r"log\.mcap: .*install gcsfs"),
        ("{url}/empty.mcap", r"empty\.mcap: is empty"),
        ("{url}/text.mcap", r"is not a recognized log"),
    ],
)
def test_what_is_wrong_with_an_address_is_one_line(site, impatient, capfd, path, complaint):
    site.files |= {"/empty.mcap": b"", "/text.mcap": b"hello " * 100}
    answer = site.answer

    def guarded(handler, *, is_head):
        if handler.path == "/forbidden.mcap":
            return handler.send_error(403)
        return answer(handler, is_head=is_head)

    site.answer = guarded
    with pytest.raises(InputError, match=complaint):
        open_log(path.format(url=site.url))
    assert main(["info", path.format(url=site.url)]) == 2
    assert len(capfd.readouterr()[1].splitlines()) == 1


@pytest.fixture
def bucket(log_file, monkeypatch):
    """A local S3 with the log in it."""
    server = pytest.importorskip("moto.server", reason="moto is not installed").ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    endpoint = "http://{}:{}".format(*server.get_host_and_port())
    for name, value in {"ENDPOINT_URL": endpoint, "ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    s3fs = pytest.importorskip("s3fs", reason="the extra remote is not installed")
    s3fs.S3FileSystem.clear_instance_cache()
    system = s3fs.S3FileSystem()
    with suppress(FileExistsError):
        system.mkdir("robots")
    system.put_file(str(log_file), "robots/logs/office.mcap")
    yield system
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def test_a_log_in_s3_is_that_of_the_file(bucket, log_file):
    part = LogConfig(start_s=40.0, end_s=44.0)
    assert same_scans(open_log("s3://robots/logs/office.mcap"), open_log(log_file))
    assert same_scans(open_log("s3://robots/logs/office.mcap", part), open_log(log_file, part))
    first = identity_of(Address("s3://robots/logs/office.mcap"))
    bucket.pipe_file("robots/logs/office.mcap", log_file.read_bytes() + b" ")
    assert first and identity_of(Address("s3://robots/logs/office.mcap")) != first
    assert identity_of(Address("s3://robots/none.mcap")) == ""


def test_what_is_wrong_with_a_bucket_is_one_line(bucket, monkeypatch):
    with pytest.raises(InputError, match=r"none\.mcap: no such file; check the address"):
        open_log("s3://robots/none.mcap")
    with pytest.raises(InputError, match=r"s3://robots/logs: is a folder"):
        open_log("s3://robots/logs")
    for name in ("ACCESS_KEY_ID", "SECRET_ACCESS_KEY"):
        monkeypatch.delenv(f"AWS_{name}")
    for name, value in {"EC2_METADATA_DISABLED": "true", "SHARED_CREDENTIALS_FILE": "/none"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    type(bucket).clear_instance_cache()
    with pytest.raises(
        InputError, match=r"office\.mcap: may not be read; .*AWS_PROFILE.*Unable to locate credentials"
    ):
        open_log("s3://robots/logs/office.mcap")


def test_without_the_extra_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'scanchain\[remote\]'"):
        open_log("https://host/log.mcap")


def test_a_text_with_a_scheme_is_an_address_and_everything_else_a_path(tmp_path):
    assert isinstance(source_of("s3://bucket/log.mcap"), Address)
    assert source_of(f"file://{tmp_path}/a%20b.mcap") == tmp_path / "a b.mcap"
    assert source_of("C:/log.mcap").name == source_of("a/log.mcap").name == "log.mcap"
    address = source_of("https://me:key@host:80/a/log%20one.mcap?token=1#x")
    assert (str(address), address.name, address.stem) == (
        "https://host:80/a/log%20one.mcap", "log one.mcap", "log one",
    )  # fmt: skip
