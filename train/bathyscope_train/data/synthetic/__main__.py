"""``python -m bathyscope_train.data.synthetic``: render training clips into a folder."""

from pathlib import Path
from typing import Annotated

import typer

from bathyscope_train.data.synthetic.domain import Domain
from bathyscope_train.data.synthetic.domains import DOMAINS
from bathyscope_train.data.synthetic.shards import write_clips


def main(  # noqa: PLR0917 - one argument an option
    root: Annotated[Path, typer.Argument(file_okay=False, help="Folder for the clips; those already there stay.")],
    domain: Annotated[str, typer.Option(help=f"One of {', '.join(DOMAINS)}, or a JSON file.")] = "source",
    first: Annotated[int, typer.Option(min=0, help="Seed of the first clip.")] = 0,
    count: Annotated[int, typer.Option(min=1, help="Number of clips, seeds counting up.")] = 16,
    frames: Annotated[int, typer.Option(min=1, help="Frames a clip.")] = 16,
    height: Annotated[int, typer.Option(min=8)] = 112,
    width: Annotated[int, typer.Option(min=8)] = 140,
    processes: Annotated[int, typer.Option(min=1, help="Renderers at the same time.")] = 2,
) -> None:
    """Render clips of a domain, one file a seed."""
    chosen = DOMAINS[domain] if domain in DOMAINS else Domain.from_file(Path(domain))
    seeds = range(first, first + count)
    for path in write_clips(root, chosen, seeds, frames=frames, size=(height, width), processes=processes):
        typer.echo(path)


if __name__ == "__main__":
    typer.run(main)
