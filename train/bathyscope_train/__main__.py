"""``python -m bathyscope_train SETTINGS [name=value ...]``: ``bathyscope train`` where only this package is at hand."""

from bathyscope_train.cli import app

if __name__ == "__main__":
    app()
