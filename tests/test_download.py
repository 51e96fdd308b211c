"""Downloads from a local server that understands ranges, and the catalog's recordings by way of it."""

import hashlib
import io
import json
import zipfile

import msgspec
import numpy as np
import pytest

from scanchain import catalog
from scanchain.__main__ import main
from scanchain.download import fetch
from scanchain.errors import InputError, ScanchainError
from scanchain.logs import open_log
from tests.support import recorders
from tests.support.sensor_files import flaser, kitti_raw, save
from tests.support.web_server import serving

CONTENT = np.random.default_rng(0).bytes(3_000_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def site():
    with serving({"/file.bin": CONTENT}) as served:
        yield served


def left(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_comes_whole_verified_and_with_progress(site, tmp_path):
    told = []
    fetch(f"{site.url}/file.bin", tmp_path / "a", sha256=SHA256, progress=lambda *now: told.append(now))
    assert (tmp_path / "a").read_bytes() == CONTENT and left(tmp_path) == ["a"]
    assert told == sorted(told) and told[-1] == (2, 2)
    fetch(f"{site.url}/file.bin", tmp_path / "a", sha256=SHA256)
    assert site.asked == [None], "what is there is verified, not fetched again"


def test_a_line_that_breaks_is_gone_on_with_and_nothing_comes_twice(site, tmp_path):
    site.cuts = [1_000_000, 500_000]
    fetch(f"{site.url}/file.bin", tmp_path / "a", sha256=SHA256)
    assert (tmp_path / "a").read_bytes() == CONTENT and site.sent == len(CONTENT)
    assert site.asked == [None, "bytes=1000000-", "bytes=1500000-"]


def test_a_download_that_was_given_up_is_resumed_by_the_next_call(site, tmp_path):
    site.cuts = [700_000, 0, 0, 0]
    with pytest.raises(ScanchainError, match="700,000 bytes are kept"):
        fetch(f"{site.url}/file.bin", tmp_path / "a")
    assert left(tmp_path) == [".a.part"]
    fetch(f"{site.url}/file.bin", tmp_path / "a")
    assert left(tmp_path) == ["a"] and site.asked[-1] == "bytes=700000-"
    assert (tmp_path / "a").read_bytes() == CONTENT and site.sent == len(CONTENT)


def test_a_server_that_cannot_resume_starts_anew(site, tmp_path):
    site.cuts, site.has_ranges = [700_000], False
    fetch(f"{site.url}/file.bin", tmp_path / "a", sha256=SHA256)
    assert (tmp_path / "a").read_bytes() == CONTENT and site.sent == 700_000 + len(CONTENT)


@pytest.mark.parametrize("size", [3_000_000, 4_000_000])
def test_a_file_that_is_not_longer_on_the_server_than_what_is_here_is_fetched_anew(site, tmp_path, size):
    (tmp_path / ".a.part").write_bytes(bytes(size))
    fetch(f"{site.url}/file.bin", tmp_path / "a", sha256=SHA256)
    assert (tmp_path / "a").read_bytes() == CONTENT


def test_a_wrong_checksum_leaves_nothing(site, tmp_path):
    with pytest.raises(InputError, match=f"has SHA-256 {SHA256}, not 0000"):
        fetch(f"{site.url}/file.bin", tmp_path / "a", sha256="0" * 64)
    assert not (tmp_path / "a").exists() and not (tmp_path / ".a.part").exists()


def test_what_is_not_there_or_no_web_address_is_one_line(site, tmp_path):
    with pytest.raises(ScanchainError, match=r"/absent: 404 Not Found"):
        fetch(f"{site.url}/absent", tmp_path / "a")
    for url in ("file:///etc/passwd", "ftp://host/a", "intel.clf"):
        with pytest.raises(InputError, match="no address of a web server"):
            fetch(url, tmp_path / "a")
    assert left(tmp_path) == []
    with pytest.raises(ScanchainError, match=r"127\.0\.0\.1:9/a: .*; 0 bytes are kept"):
        fetch("http://127.0.0.1:9/a", tmp_path / "a")


# The catalog

PUBLISHED = {"intel", "aces", "freiburg-079", "mit-csail", "mit-killian", "freiburg-hospital", "kitti"}
PUBLISHED |= {"kitti-odometry", "newer-college", "mulran", "helipr"}


def served(monkeypatch, name, **changes):
    """The catalog's entry, its addresses on the local server."""
    entry = catalog.load(name)
    changed = msgspec.structs.replace(entry, source=msgspec.structs.replace(entry.source, **changes))
    monkeypatch.setattr(catalog, "load", lambda _: changed)


def test_every_recording_of_others_has_its_page_its_license_and_a_way_to_mcap():
    assert set(catalog.names()) >= PUBLISHED
    for name in PUBLISHED:
        entry = catalog.load(name)
        assert entry.source.page.startswith("http") and entry.license and entry.conversion and entry.ground_truth
        if isinstance(entry.source, catalog.Download):
            assert entry.source.url.startswith("http")
        else:
            assert "scanchain convert" in entry.source.steps and f"{name}.mcap" in entry.source.steps


def test_a_carmen_log_is_fetched_converted_and_its_relations_lie_beside_it(site, tmp_path, monkeypatch, capfd):
    text = save(tmp_path / "x.log", *[flaser(k) for k in range(30)]).read_bytes()
    site.files = {"/set/intel.clf": text, "/set/intel.relations": b"1 2 3\n"}
    site.cuts = [len(text) // 2]
    url, sha256 = f"{site.url}/set/intel.clf", hashlib.sha256(text).hexdigest()
    served(monkeypatch, "intel", url=url, sha256=sha256, reference_url=f"{site.url}/set/intel.relations")
    out = tmp_path / "logs"
    assert main(["sequence", "get", "intel", "--out", str(out), "--json"]) == 0
    assert json.loads(capfd.readouterr().out) == {"name": "intel", "path": str(out / "intel.mcap")}
    assert left(out) == ["intel.clf", "intel.mcap", "intel.relations"]
    assert open_log(out / "intel.mcap").scan_count == 30
    asked = len(site.asked)
    assert main(["sequence", "get", "intel", "--out", str(out)]) == 0
    assert len(site.asked) == asked


def zipped(folder, base):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for file in folder.rglob("*") if folder.is_dir() else [folder]:
            archive.write(file, file.relative_to(base))
    return packed.getvalue()


def test_an_archive_is_unpacked_and_its_folder_converted_with_its_truth(site, tmp_path, monkeypatch):
    drive = kitti_raw(tmp_path / "made" / "2011_09_26", recorders.clouds())
    base = tmp_path / "made"
    site.files = {
        "/drive.zip": zipped(drive, base),
        "/calib.zip": zipped(base / "2011_09_26" / "calib_imu_to_velo.txt", base),
    }
    served(monkeypatch, "kitti", url=f"{site.url}/drive.zip", reference_url=f"{site.url}/calib.zip")
    log = open_log(catalog.prepare("kitti", tmp_path / "logs"))
    truth = log.ground_truth()
    assert log.scan_count == 3 and truth is not None and len(truth) == 3


def test_an_archive_that_is_none_says_so(site, tmp_path, monkeypatch):
    site.files = {"/drive.zip": b"no zip"}
    served(monkeypatch, "kitti", url=f"{site.url}/drive.zip", reference_url="")
    with pytest.raises(InputError, match=r"drive\.zip: does not unpack"):
        catalog.prepare("kitti", tmp_path)
