"""``python -m bathyscope``: the same as the command ``bathyscope``."""

from bathyscope.cli import main

if __name__ == "__main__":
    main()
