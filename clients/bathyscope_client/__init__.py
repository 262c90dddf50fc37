"""Python client, batch command and output files."""
