"""Which holes in accumulated depth give the pair RMSE log .255 and delta1 .902? Prints one line of JSON for each case.

Accumulated depth is not divided by opacity: where the scene stops the share ``opacity`` of the light it is that share
of the true depth. The model: away from holes the logarithm of depth is normally wrong with standard deviation
``sigma``; a share ``holes`` of the pixels is multiplied by ``opacity``, and clipped to 0.001 mm where it is 0. Both are
solved from delta1 and RMSE log alone; the other three numbers of the row are then predictions to hold against it.
True depth is log-normal (``--median``, ``--spread``), between 1 and 150 mm; depth is scaled by medians.

    python benchmarks/accumulated_depth.py [--abs-rel .100 --sq-rel 2.227 --rmse 10.4 --rmse-log .255 --delta1 .902]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass

import numpy as np
from scipy import optimize, special

from bathyscope_train.evaluation.metrics import DepthErrors, depth_errors

LOW, HIGH = 1e-3, 150.0
PIXELS = 400_000
FARTHEST = 1e9
"""Not a hole, but the other thing that a wrong pixel can be: at the upper cap."""
OPACITIES = (FARTHEST, 0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7)


@dataclass(frozen=True)
class Row:
    """What a paper reports."""

    abs_rel: float
    sq_rel: float
    rmse: float
    rmse_log: float
    delta1: float


def true_depth(median: float, spread: float) -> np.ndarray:
    drawn = median * np.exp(spread * np.random.default_rng(0).standard_normal(4 * PIXELS))
    return drawn[(drawn > 1) & (drawn < HIGH)][:PIXELS]


def errors(g: np.ndarray, sigma: float, holes: float, opacity: float) -> DepthErrors:
    """Of accumulated depth, after median scaling and clipping."""
    rng = np.random.default_rng(1)
    depth = g * np.exp(sigma * rng.standard_normal(len(g)))
    depth = np.where(rng.random(len(g)) < holes, opacity * depth, depth)
    return depth_errors(g, np.clip(depth * np.median(g) / np.median(depth), LOW, HIGH))


def solve(row: Row, opacity: float, g: np.ndarray) -> tuple[float, float] | None:
    """Sigma and share of holes that give delta1 and RMSE log; None where no share does."""
    logs = np.log(np.clip(opacity * g, LOW, HIGH) / g)
    square = float(np.mean(logs**2))

    def sigma_for(holes: float) -> float:
        inside = min(row.delta1 / (1 - holes), 1 - 1e-9)
        return float(np.log(1.25) / (np.sqrt(2) * special.erfinv(inside)))

    def excess(holes: float) -> float:
        return sigma_for(holes) ** 2 + holes * square - row.rmse_log**2

    most = 1 - row.delta1 - 1e-6
    if excess(0.0) > 0 or excess(most) < 0:
        return None
    holes = float(optimize.brentq(excess, 0.0, most))
    return sigma_for(holes), holes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in asdict(Row(0.100, 2.227, 10.400, 0.255, 0.902)).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, default=value)
    parser.add_argument("--median", type=float, default=75.0, help="of true depth, mm")
    parser.add_argument("--spread", type=float, default=0.3, help="standard deviation of its logarithm")
    given = vars(parser.parse_args())
    g = true_depth(given.pop("median"), given.pop("spread"))
    row = Row(**given)
    print(json.dumps({"published": asdict(row)}))
    alone = float(np.log(1.25) / (np.sqrt(2) * special.erfinv(row.delta1)))
    print(json.dumps({"case": "no holes, sigma from delta1", **rounded(alone, 0.0, errors(g, alone, 0, 1))}))
    print(
        json.dumps(
            {"case": "no holes, sigma from RMSE log", **rounded(row.rmse_log, 0.0, errors(g, row.rmse_log, 0, 1))}
        )
    )
    for opacity in OPACITIES:
        found = solve(row, opacity, g)
        case = {"case": "pixels at the upper cap" if opacity == FARTHEST else f"holes of opacity {opacity:g}"}
        if found is None:
            print(json.dumps({**case, "solution": None}))
            continue
        print(json.dumps({**case, **rounded(*found, errors(g, *found, opacity))}))


def rounded(sigma: float, holes: float, found: DepthErrors) -> dict[str, float]:
    numbers = {"sigma": sigma, "holes": holes, **found.as_dict()}
    return {name: float(f"{value:.3g}") for name, value in numbers.items() if name not in ("delta2", "delta3")}


if __name__ == "__main__":
    main()
