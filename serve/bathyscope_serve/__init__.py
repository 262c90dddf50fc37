"""Serving: decode, engine and HTTP service; never imports torch."""
