"""Python client, batch command and output files."""

from bathyscope_client.client import DepthClient, ServedBundle

__all__ = ["DepthClient", "ServedBundle"]
