"""What a video from outside may ask for before it is refused.

A 28 KB file can hold gigabytes of black 4K frames, so every limit counts decoded pixels or seconds, not bytes.
"""

from __future__ import annotations

from pydantic import BaseModel, Field, PositiveFloat, PositiveInt


class DecodeLimits(BaseModel, frozen=True, extra="forbid"):
    """Limits of one decode, and of the child process that does it."""

    frame_pixels: PositiveInt = Field(default=3840 * 2160, description="Height x width of one frame.")
    side_pixels: PositiveInt = Field(default=8000, description="Height or width of one frame.")
    least_side_pixels: PositiveInt = Field(default=16, description="Smaller frames hold nothing to measure.")
    frames: PositiveInt = Field(default=200_000, description="Frames of one clip.")
    total_pixels: PositiveInt = Field(default=100_000_000_000, description="Pixels of all frames together.")
    duration_s: PositiveFloat = Field(default=4 * 3600.0, description="Last time stamp of one clip.")
    pixels_per_byte: PositiveInt = Field(
        default=5_000,
        description="Decoded pixels that one byte of the file may stand for, beyond `free_pixels`. Real video at a "
        "very low rate (1080p at 0.2 Mbit/s) needs about 2,000; a bomb of black frames 35,000 and more.",
    )
    free_pixels: PositiveInt = Field(default=64_000_000, description="Decoded pixels that any file may hold.")
    file_bytes: PositiveInt = Field(default=16 << 30, description="Size of the file itself.")
    memory_bytes: PositiveInt = Field(default=2 << 30, description="Address space of the decoding process.")
    cpu_s: PositiveInt = Field(default=1800, description="CPU time of the decoding process.")
    wait_s: PositiveFloat = Field(default=60.0, description="Longest wait for the next frame.")

    def pixel_budget(self, file_bytes: int) -> int:
        """Pixels that a file of this size may decode to."""
        return min(self.total_pixels, self.free_pixels + self.pixels_per_byte * file_bytes)
