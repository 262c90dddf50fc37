"""What the HTTP service adds to the work itself, and what uploads cost in memory; prints one line of JSON.

``overhead_s`` is the time from the first byte sent to the last byte of the npz received, less the estimate's own time
as the service reports it (``Server-Timing: work``); sender and receiver share the machine. ``upload_rss_mb`` is by how
much the peak of the service's resident memory grows when a body of that many MiB, which is no video, is sent after
one of 1 MiB. ``refusal_s`` is the time to refuse a body that declares more than the limit.

    python benchmarks/service.py [--bundle FOLDER] [--clip VIDEO] [--requests 5]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import httpx

UPLOADS_MB = (8, 64, 256)


def start(bundle: str | None, log: Path) -> tuple[subprocess.Popen[bytes], str]:
    """The service as a process of its own, ready, and its address."""
    options = ["--bundle", bundle] if bundle else []
    command = [sys.executable, "-m", "bathyscope", "serve", "--port", "0", *options]
    with log.open("wb") as stream:
        process = subprocess.Popen(command, stderr=stream)
    while '"ready"' not in log.read_text():
        if process.poll() is not None:
            raise SystemExit(log.read_text())
        time.sleep(0.1)
    found = re.search(r"http://[\d.:]+", log.read_text())
    assert found is not None
    return process, found.group()


def peak_rss_mb(process: subprocess.Popen[bytes]) -> float:
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def overhead(http: httpx.Client, clip: bytes, requests: int) -> dict[str, float]:
    waits, works, sizes = [], [], []
    for _ in range(requests + 1):
        begin = time.perf_counter()
        answer = http.post("/depth", content=clip, headers={"content-type": "video/mp4"})
        whole = time.perf_counter() - begin
        answer.raise_for_status()
        work = float(answer.headers["server-timing"].split(" work;dur=")[1].split(",")[0]) / 1000
        waits.append(whole - work)
        works.append(work)
        sizes.append(len(answer.content))
    return {
        "overhead_s": round(statistics.median(waits[1:]), 4),
        "work_s": round(statistics.median(works[1:]), 4),
        "clip_mb": round(len(clip) / 1e6, 3),
        "npz_mb": round(sizes[0] / 1e6, 3),
    }


def upload_growth(process: subprocess.Popen[bytes], http: httpx.Client) -> dict[str, float]:
    block = os.urandom(1 << 20)

    def body(megabytes: int) -> Iterator[bytes]:
        for _ in range(megabytes):
            yield block

    def send(megabytes: int) -> float:
        answer = http.post("/depth", content=body(megabytes), headers={"content-type": "application/octet-stream"})
        assert answer.status_code == 422, answer.text
        return peak_rss_mb(process)

    first = send(1)
    return {str(megabytes): round(send(megabytes) - first, 2) for megabytes in UPLOADS_MB}


def refusal(url: str) -> float:
    host, port = url.removeprefix("http://").split(":")
    head = f"POST /depth HTTP/1.1\r\nHost: x\r\nContent-Type: video/mp4\r\nContent-Length: {1 << 40}\r\n\r\n"
    begin = time.perf_counter()
    with socket.create_connection((host, int(port))) as line:
        line.sendall(head.encode())
        assert b" 413 " in line.recv(4096)
    return round(time.perf_counter() - begin, 4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", help="default: the shipped one")
    parser.add_argument("--clip", type=Path, help="default: the shipped one")
    parser.add_argument("--requests", type=int, default=5)
    arguments = parser.parse_args()
    shipped = files("bathyscope_client") / "assets" / "demo.mp4"
    clip = arguments.clip.read_bytes() if arguments.clip else shipped.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        process, url = start(arguments.bundle, Path(folder) / "log")
        try:
            with httpx.Client(base_url=url, timeout=600, trust_env=False) as http:
                measured = overhead(http, clip, arguments.requests)
                growth = upload_growth(process, http)
                refused = refusal(url)
        finally:
            process.terminate()
            process.wait()
    print(json.dumps({"benchmark": "service", **measured, "upload_rss_mb": growth, "refusal_s": refused}))


if __name__ == "__main__":
    main()
