"""The named domains: where training starts, the wide one it goes on with, and one kept for tests.

Each is a file beside this module, in the format of ``Domain.from_file``:

* ``source``: narrow; pink mucosa, inverse-square light, little noise. A small model learns it within minutes. It is
  what the ranges default to.
* ``typical``: moderate ranges of everything: what most endoscopes and tissues look like.
* ``tubes``: the looks of ``typical`` in colons and noses, the camera mostly near a wall and the way ahead in view: the
  farthest thing in a picture is ten to thirty times as far as the nearest.
* ``broad``: wide ranges of everything, the far ends included: narrow and fish-eye views, strong haze, paint and smear.
* ``shifted``: never trained on; pale and yellowish, spotted, slow fall-off, narrow beam, strong highlights.
* ``narrowband``: never trained on; the same in light without red, as in narrow-band imaging.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from bathyscope_train.data.synthetic.domain import Domain

_FOLDER = Path(__file__).with_name("domains")
_NAMES = ("source", "typical", "tubes", "broad", "shifted", "narrowband")


class NamedDomains(Mapping[str, Domain]):
    """The domains that come with the package, each read when it is first asked for."""

    def __getitem__(self, name: str) -> Domain:
        if name not in _NAMES:
            raise KeyError(name)
        return _read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(_NAMES)

    def __len__(self) -> int:
        return len(_NAMES)


@cache
def _read(name: str) -> Domain:
    return Domain.from_file(_FOLDER / f"{name}.json")


DOMAINS = NamedDomains()
