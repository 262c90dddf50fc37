"""Training: network, renderers, losses, data, evaluation and the trainer."""
