"""Training losses: supervised terms with exact truth, and what they are compared with."""
