"""Settings of the service: options of ``bathyscope serve`` and environment variables ``BATHYSCOPE_*``."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from bathyscope.errors import SettingsError


class ServiceSettings(BaseSettings):
    """Each field is also read from the environment: ``BATHYSCOPE_PORT``, ``BATHYSCOPE_MAX_UPLOAD_MB`` ..."""

    model_config = SettingsConfigDict(env_prefix="BATHYSCOPE_", frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535, description="0 takes a free one.")
    bundle: Path | None = Field(default=None, description="Folder or .zip; the shipped bundle unless given.")
    workers: PositiveInt = Field(default=1, description="Clips that are estimated at the same time.")
    threads: PositiveInt | None = Field(default=None, description="Threads of one estimate; all cores unless given.")
    queue: NonNegativeInt = Field(default=8, description="Clips that may wait; further ones are refused with 503.")
    clips_per_client: PositiveInt | None = Field(
        default=None, description="Clips in flight from one address, else 429; no such limit unless given."
    )
    max_upload_mb: PositiveFloat = Field(default=512, description="Largest body, in MiB.")
    receive_timeout_s: PositiveFloat = Field(default=120, description="Time in which a body must have arrived.")
    header_timeout_s: PositiveFloat = Field(default=10, description="Time in which a request's head must be there.")
    send_timeout_s: PositiveFloat = Field(
        default=60, description="Longest wait for a client to take part of an answer."
    )
    work_timeout_s: PositiveFloat = Field(default=1800, description="Longest estimate of one clip.")
    drain_timeout_s: PositiveFloat = Field(default=30, description="Time for running requests after SIGTERM.")
    temp: Path | None = Field(default=None, description="Folder for bodies and results while a request lasts.")

    @property
    def max_upload_bytes(self) -> int:
        """Largest body in bytes."""
        return int(self.max_upload_mb * (1 << 20))

    @classmethod
    def read(cls, **options: object) -> Self:
        """Settings from the environment and options that are not ``None``, which win.

        Raises:
            SettingsError: If a value is out of range or a temporary folder is given that does not exist.
        """
        try:
            settings = cls.model_validate({name: value for name, value in options.items() if value is not None})
        except ValidationError as error:
            problems = "; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
            raise SettingsError(f"the service's settings cannot be used: {problems}") from error
        if settings.temp is not None and not settings.temp.is_dir():
            raise SettingsError(f"temp: {settings.temp} is no folder; create it or leave the setting out")
        return settings
