"""The Python client of a depth service."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Literal, Self

import httpx
from pydantic import BaseModel, ValidationError

from bathyscope.bundle import BundleManifest
from bathyscope.engines import DepthOptions
from bathyscope.errors import ServiceError
from bathyscope.result import ClipDepth
from bathyscope.result_files import Precision, load_npz
from bathyscope_client.failures import as_service_error, refusal
from bathyscope_client.upload import OnBytes, Upload, ignore_bytes, open_upload

Form = Literal["npz", "zip", "json"]
Source = Path | str | BinaryIO
MEDIA_TYPES: dict[Form, str] = {"npz": "application/x-npz", "zip": "application/zip", "json": "application/json"}
_BUSY = (429, 503)
_CONNECT_S = 10.0
_BLOCK_BYTES = 1 << 18


class ServedBundle(BaseModel, frozen=True):
    """The model that a service uses."""

    digest: str
    manifest: BundleManifest


class DepthClient:
    """Depth from a service: ``with DepthClient("http://localhost:8000") as client: client.depth("colon.mp4")``.

    Args:
        url: Where the service is.
        transport: What carries the requests; for tests and special networks.
        timeout_s: Longest silence of the service; estimating a clip is one.
        patience_s: How long to try again in all when the service is busy or still starting, as it asks for.
    """

    def __init__(
        self,
        url: str,
        *,
        transport: httpx.BaseTransport | None = None,
        timeout_s: float = 1800.0,
        patience_s: float = 0.0,
    ) -> None:
        self.url = url.rstrip("/")
        self._patience_s = patience_s
        with as_service_error(self.url):
            timeout = httpx.Timeout(timeout_s, connect=_CONNECT_S)
            self._http = httpx.Client(base_url=self.url, transport=transport, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def depth(
        self, source: Source, options: DepthOptions = DepthOptions(), *, precision: Precision = "float32"
    ) -> ClipDepth:
        """Depth and cameras of a clip, in memory.

        Args:
            source: A video, a zip of images, a folder of images, or an open binary file.
            options: What is asked for.
            precision: Type of the depth and confidence maps.

        Raises:
            ServiceError: If the service refuses, fails, or cannot be reached.
            ClipError: If the source is not there.
        """
        with tempfile.TemporaryDirectory(prefix="bathyscope-") as folder:
            return load_npz(self.download(source, Path(folder) / "result.npz", options=options, precision=precision))

    def download(
        self,
        source: Source,
        out: Path | str,
        form: Form = "npz",
        *,
        options: DepthOptions = DepthOptions(),
        precision: Precision = "float32",
        on_sent: OnBytes = ignore_bytes,
        on_received: OnBytes = ignore_bytes,
    ) -> Path:
        """Write the result of a clip to a file; neither the clip nor the result is held in memory.

        The file appears under its name when it is whole.

        Raises:
            ServiceError: If the service refuses, fails, or cannot be reached.
            ClipError: If the source is not there.
        """
        out = Path(out)
        beside = out.with_name(out.name + ".part")
        try:
            with open_upload(source) as upload, self._answer(upload, form, options, precision, on_sent) as answer:
                _save(answer, beside, on_received)
            beside.replace(out)
        finally:
            beside.unlink(missing_ok=True)
        return out

    def bundle(self) -> ServedBundle:
        """The model that the service uses.

        Raises:
            ServiceError: If it cannot be asked.
        """
        answer = self._get("/bundle")
        if answer.is_error:
            raise refusal(answer)
        try:
            return ServedBundle.model_validate_json(answer.content)
        except ValidationError as error:
            raise ServiceError(f"{self.url}: /bundle is no answer of a depth service", status=200) from error

    def ready(self) -> bool:
        """Whether the service takes clips now; ``False`` while its model warms up.

        Raises:
            ServiceError: If it cannot be reached or is no depth service.
        """
        answer = self._get("/readyz")
        if answer.is_success:
            return True
        if answer.status_code == 503:
            return False
        raise refusal(answer)

    def _get(self, path: str) -> httpx.Response:
        with as_service_error(self.url):
            return self._http.get(path)

    @contextmanager
    def _answer(
        self, upload: Upload, form: Form, options: DepthOptions, precision: Precision, on_sent: OnBytes
    ) -> Iterator[httpx.Response]:
        """The successful answer to a clip, its body not read yet; tries again while the service is busy."""
        give_up = time.monotonic() + self._patience_s
        while True:
            request = self._request(upload, form, options, precision, on_sent)
            with as_service_error(self.url):
                answer = self._http.send(request, stream=True)
                try:
                    if answer.is_success:
                        yield answer
                        return
                    answer.read()
                finally:
                    answer.close()
            wait_s = _retry_after(answer)
            if answer.status_code not in _BUSY or not upload.repeatable or time.monotonic() + wait_s > give_up:
                raise refusal(answer)
            time.sleep(wait_s)

    def _request(
        self, upload: Upload, form: Form, options: DepthOptions, precision: Precision, on_sent: OnBytes
    ) -> httpx.Request:
        query = options.model_dump(mode="json", exclude_none=True)
        headers = {"accept": MEDIA_TYPES[form], "content-type": upload.content_type}
        if upload.length is not None:
            headers["content-length"] = str(upload.length)
        return self._http.build_request(
            "POST",
            "/depth",
            params={**query, "dtype": precision, "name": upload.name},
            headers=headers,
            content=upload.blocks(on_sent),
        )


def _save(answer: httpx.Response, path: Path, on_received: OnBytes) -> None:
    found = answer.headers.get("content-type", "").split(";")[0]
    if found != answer.request.headers["accept"]:
        raise ServiceError(
            f"{answer.request.url.host}: answered {found or 'nothing'} instead of {answer.request.headers['accept']}; "
            "is it a depth service?",
            status=answer.status_code,
            request_id=answer.headers.get("x-request-id"),
        )
    length = answer.headers.get("content-length")
    with path.open("wb") as file:
        for block in answer.iter_bytes(_BLOCK_BYTES):
            file.write(block)
            on_received(file.tell(), int(length) if length else None)


def _retry_after(answer: httpx.Response) -> float:
    try:
        return max(0.0, float(answer.headers.get("retry-after", "1")))
    except ValueError:
        return 1.0
